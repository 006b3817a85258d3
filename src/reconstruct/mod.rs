//! Posed photos to a splat: a model from its file, views that are chosen and fitted, a forward pass, and the way back to the
//! capture's world.

mod context;
mod input;
mod model_file;
mod placing;
mod published;
mod spread;

pub use context::{context_views, load_context};
pub use input::{Input, ViewsAs};
pub use model_file::{
    CONFIG_KEY, LoadedModel, ModelDtype, ModelFile, SHIPPED_MODEL, STAGE_KEY, load_model, model_weights,
    save_checkpoint, save_model, shipped_model,
};

pub use spread::spread_over_path;

use crate::config::Config;
use crate::data::{View, ViewBatch, view_batch};
use crate::error::{Error, Result};
use crate::io::{LentWeights, Splat};
use crate::model::{Encoded, Event, GlobalSplat, Stage, told};
use crate::render::transform;
use crate::scene::{Gaussians, Placement, Similarity, normalize};
use glam::{DMat4, DVec3};
use placing::best_placed;
use std::time::Duration;
use tch::Device;

/// A model to be used: one from a file, or one that is being trained.
#[derive(Debug, Clone, Copy)]
pub struct Model<'a> {
    /// The network.
    pub network: &'a GlobalSplat,
    /// What it was built and trained from.
    pub config: &'a Config,
    /// To which it was trained.
    pub stage: Stage,
    /// Where the weights are.
    pub device: Device,
    /// What it sees of a photo.
    pub input: Input,
    /// What its weights lie in, if they weren't copied.
    pub lent: Option<LentWeights>,
}

impl<'a> From<&'a LoadedModel> for Model<'a> {
    fn from(loaded: &'a LoadedModel) -> Self {
        let LoadedModel { model: network, config, stage, vs, lent, .. } = loaded;
        Model { network, config, stage: *stage, device: vs.device(), input: Input::PLAIN, lent: *lent }
    }
}

/// A splat in the normalized world, and the way to the capture's own.
#[derive(Debug)]
pub struct Reconstruction {
    /// What the Gaussians were decoded from.
    pub tokens: Encoded,
    /// One scene, in the normalized world.
    pub gaussians: Gaussians,
    /// Where in the normalized world the cameras were.
    pub placement: Placement,
    /// Normalized world to the capture's.
    pub world_from_normalized: Similarity,
    /// The other cameras that were normalized along, camera-to-world.
    pub target_poses: Vec<DMat4>,
    /// From views in memory to Gaussians, all passes together.
    pub forward_time: Duration,
}

impl Reconstruction {
    /// Returns the Gaussians in the capture's own world, in float32; [`Reconstruction::to_splat`] keeps their detail far from the
    /// world's origin.
    pub fn in_world(&self) -> Gaussians {
        transform(&self.gaussians, &self.world_from_normalized)
    }

    /// Returns the splat in the capture's own world, with the mean camera as the origin of its coordinates.
    ///
    /// # Errors
    /// More scenes than one.
    pub fn to_splat(&self) -> Result<Splat> {
        let about_origin = Similarity { translation: DVec3::ZERO, ..self.world_from_normalized };
        let splat = Splat::of(&transform(&self.gaussians, &about_origin))?;
        Ok(Splat { origin: self.world_from_normalized.translation, ..splat })
    }
}

/// Runs the model over `photos`, which become the views that it sees ([`Input`]). Where its configuration has several
/// `data.extents` it is shown the scene in each of these sizes, and nudged, and the splat that shows the photos best is kept.
/// `targets` are poses (camera-to-world, in the capture's world) of target views: they take part in the normalization, as in the
/// paper's protocol. A photo does so once, whatever it becomes.
///
/// # Errors
/// Fewer than two photos, images that the model's patches don't divide, photos that can't be rendered.
pub fn reconstruct<'a>(
    model: impl Into<Model<'a>>,
    photos: &[View],
    targets: &[DMat4],
) -> Result<Reconstruction> {
    let model = model.into();
    if photos.len() < 2 {
        return Err(Error::Request(format!(
            "a reconstruction needs two views or more, found {}",
            photos.len()
        )));
    }
    let poses: Vec<DMat4> =
        photos.iter().map(|photo| photo.camera.c2w).chain(targets.iter().copied()).collect();
    let normalization = normalize(&poses)?;
    let views = photos.iter().map(|photo| model.input.views(photo)).collect::<Result<Vec<_>>>()?;
    best_placed(model, photos, &views, &normalization)
}

/// What the model makes of `views`, those of each photo, seen from the photos' `poses` in a normalized world, on the model's device.
fn pass(model: Model, views: &[Vec<View>], poses: &[DMat4]) -> Result<(Encoded, Gaussians)> {
    let Model { network, config, stage, device, lent, .. } = model;
    let posed =
        views.iter().zip(poses).flat_map(|(of_photo, &pose)| of_photo.iter().map(move |view| (view, pose)));
    let (views, poses): (Vec<&View>, Vec<DMat4>) = posed.unzip();
    let ViewBatch { images, c2w, intrinsics, .. } = view_batch(&views, &poses, device);
    config.model.check_image(images.size()[3], images.size()[4])?;
    let pass = || {
        let memory = network.memory(&images, &c2w, &intrinsics);
        drop(images);
        let encoded = network.encode_memory(&memory);
        drop(memory);
        let decoded = network.decode(&encoded, stage);
        (encoded, decoded)
    };
    let (encoded, decoded) = tch::no_grad(|| match lent {
        // A pass needs nearly every weight once.
        Some(lent) => told(
            move |event| {
                if let Event::Begins(_) = event {
                    lent.let_go()
                }
            },
            pass,
        ),
        None => pass(),
    });
    Ok((encoded, decoded.gaussians))
}
