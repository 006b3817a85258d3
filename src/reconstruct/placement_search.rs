//! Search for the size and position at which a model sees a scene: the best of several by the error on the input photos (spec 9.9).

use super::{Model, Reconstruction, pass};
use crate::data::{View, cameras_at, view_batch};
use crate::error::Result;
use crate::loss::{masked_mse, mse};
use crate::render::{RenderedView, render_views};
use crate::scene::{Gaussians, ImageSize, Normalization, Placement};
use crate::stereo::pixel_depths;
use glam::DMat4;
use std::time::Instant;
use tch::{Device, Kind, Tensor};

/// Changes of a placement that the search tries: forward shift of the cameras, and the logarithm of the factor that enlarges the scene.
const SEARCH_OFFSETS: [[f64; 2]; 2] = [[0.15, 0.], [0., 0.1]];

/// Factors of the changes in each round.
const ROUNDS: [f64; 2] = [1., 0.5];

/// Runs the model over `views`, the views of each photo, at each of `data.scene_scales` and at placements around the best of them. Returns
/// the result that matches `photos` best. `normalization` has the poses of the photos, followed by those of the targets.
///
/// # Errors
/// Fails if a pass or rendering fails.
pub(super) fn search_placement(
    model: Model,
    photos: &[View],
    views: &[Vec<View>],
    normalization: &Normalization,
) -> Result<Reconstruction> {
    let extents = &model.config.data.scene_scales;
    let several = extents.len() > 1;
    let start = Instant::now();
    let depths =
        model.config.data.depths.then(|| depths_of(photos, &normalization.c2w, model.config.data.image_size));
    let attempt = |placement: Placement| -> Result<Attempt> {
        let poses = &normalization.with_placement(placement).c2w[..photos.len()];
        // Inverse depths shrink as the scene grows, and how sure they are doesn't.
        let scale = Tensor::from_slice(&[1. / placement.extent, 1.]).to_kind(Kind::Float).view([2, 1, 1]);
        let depths = depths.as_ref().map(|depths| depths * scale);
        let gaussians = pass(model, views, poses, depths.as_ref())?;
        let error = if several { error_of(&gaussians, photos, poses)? } else { 0. };
        Ok(Attempt { error, placement, gaussians })
    };

    let mut attempts = extents.iter().map(|&extent| attempt(Placement { extent, forward: 0. }));
    let mut best = attempts.next().expect("a configuration that was checked has an extent")?;
    for tried in attempts {
        best.replace_if_better(tried?);
    }
    for share in ROUNDS.into_iter().filter(|_| several) {
        for nudge in SEARCH_OFFSETS {
            for way in [share, -share] {
                if best.replace_if_better(attempt(best.placement.with_offset(nudge.map(|by| way * by)))?) {
                    break;
                }
            }
        }
    }
    let Attempt { placement, gaussians, .. } = best;
    // The results are written to files later. This copy waits for a GPU.
    let gaussians = gaussians.to_device(Device::Cpu);
    let forward_time = start.elapsed();
    let Normalization { c2w, world_from_normalized } = normalization.with_placement(placement);
    let target_poses = c2w[photos.len()..].to_vec();
    Ok(Reconstruction { gaussians, placement, world_from_normalized, target_poses, forward_time })
}

/// Returns the depths of `photos` with `poses` in a normalized world, resized to `size`, [V, 2, H, W] ([`pixel_depths`]).
fn depths_of(photos: &[View], poses: &[DMat4], size: ImageSize) -> Tensor {
    let batch = view_batch(photos, &poses[..photos.len()], Device::Cpu);
    let masks = batch.masks.map(|masks| masks.get(0));
    let depths = pixel_depths(&batch.images.get(0), masks.as_ref(), &cameras_at(photos, poses));
    let size = [i64::from(size.height), i64::from(size.width)];
    if depths.size()[2..] == size { depths } else { depths.upsample_bilinear2d(size, false, None, None) }
}

/// Result of one pass.
struct Attempt {
    /// Mean squared error of the rendered images against the photos; 0 if there is no other attempt.
    error: f64,
    placement: Placement,
    gaussians: Gaussians,
}

impl Attempt {
    /// Replaces this attempt by `other` if that is better, and returns `true` if it was. Any error is better than NaN.
    fn replace_if_better(&mut self, other: Attempt) -> bool {
        let better = other.error < self.error || (self.error.is_nan() && !other.error.is_nan());
        if better {
            *self = other;
        }
        better
    }
}

/// Returns the mean squared error of `gaussians`, rendered from the photos' `poses`, against the pixels of the photos that count.
fn error_of(gaussians: &Gaussians, photos: &[View], poses: &[DMat4]) -> Result<f64> {
    let rendered = render_views(gaussians, &cameras_at(photos, poses))?;
    let error = |(made, photo): (&RenderedView, &View)| {
        let there = |t: &Tensor| t.to_device(made.rgb.device());
        let error = match &photo.mask {
            Some(mask) => masked_mse(&made.rgb, &there(&photo.image.to_float()), &there(&mask.to_float())),
            None => mse(&made.rgb, &there(&photo.image.to_float())),
        };
        error.double_value(&[])
    };
    let errors = rendered.iter().zip(photos).map(error);
    Ok(errors.sum::<f64>() / photos.len() as f64)
}
