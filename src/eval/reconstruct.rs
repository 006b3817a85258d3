//! Posed photos to a splat: one forward pass.

use crate::data::{View, ViewBatch, view_batch};
use crate::error::{Error, Result};
use crate::io::LoadedModel;
use crate::model::Gaussians;
use crate::render::transform;
use crate::scene::{Similarity, normalize};
use glam::DMat4;
use std::time::{Duration, Instant};

/// A splat in the normalized world, and the way to the capture's own.
#[derive(Debug)]
pub struct Reconstruction {
    /// One scene, in the normalized world.
    pub gaussians: Gaussians,
    /// Normalized world to the capture's.
    pub world_from_normalized: Similarity,
    /// The other cameras that were normalized along, camera-to-world.
    pub target_poses: Vec<DMat4>,
    /// From views in memory to Gaussians.
    pub forward_time: Duration,
}

impl Reconstruction {
    /// The splat in the capture's own world.
    pub fn in_world(&self) -> Gaussians {
        transform(&self.gaussians, &self.world_from_normalized)
    }
}

/// Runs the model over `context`. `targets` are poses (camera-to-world, in the capture's world) of views that will be asked
/// for: they take part in the normalization, as in the paper's protocol.
///
/// # Errors
/// Fewer than two views, images that the model's patches don't divide, cameras without a mean direction.
pub fn reconstruct(loaded: &LoadedModel, context: &[View], targets: &[DMat4]) -> Result<Reconstruction> {
    if context.len() < 2 {
        return Err(Error::Request(format!(
            "a reconstruction needs two views or more, found {}",
            context.len()
        )));
    }
    let poses: Vec<DMat4> =
        context.iter().map(|view| view.camera.c2w).chain(targets.iter().copied()).collect();
    let normalization = normalize(&poses)?;
    let (context_poses, target_poses) = normalization.c2w.split_at(context.len());
    let ViewBatch { images, c2w, intrinsics, .. } = view_batch(context, context_poses, loaded.vs.device());
    loaded.config.model.check_image(images.size()[3], images.size()[4])?;

    let start = Instant::now();
    let stage = loaded.config.curriculum.final_stage();
    let decoded = tch::no_grad(|| loaded.model.forward(&images, &c2w, &intrinsics, stage));
    // Bringing the Gaussians to the host also waits for a GPU.
    let gaussians = decoded.gaussians.to_device(tch::Device::Cpu);
    Ok(Reconstruction {
        gaussians,
        world_from_normalized: normalization.world_from_normalized,
        target_poses: target_poses.to_vec(),
        forward_time: start.elapsed(),
    })
}
