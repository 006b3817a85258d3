//! What is judged: a model, somebody's splats, somebody's pictures; by one scene as by a data set.

use super::memory::{device_memory_bytes, peak_memory_bytes};
use super::perceptual::Perceptual;
use super::scene::EvalScene;
use super::scores::{CaptureScores, ViewScore, score_view};
use crate::data::View;
use crate::error::{Error, Result};
use crate::io::{
    Inputs, PHOTO_EXTENSIONS, Splat, checksum, find_splat, origin_file, read_image, read_splat,
    tensor_from_rgb,
};
use crate::reconstruct::{Input, Model, reconstruct};
use crate::render::{Rendered, SplatRenderer};
use crate::scene::{Camera, ImageSize, LocalFrame};
use glam::{DMat4, DVec3};
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

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

/// What a method makes of a scene. Its pictures of the target views come one by one: the first is made at once, and the others when
/// [`judge`] asks for them.
#[derive(Debug)]
pub struct Synthesis {
    /// The scene.
    pub scene: EvalScene,
    source: PictureSource,
    /// Until it is judged.
    first: Option<(View, Picture)>,
    /// Of the splat, where there is one.
    pub gaussians: Option<i64>,
    /// Of the PLY that the splat is, or would be.
    pub splat_bytes: Option<u64>,
    /// Of a model's forward pass, or passes.
    pub forward_seconds: Option<f64>,
    /// What was left out of the splat's file, a sentence each.
    pub warnings: Vec<String>,
}

/// Where pictures of the target views come from.
#[derive(Debug)]
enum PictureSource {
    /// A splat, rendered from these poses (camera-to-world, in the splat's world).
    Splat(SplatRenderer, Vec<DMat4>),
    /// A folder of pictures.
    Folder(PathBuf),
}

/// A picture of a target view.
#[derive(Debug)]
pub struct Picture {
    /// [3, H, W].
    pub rgb: Tensor,
    /// The same with depth, where a splat was rendered here.
    pub rendered: Option<Rendered>,
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

    /// Makes pictures of the scene's target views, rendered on `device`, the first of them at once.
    ///
    /// # Errors
    /// Whatever the reconstruction fails with, a splat that can't be read, a first photo or picture that can't.
    pub fn synthesize(&self, scene: EvalScene, device: Device) -> Result<Synthesis> {
        let (source, splat, forward_seconds) = match self {
            Method::Model(model) => {
                let made = reconstruct(*model, &scene.context, &scene.target.poses())?;
                let splat = Splat::of(&made.gaussians)?;
                // The normalized world is a local frame already.
                let frame = LocalFrame { origin: DVec3::ZERO, scale: 1. };
                let renderer = SplatRenderer::new(&made.gaussians, DVec3::ZERO, frame);
                let source = PictureSource::Splat(renderer.to_device(device), made.target_poses);
                (source, Some(splat), Some(made.forward_time.as_secs_f64()))
            }
            Method::Splat(file) => {
                let splat = read_splat(file)?;
                let renderer = splat.renderer().to_device(device);
                (PictureSource::Splat(renderer, scene.target.poses()), Some(splat), None)
            }
            Method::Renders(folder) => (PictureSource::Folder(folder.clone()), None, None),
        };
        Ok(Synthesis {
            first: Some(source.picture(&scene, 0)?),
            scene,
            source,
            gaussians: splat.as_ref().map(|splat| splat.gaussians.count()),
            splat_bytes: splat.as_ref().map(Splat::ply_bytes),
            forward_seconds,
            warnings: splat.map(|splat| splat.warnings).unwrap_or_default(),
        })
    }

    /// Adds the files of a splat or pictures to `inputs`.
    pub fn add_inputs(&self, inputs: &mut Inputs) {
        match self {
            Method::Model(_) => {}
            Method::Splat(file) => inputs.add_splat(file),
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

    /// Returns a checksum of what a scene's splat or pictures called `names` hold, by which they are told from others in their place.
    /// Of a model it is nothing.
    ///
    /// # Errors
    /// A file that can't be read.
    pub(super) fn checksum(&self, names: &[String]) -> Result<Option<u32>> {
        match self {
            Method::Model(_) => Ok(None),
            Method::Splat(file) => {
                let origin = Some(origin_file(file)).filter(|origin| origin.exists());
                checksum([file].into_iter().chain(&origin)).map(Some)
            }
            Method::Renders(folder) => {
                let files = names.iter().map(|name| find_picture(folder, name));
                checksum(files.collect::<Result<Vec<_>>>()?).map(Some)
            }
        }
    }
}

impl PictureSource {
    /// Makes the picture of target view `i` of `scene`, and loads its photo.
    fn picture(&self, scene: &EvalScene, i: usize) -> Result<(View, Picture)> {
        let truth = scene.target.load(i)?;
        let picture = match self {
            PictureSource::Splat(renderer, poses) => {
                let camera = Camera { c2w: poses[i], ..truth.camera };
                let rendered = renderer.render(&[camera])?.remove(0);
                Picture { rgb: rendered.rgb.shallow_clone(), rendered: Some(rendered) }
            }
            PictureSource::Folder(folder) => {
                let file = find_picture(folder, &scene.picture_names[i])?;
                Picture { rgb: tensor_from_rgb(&read_image(&file)?), rendered: None }
            }
        };
        Ok((truth, picture))
    }
}

/// Scores a method's pictures one by one, LPIPS included. `see` is shown every photo with its picture and score.
///
/// # Errors
/// A photo or picture that can't be read, a picture of another size than its view, and those of `see`.
pub fn judge(
    made: &mut Synthesis,
    perceptual: &Perceptual,
    mut see: impl FnMut(&View, &Picture, &ViewScore) -> Result<()>,
) -> Result<CaptureScores> {
    let Synthesis { scene, source, first, gaussians, .. } = made;
    let mut scores = vec![];
    for i in 0..scene.target.len() {
        let (truth, picture) = first.take().map_or_else(|| source.picture(scene, i), Ok)?;
        let score = perceptual.add_to(score_view(&picture.rgb, &truth)?, &picture.rgb, &truth);
        see(&truth, &picture, &score)?;
        scores.push(score);
    }
    Ok(CaptureScores::of(&scene.name, scores, *gaussians))
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
    let score =
        |(picture, view): (&Tensor, &View)| Ok(perceptual.add_to(score_view(picture, view)?, picture, view));
    let scores = pictures.iter().zip(truth).map(score).collect::<Result<_>>()?;
    Ok(CaptureScores::of(scene, scores, gaussians))
}

/// Finds the picture `name` in `folder`, whatever its ending.
fn find_picture(folder: &Path, name: &str) -> Result<PathBuf> {
    let candidates = PHOTO_EXTENSIONS.map(|ending| folder.join(format!("{name}.{ending}")));
    let found = candidates.iter().find(|path| path.is_file()).cloned();
    found.ok_or_else(|| {
        let expected = candidates[0].display().to_string();
        Error::input(folder, format!("the picture for {name}"), "absent", expected)
    })
}
