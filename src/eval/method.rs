//! What is judged: a model, somebody's splats, somebody's pictures; by one scene as by a data set.

use super::memory::{device_memory_bytes, peak_memory_bytes};
use super::perceptual::Perceptual;
use super::scene::EvalScene;
use super::scores::{CaptureScores, score};
use crate::data::{View, cameras_at};
use crate::error::{Error, Result};
use crate::io::{Inputs, PHOTO_EXTENSIONS, Splat, find_splat, read_image, read_splat, tensor_from_rgb};
use crate::reconstruct::{Input, Model, Reconstruction, reconstruct};
use crate::render::{Rendered, render_views};
use crate::scene::ImageSize;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;
use tch::Tensor;

/// Makes pictures of a scene's target views.
#[derive(Debug, Clone)]
pub enum Method<'a> {
    /// A model, which sees the context views.
    Model(Model<'a>),
    /// A splat in the capture's own world.
    Splat(PathBuf),
    /// A folder of pictures named as the photos ([`crate::data::Capture::picture_names`]).
    Renders(PathBuf),
}

/// What a method makes of a scene.
#[derive(Debug)]
pub struct Synthesis {
    /// Of the target views, [3, H, W].
    pub pictures: Vec<Tensor>,
    /// The same with depth, where a splat was rendered here.
    pub rendered: Vec<Rendered>,
    /// Of the splat, where there is one.
    pub gaussians: Option<i64>,
    /// Of the PLY that the splat is, or would be.
    pub splat_bytes: Option<u64>,
    /// Of a model's forward pass, or passes.
    pub forward_seconds: Option<f64>,
}

/// What a model took, in bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Memory {
    pub host: u64,
    pub device: Option<u64>,
}

impl Method<'_> {
    /// That of scene `key`, where this one names a folder with `SCENE.ply` or a splat of another format, or with folders `SCENE`
    /// or `SCENE/color` of pictures, for every scene.
    pub fn of_scene(&self, key: &str) -> Self {
        match self {
            Method::Model(model) => Method::Model(*model),
            Method::Splat(folder) => Method::Splat(find_splat(folder, key)),
            Method::Renders(folder) => {
                let plain = folder.join(key);
                Method::Renders(Some(plain.join("color")).filter(|color| color.is_dir()).unwrap_or(plain))
            }
        }
    }

    /// Pictures of the scene's target views.
    ///
    /// # Errors
    /// Whatever the reconstruction fails with, a splat that can't be read, a picture that is missing.
    pub fn synthesize(&self, scene: &EvalScene) -> Result<Synthesis> {
        match self {
            Method::Model(model) => {
                let (reconstruction, rendered) = synthesize_views(*model, &scene.context, &scene.target)?;
                let splat = Splat::of(&reconstruction.gaussians)?;
                let seconds = reconstruction.forward_time.as_secs_f64();
                Ok(Synthesis { forward_seconds: Some(seconds), ..of_splat(&splat, rendered) })
            }
            Method::Splat(file) => {
                let splat = read_splat(file)?;
                let cameras: Vec<_> = scene.target.iter().map(|view| view.camera).collect();
                let rendered = render_views(&splat.gaussians, &cameras)?;
                Ok(of_splat(&splat, rendered))
            }
            Method::Renders(folder) => {
                let pictures = scene
                    .picture_names
                    .iter()
                    .map(|name| read_picture(folder, name))
                    .collect::<Result<_>>()?;
                Ok(Synthesis {
                    pictures,
                    rendered: vec![],
                    gaussians: None,
                    splat_bytes: None,
                    forward_seconds: None,
                })
            }
        }
    }

    /// Adds the files of a splat or pictures to `inputs`.
    pub fn add_inputs(&self, inputs: &mut Inputs) {
        match self {
            Method::Model(_) => {}
            Method::Splat(file) => inputs.add(file),
            Method::Renders(folder) => {
                let pictures = std::fs::read_dir(folder).into_iter().flatten().flatten();
                pictures.for_each(|picture| inputs.add_photo(&picture.path()));
            }
        }
    }

    /// How photos become what a model sees; none where no model is judged.
    pub fn input(&self) -> Option<Input> {
        match self {
            Method::Model(model) => Some(model.input),
            Method::Splat(_) | Method::Renders(_) => None,
        }
    }

    /// What context photos have to be fitted to; none where no model looks at them.
    pub(super) fn photo_size(&self) -> Option<ImageSize> {
        match self {
            Method::Model(model) => Some(model.input.photo_size(model.config.data.image_size)),
            Method::Splat(_) | Method::Renders(_) => None,
        }
    }

    /// So far; none where no model is judged.
    pub(super) fn memory(&self) -> Option<Memory> {
        match self {
            Method::Model(model) => {
                let device = device_memory_bytes(model.device);
                Some(Memory { host: peak_memory_bytes(), device })
            }
            _ => None,
        }
    }

    /// What tells a scene's splat or pictures from others in their place: names, sizes, times. Of a model it is nothing.
    pub(super) fn files(&self) -> Option<String> {
        let files: Vec<PathBuf> = match self {
            Method::Model(_) => return None,
            Method::Splat(file) => vec![file.clone()],
            Method::Renders(folder) => {
                let pictures = std::fs::read_dir(folder).ok()?;
                pictures.filter_map(|entry| Some(entry.ok()?.path())).collect()
            }
        };
        let describe = |file: &PathBuf| {
            let metadata = file.metadata().ok()?;
            let since = metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
            Some(format!("{} {} {}", file.file_name()?.display(), metadata.len(), since.as_nanos()))
        };
        let mut described: Vec<_> = files.iter().filter_map(describe).collect();
        described.sort();
        Some(format!("{:08x}", crc32fast::hash(described.join("\n").as_bytes())))
    }
}

fn of_splat(splat: &Splat, rendered: Vec<Rendered>) -> Synthesis {
    Synthesis {
        pictures: colours(&rendered),
        rendered,
        gaussians: Some(splat.gaussians.count()),
        splat_bytes: Some(splat.ply_bytes()),
        forward_seconds: None,
    }
}

/// What a method's pictures are worth, LPIPS included.
///
/// # Errors
/// A picture of another size than its view.
pub fn judge(scene: &EvalScene, made: &Synthesis, perceptual: &Perceptual) -> Result<CaptureScores> {
    judge_pictures(&scene.name, &made.pictures, &scene.target, made.gaussians, perceptual)
}

/// What pictures of the views `truth` are worth, LPIPS included.
///
/// # Errors
/// A picture of another size than its view.
pub fn judge_pictures(
    scene: &str,
    pictures: &[Tensor],
    truth: &[View],
    gaussians: Option<i64>,
    perceptual: &Perceptual,
) -> Result<CaptureScores> {
    let mut scores = score(scene, pictures, truth, gaussians)?;
    perceptual.add_to(&mut scores, pictures, truth);
    Ok(scores)
}

/// What a model that sees `context` makes of the cameras of `target`.
pub(super) fn synthesize_views(
    model: Model,
    context: &[View],
    target: &[View],
) -> Result<(Reconstruction, Vec<Rendered>)> {
    let poses: Vec<_> = target.iter().map(|view| view.camera.c2w).collect();
    let reconstruction = reconstruct(model, context, &poses)?;
    let cameras = cameras_at(target, &reconstruction.target_poses);
    let rendered = render_views(&reconstruction.gaussians, &cameras)?;
    Ok((reconstruction, rendered))
}

/// [3, H, W] each.
pub(super) fn colours(rendered: &[Rendered]) -> Vec<Tensor> {
    rendered.iter().map(|rendered| rendered.rgb.shallow_clone()).collect()
}

/// The picture `name` in `folder`, whatever its ending, [3, H, W].
fn read_picture(folder: &Path, name: &str) -> Result<Tensor> {
    let candidates = PHOTO_EXTENSIONS.map(|ending| folder.join(format!("{name}.{ending}")));
    match candidates.iter().find(|path| path.is_file()) {
        Some(path) => Ok(tensor_from_rgb(&read_image(path)?)),
        None => {
            let expected = candidates[0].display().to_string();
            Err(Error::input(folder, format!("the picture for {name}"), "absent", expected))
        }
    }
}
