//! Methods under evaluation: a model, given splats or given images, for a single scene or a whole dataset, and baselines that only copy
//! context photos.

use super::scene::{EvalScene, LazyPhotos};
use crate::data::View;
use crate::device::{peak_device_memory_bytes, peak_memory_bytes};
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

/// Result of a method for a scene. The first image of a target view is rendered at once, the others one by one when [`score_output`] needs
/// them.
#[derive(Debug)]
pub struct MethodOutput {
    /// Scene with its context and target views.
    pub scene: EvalScene,
    source: EvalImageSource,
    /// Photo and image of the first target view, until [`score_output`] takes them.
    first: Option<(View, EvalImage)>,
    /// Number of Gaussians of the splat; `None` if there is no splat.
    pub gaussians: Option<i64>,
    /// Size in bytes of the splat as a PLY, whatever its format; `None` if there is no splat.
    pub splat_bytes: Option<u64>,
    /// Time in seconds of the model's forward pass, or passes; `None` if no model was run.
    pub forward_seconds: Option<f64>,
    /// Warnings about data that was left out of the splat's file, a sentence each.
    pub warnings: Vec<String>,
}

/// Source of the images of the target views.
#[derive(Debug)]
enum EvalImageSource {
    /// A splat, rendered from these poses (camera-to-world, in the splat's world coordinates).
    Splat(SplatRenderer, Vec<DMat4>),
    /// A folder of images.
    Folder(PathBuf),
}

/// An image of a target view.
#[derive(Debug)]
pub struct EvalImage {
    /// Colors, `[3, H, W]`.
    pub rgb: Tensor,
    /// Render with depth, if the image was rendered from a splat here.
    pub rendered: Option<RenderedView>,
}

/// Peak memory of a model, in bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct PeakMemory {
    pub host: u64,
    pub device: Option<u64>,
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

    /// Produces images of the scene's target views, rendered on `device`. The first of them is rendered at once.
    ///
    /// # Errors
    /// Fails if the reconstruction fails, or if the splat, the first photo or the first image can't be read.
    pub fn render_targets(&self, scene: EvalScene, device: Device) -> Result<MethodOutput> {
        let (source, splat, forward_seconds) = match self {
            Method::Model(model) => {
                let output = reconstruct(*model, &scene.context, &scene.target.poses())?;
                let splat = output.gaussians.to_splat(DVec3::ZERO)?;
                // The normalized world is already a local frame.
                let frame = LocalFrame { origin: DVec3::ZERO, scale: 1. };
                let renderer = SplatRenderer::new(&output.gaussians, DVec3::ZERO, frame);
                let source = EvalImageSource::Splat(renderer.to_device(device), output.target_poses);
                (source, Some(splat), Some(output.forward_time.as_secs_f64()))
            }
            Method::Splat(file) => {
                let splat = read_splat(file)?;
                let renderer = SplatRenderer::from_splat(&splat).to_device(device);
                (EvalImageSource::Splat(renderer, scene.target.poses()), Some(splat), None)
            }
            Method::Renders(folder) => (EvalImageSource::Folder(folder.clone()), None, None),
        };
        Ok(MethodOutput {
            first: Some(source.load_target(&scene, 0)?),
            scene,
            source,
            gaussians: splat.as_ref().map(|splat| splat.len() as i64),
            splat_bytes: splat.as_ref().map(Splat::ply_bytes),
            forward_seconds,
            warnings: splat.map(|splat| splat.warnings).unwrap_or_default(),
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

    /// Returns the peak memory so far; `None` if no model is evaluated.
    pub(super) fn memory(&self) -> Option<PeakMemory> {
        match self {
            Method::Model(model) => {
                let device = peak_device_memory_bytes(model.device);
                Some(PeakMemory { host: peak_memory_bytes(), device })
            }
            _ => None,
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

impl EvalImageSource {
    /// Produces the image of target view `i` of `scene`, and loads its photo.
    fn load_target(&self, scene: &EvalScene, i: usize) -> Result<(View, EvalImage)> {
        let ground_truth = scene.target.load(i)?;
        let image = match self {
            EvalImageSource::Splat(renderer, poses) => {
                let camera = Camera { c2w: poses[i], ..ground_truth.camera };
                let rendered = renderer.render(&[camera])?.remove(0);
                EvalImage { rgb: rendered.rgb.shallow_clone(), rendered: Some(rendered) }
            }
            EvalImageSource::Folder(folder) => {
                let file = find_image(folder, &scene.render_names[i])?;
                EvalImage { rgb: tensor_from_rgb(&read_image(&file)?), rendered: None }
            }
        };
        Ok((ground_truth, image))
    }
}

/// Scores the images of a method one by one, including LPIPS. `see` is called with every photo, its image and its score.
///
/// # Errors
/// Fails if a photo or an image can't be read, if an image differs in size from its view, or if `see` fails.
pub fn score_output(
    output: &mut MethodOutput,
    perceptual: &Perceptual,
    mut see: impl FnMut(&View, &EvalImage, &ViewScore) -> Result<()>,
) -> Result<CaptureScores> {
    let MethodOutput { scene, source, first, gaussians, warnings, .. } = output;
    let mut scores = vec![];
    for i in 0..scene.target.len() {
        let (ground_truth, image) = first.take().map_or_else(|| source.load_target(scene, i), Ok)?;
        if ground_truth.is_masked_out() {
            warnings.push(format!(
                "{}: {} is masked out as a whole, and not scored",
                scene.name, ground_truth.name
            ));
            continue;
        }
        let score = score_view(&image.rgb, &ground_truth, Some(perceptual))?;
        see(&ground_truth, &image, &score)?;
        scores.push(score);
    }
    if scores.is_empty() {
        return Err(Error::request(format!("{}: every view to score is masked out as a whole", scene.name)));
    }
    Ok(CaptureScores::from_views(&scene.name, scores, *gaussians))
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

/// Scores of two baselines that only copy context photos, for the target views of a scene.
#[derive(Debug, Clone)]
pub struct Baselines {
    /// Scores of the nearest context photo.
    pub nearest_photo: CaptureScores,
    /// Scores of the mean of all context photos.
    pub mean_photo: CaptureScores,
}

impl Baselines {
    /// Scores the baselines on the targets of a scene. All photos have the same size, and there is at least one context photo.
    ///
    /// # Errors
    /// Fails if photos differ in size or can't be read.
    pub fn compute(scene: &str, context: &LazyPhotos, target: &LazyPhotos) -> Result<Self> {
        let mut sum = context.load(0)?.image.to_float().copy();
        for i in 1..context.len() {
            sum += context.load(i)?.image.to_float();
        }
        let mean = sum / context.len() as f64;
        let mut means = vec![];
        for i in 0..target.len() {
            let view = target.load(i)?;
            if !view.is_masked_out() {
                means.push(score_view(&mean, &view, None)?);
            }
        }
        Ok(Baselines {
            nearest_photo: nearest_context_baseline(scene, context, target)?,
            mean_photo: CaptureScores::from_views(scene, means, None),
        })
    }
}

/// Scores, for every target view, the context photo whose camera center is nearest.
pub(super) fn nearest_context_baseline(
    scene: &str,
    context: &LazyPhotos,
    target: &LazyPhotos,
) -> Result<CaptureScores> {
    let centers = |photos: &LazyPhotos| -> Vec<DVec3> {
        photos.poses().iter().map(|pose| pose.w_axis.truncate()).collect()
    };
    let shown = centers(context);
    let mut scores = vec![];
    for (i, center) in centers(target).into_iter().enumerate() {
        let distance = |&photo: &usize| shown[photo].distance(center);
        let nearest = (0..shown.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let nearest = context.load(nearest.expect("a context view"))?;
        let view = target.load(i)?;
        if !view.is_masked_out() {
            scores.push(score_view(&nearest.image.to_float(), &view, None)?);
        }
    }
    Ok(CaptureScores::from_views(scene, scores, None))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::View;
    use crate::scene::{Camera, Intrinsics};
    use glam::DMat4;
    use tch::{Device, Kind, Tensor};

    #[test]
    fn baselines_are_the_nearest_photo_and_the_mean() {
        let intrinsics = Intrinsics { fx: 16., fy: 16., cx: 8., cy: 8. };
        let view = |at: f64, gray: f64| View {
            name: String::new(),
            image: Tensor::full([3, 16, 16], gray, (Kind::Float, Device::Cpu)).into(),
            mask: None,
            camera: Camera { intrinsics, c2w: DMat4::from_translation(DVec3::X * at), width: 8, height: 8 },
        };
        let photos = LazyPhotos::Loaded;
        let (context, target) = (photos(vec![view(0., 0.2), view(1., 0.6)]), photos(vec![view(0.7, 0.7)]));
        let baselines = Baselines::compute("", &context, &target).unwrap();
        assert!((baselines.nearest_photo.mean.psnr - 20.).abs() < 1e-4, "0.1 apart");
        assert!((baselines.mean_photo.mean.psnr - 20. * (1f64 / 0.3).log10()).abs() < 1e-4, "0.3 apart");
    }
}
