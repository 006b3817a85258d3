//! Reconstruction of a splat from posed photos: loads a model from its file, selects and fits the views, runs a forward pass, and
//! transforms the result to the capture's world.

mod color_fit;
mod context;
mod model_file;

pub use context::{context_views, load_context, spread_over_path};
pub use model_file::{
    BUNDLED_MODEL, CONFIG_KEY, LoadedModel, ModelFile, STAGE_KEY, bundled_model, load_model, model_weights,
    save_checkpoint, save_model,
};

// Used by the parity checks, too.
pub(crate) use color_fit::fit_colors;

use crate::config::Config;
use crate::data::{View, ViewBatch, cameras_at, view_batch};
use crate::error::{Error, Result};
use crate::io::Splat;
use crate::model::{GlobalSplat, Stage};
use crate::render::transform;
use crate::scene::{Camera, Gaussians, ImageSize, Similarity, normalize};
use crate::stereo::pixel_depths;
use glam::{DMat4, DVec3};
use std::time::{Duration, Instant};
use tch::{Device, Tensor};

/// Model for inference: one from a file, or one that is being trained.
#[derive(Debug, Clone, Copy)]
pub struct Model<'a> {
    /// The network.
    pub network: &'a GlobalSplat,
    /// Configuration that it was built and trained from.
    pub config: &'a Config,
    /// Curriculum stage that it was trained to.
    pub stage: Stage,
    /// Device of the weights.
    pub device: Device,
}

impl<'a> From<&'a LoadedModel> for Model<'a> {
    fn from(loaded: &'a LoadedModel) -> Self {
        let LoadedModel { model: network, config, stage, vs, .. } = loaded;
        Model { network, config, stage: *stage, device: vs.device() }
    }
}

/// Splat in the normalized world, and the transform to the capture's world.
#[derive(Debug)]
pub struct Reconstruction {
    /// Gaussians of one scene, in the normalized world.
    pub gaussians: Gaussians,
    /// Transform from the normalized world to the capture's.
    pub world_from_normalized: Similarity,
    /// Poses of the target cameras in the normalized world, camera-to-world.
    pub target_poses: Vec<DMat4>,
    /// Time from views in memory to Gaussians: depths, the forward pass and the fit of colors.
    pub forward_time: Duration,
}

impl Reconstruction {
    /// Returns the Gaussians in the capture's world, in float32. [`Reconstruction::to_splat`] keeps more detail far from the world's
    /// origin.
    pub fn in_world(&self) -> Gaussians {
        transform(&self.gaussians, &self.world_from_normalized)
    }

    /// Returns the splat in the capture's world, with the mean camera as the origin of its coordinates.
    ///
    /// # Errors
    /// Fails if there is more than one scene.
    pub fn to_splat(&self) -> Result<Splat> {
        let (gaussians, origin) = self.in_world_about_origin();
        gaussians.to_splat(origin)
    }

    /// Returns the Gaussians in the capture's world like [`Reconstruction::in_world`], but with means relative to the mean camera, whose
    /// position is the second value.
    pub fn in_world_about_origin(&self) -> (Gaussians, DVec3) {
        let about_origin = Similarity { translation: DVec3::ZERO, ..self.world_from_normalized };
        (transform(&self.gaussians, &about_origin), self.world_from_normalized.translation)
    }
}

/// Runs the model once over `photos`, all of one size. If its configuration has `data.depths`, the model gets the photos' depths, too;
/// `data.color_steps` steps fit the colors to the photos afterwards. `targets` are poses (camera-to-world, in the capture's world) of
/// target views: they take part in the normalization, as in the paper's protocol.
///
/// # Errors
/// Fails with fewer than two photos, with images whose sides aren't multiples of the model's patch size, or if rendering to the photos'
/// cameras fails.
///
/// ```no_run
/// use globalsplat::data::{Holdout, open_capture};
/// use globalsplat::io::write_splat;
/// use globalsplat::reconstruct::{load_context, load_model, reconstruct};
///
/// # fn main() -> globalsplat::Result<()> {
/// let model = load_model("model.safetensors".as_ref(), tch::Device::Cpu)?;
/// let capture = open_capture("captures/room".as_ref())?;
/// // As many photos as the model was configured for, resized to the size of its images.
/// let data = &model.config.data;
/// let photos = load_context(&capture, Holdout::None, Some(data.context_views), data.image_size)?;
/// let reconstruction = reconstruct(&model, &photos, &[])?;
/// write_splat("room.ply".as_ref(), &reconstruction.to_splat()?)?;
/// # Ok(())
/// # }
/// ```
pub fn reconstruct<'a>(
    model: impl Into<Model<'a>>,
    photos: &[View],
    targets: &[DMat4],
) -> Result<Reconstruction> {
    let model = model.into();
    if photos.len() < 2 {
        return Err(Error::request(format!(
            "a reconstruction needs two views or more, found {}",
            photos.len()
        )));
    }
    let poses: Vec<DMat4> =
        photos.iter().map(|photo| photo.camera.c2w).chain(targets.iter().copied()).collect();
    let normalization = normalize(&poses)?;
    let data = &model.config.data;
    let start = Instant::now();
    let (poses, target_poses) = normalization.c2w.split_at(photos.len());
    let mut batch = view_batch(photos, poses, model.device);
    if data.depths {
        let depths = depths_of(&batch, &cameras_at(photos, poses), data.image_size);
        batch.depths = Some(depths.unsqueeze(0).to_device(model.device));
    }
    let mut gaussians = run_model(model, &batch)?;
    if data.color_steps > 0 {
        gaussians = fit_colors(&gaussians, &batch, data.color_steps)?;
    }
    // The results are written to files later. This copy waits for a GPU.
    let gaussians = gaussians.to_device(Device::Cpu);
    Ok(Reconstruction {
        gaussians,
        world_from_normalized: normalization.world_from_normalized,
        target_poses: target_poses.to_vec(),
        forward_time: start.elapsed(),
    })
}

/// Returns the depths of `views` of one scene, which `cameras` show, resized to `size`, [V, 2, H, W] on the CPU ([`pixel_depths`]).
fn depths_of(views: &ViewBatch, cameras: &[Camera], size: ImageSize) -> Tensor {
    let of_scene = |t: &Tensor| t.get(0).to_device(Device::Cpu);
    let masks = views.masks.as_ref().map(of_scene);
    let depths = pixel_depths(&of_scene(&views.images), masks.as_ref(), cameras);
    let size = [i64::from(size.height), i64::from(size.width)];
    if depths.size()[2..] == size { depths } else { depths.upsample_bilinear2d(size, false, None, None) }
}

/// Runs the model over `views`, which are on its device and in a normalized world.
fn run_model(model: Model, views: &ViewBatch) -> Result<Gaussians> {
    let Model { network, config, stage, .. } = model;
    let input = views.model_input();
    config.model.check_image(input.images.size()[3], input.images.size()[4])?;
    Ok(tch::no_grad(|| network.forward(&input, stage)).gaussians)
}
