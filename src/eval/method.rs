//! Methods under evaluation: a model, given splats or given images, for a single scene or a whole dataset.

use super::evaluation::SceneScores;
use super::scene::EvalScene;
use crate::data::View;
use crate::error::{Error, Result};
use crate::io::{
    InputFiles, PHOTO_EXTENSIONS, Splat, checksum, find_splat, origin_file, read_image, read_splat,
    splat_files, tensor_from_rgb,
};
use crate::metrics::{CaptureScores, Perceptual, ViewScore, score_view};
use crate::reconstruct::{Model, reconstruct};
use crate::render::{RenderedView, SplatRenderer};
use crate::scene::{Camera, ImageSize, LocalFrame};
use glam::{DMat4, DVec3};
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

/// A method that produces images of a scene's target views.
#[derive(Debug, Clone)]
pub enum Method<'a> {
    /// A model, which sees the context views.
    Model(Model<'a>),
    /// A splat in the capture's own world coordinates.
    Splat(PathBuf),
    /// A folder of images named like the photos ([`crate::data::Capture::render_names`]).
    Renders(PathBuf),
}

/// Source of the images of a scene's target views.
enum ImageSource {
    /// A splat, rendered from these poses (camera-to-world, in the splat's world coordinates).
    Splat(SplatRenderer, Vec<DMat4>),
    /// A folder of images.
    Folder(PathBuf),
}

impl Method<'_> {
    /// Returns the method for scene `key`, given a method that names the folder for all scenes. The folder holds `SCENE.ply` or a splat of
    /// another format for each scene, or a folder `SCENE` or `SCENE/color` of images.
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

    /// Scores images of the scene's target views one by one, by LPIPS, too, if `perceptual` is given. Splats are rendered on `device`.
    /// `on_image` is called with every photo, the image `[3, H, W]`, its render with depth if it was rendered here, and its score.
    ///
    /// # Errors
    /// Fails if the reconstruction fails, if a splat, a photo or an image can't be read, if an image differs in size from its view, if every
    /// view is masked out, or if `on_image` fails.
    pub fn score(
        &self,
        scene: &EvalScene,
        device: Device,
        perceptual: Option<&Perceptual>,
        mut on_image: impl FnMut(&View, &Tensor, Option<&RenderedView>, &ViewScore) -> Result<()>,
    ) -> Result<SceneScores> {
        let (source, splat, forward_seconds) = match self {
            Method::Model(model) => {
                let output = reconstruct(*model, &scene.context, &scene.target_poses())?;
                let splat = output.gaussians.to_splat(DVec3::ZERO)?;
                // The normalized world is already a local frame.
                let frame = LocalFrame { origin: DVec3::ZERO, scale: 1. };
                let renderer = SplatRenderer::new(&output.gaussians, DVec3::ZERO, frame);
                let source = ImageSource::Splat(renderer.to_device(device), output.target_poses);
                (source, Some(splat), Some(output.forward_time.as_secs_f64()))
            }
            Method::Splat(file) => {
                let splat = read_splat(file)?;
                let renderer = SplatRenderer::from_splat(&splat).to_device(device);
                (ImageSource::Splat(renderer, scene.target_poses()), Some(splat), None)
            }
            Method::Renders(folder) => (ImageSource::Folder(folder.clone()), None, None),
        };
        let gaussians = splat.as_ref().map(|splat| splat.len() as i64);
        let splat_bytes = splat.as_ref().map(Splat::ply_bytes);
        let mut warnings = splat.map(|splat| splat.warnings).unwrap_or_default();
        let mut views = vec![];
        scene.for_each_target(|i, view| {
            let (image, rendered) = source.image(scene, i, view)?;
            if let Some(perceptual) = perceptual {
                // The memory of a method includes the first image, but not the networks that score it.
                perceptual.load()?;
            }
            if view.is_masked_out() {
                let (scene, view) = (&scene.name, &view.name);
                warnings
                    .push(format!("{scene}: {view} is masked out or not covered as a whole, and not scored"));
                return Ok(());
            }
            let mut score = score_view(&image, view, perceptual)?;
            score.scores.depth_error =
                rendered.as_ref().and_then(|rendered| scene.depth_error(i, view, &rendered.depth));
            on_image(view, &image, rendered.as_ref(), &score)?;
            views.push(score);
            Ok(())
        })?;
        if views.is_empty() {
            let why = format!("{}: every view to score is masked out or not covered as a whole", scene.name);
            return Err(Error::request(why));
        }
        Ok(SceneScores {
            scores: CaptureScores::from_views(&scene.name, views, gaussians),
            context: scene.frames.context.clone(),
            target: scene.frames.target.clone(),
            enlarged: scene.enlarged,
            splat_bytes,
            warnings,
            forward_seconds,
            warm_up: false,
            peak_memory_bytes: None,
            peak_device_memory_bytes: None,
        })
    }

    /// Adds the files of a splat or of images to `inputs`.
    pub fn add_input_files(&self, inputs: &mut InputFiles) {
        match self {
            Method::Model(_) => {}
            Method::Splat(file) => inputs.add_all(splat_files(file)),
            Method::Renders(folder) => {
                let images = std::fs::read_dir(folder).into_iter().flatten().flatten();
                images.for_each(|image| inputs.add_photo(&image.path()));
            }
        }
    }

    /// Returns the size that context photos have to be fitted to; `None` if no model is evaluated.
    pub(super) fn photo_size(&self) -> Option<ImageSize> {
        match self {
            Method::Model(model) => Some(model.config.data.image_size),
            Method::Splat(_) | Method::Renders(_) => None,
        }
    }

    /// Returns a checksum of the scene's splat, or of its images called `names`, by which replaced files are detected. Returns `None` for a
    /// model.
    ///
    /// # Errors
    /// Fails if a file can't be read.
    pub(super) fn checksum(&self, names: &[String]) -> Result<Option<u32>> {
        match self {
            Method::Model(_) => Ok(None),
            Method::Splat(file) => {
                let origin = Some(origin_file(file)).filter(|origin| origin.exists());
                Ok(checksum([file].into_iter().chain(&origin)).map(Some)?)
            }
            Method::Renders(folder) => {
                let files = names.iter().map(|name| find_image(folder, name));
                Ok(checksum(files.collect::<Result<Vec<_>>>()?).map(Some)?)
            }
        }
    }
}

impl ImageSource {
    /// Produces the image of target view `i` of `scene`, and its render with depth if it is rendered here.
    fn image(&self, scene: &EvalScene, i: usize, view: &View) -> Result<(Tensor, Option<RenderedView>)> {
        match self {
            ImageSource::Splat(renderer, poses) => {
                let mut rendered = renderer.render(&[Camera { c2w: poses[i], ..view.camera }])?.remove(0);
                if let Some(level) = scene.background() {
                    rendered.rgb += (1. - &rendered.alpha) * level;
                }
                Ok((rendered.rgb.shallow_clone(), Some(rendered)))
            }
            ImageSource::Folder(folder) => {
                let file = find_image(folder, &scene.render_names[i])?;
                Ok((tensor_from_rgb(&read_image(&file)?), None))
            }
        }
    }
}

/// Finds the image `name` in `folder`, with any of the known extensions.
fn find_image(folder: &Path, name: &str) -> Result<PathBuf> {
    let candidates = PHOTO_EXTENSIONS.map(|ending| folder.join(format!("{name}.{ending}")));
    let found = candidates.iter().find(|path| path.is_file()).cloned();
    found.ok_or_else(|| {
        let expected = candidates[0].display().to_string();
        Error::input(folder, format!("the image for {name}"), "missing", expected)
    })
}
