//! In which size and place a model sees a scene: the best of several, judged by the photos that it is shown (spec 9.9).

use super::{Model, Reconstruction, pass};
use crate::data::{View, cameras_at};
use crate::error::Result;
use crate::loss::mse;
use crate::model::Encoded;
use crate::render::{Rendered, render_views};
use crate::scene::{Gaussians, Normalization, Placement};
use glam::DMat4;
use std::time::Instant;
use tch::Device;

/// What a placement is changed by: cameras are moved forward, and then the scene is enlarged, by a factor's logarithm.
const NUDGES: [[f64; 2]; 2] = [[0.15, 0.], [0., 0.1]];

/// How far, one round after the other.
const ROUNDS: [f64; 2] = [1., 0.5];

/// Of what the model makes of `views`, those of each photo, in each of `data.extents` and around the best of them, that which
/// shows `photos` best. `normalization` has the poses of photos and then of targets.
///
/// # Errors
/// Those of a pass and of rendering.
pub(super) fn best_placed(
    model: Model,
    photos: &[View],
    views: &[Vec<View>],
    normalization: &Normalization,
) -> Result<Reconstruction> {
    let extents = &model.config.data.extents;
    let several = extents.len() > 1;
    let start = Instant::now();
    let attempt = |placement: Placement| -> Result<Attempt> {
        let poses = &normalization.placed(placement).c2w[..photos.len()];
        let (tokens, gaussians) = pass(model, views, poses)?;
        let error = if several { error_of(&gaussians, photos, poses)? } else { 0. };
        Ok(Attempt { error, placement, tokens, gaussians })
    };

    let mut attempts = extents.iter().map(|&extent| attempt(Placement { extent, forward: 0. }));
    let mut best = attempts.next().expect("a configuration that was checked has an extent")?;
    for tried in attempts {
        best.give_way(tried?);
    }
    for share in ROUNDS.into_iter().filter(|_| several) {
        for nudge in NUDGES {
            for way in [share, -share] {
                if best.give_way(attempt(best.placement.nudged(nudge.map(|by| way * by)))?) {
                    break;
                }
            }
        }
    }
    let Attempt { placement, tokens, gaussians, .. } = best;
    // To be written to files. This waits for a GPU.
    let gaussians = gaussians.to_device(Device::Cpu);
    let forward_time = start.elapsed();
    let Normalization { c2w, world_from_normalized } = normalization.placed(placement);
    let target_poses = c2w[photos.len()..].to_vec();
    Ok(Reconstruction { tokens, gaussians, placement, world_from_normalized, target_poses, forward_time })
}

/// What a pass made.
struct Attempt {
    /// Of its pictures beside the photos; 0 where there is no other attempt.
    error: f64,
    placement: Placement,
    tokens: Encoded,
    gaussians: Gaussians,
}

impl Attempt {
    /// Becomes `other` if that is better, and tells whether. Any number is better than NaN.
    fn give_way(&mut self, other: Attempt) -> bool {
        let better = other.error < self.error || (self.error.is_nan() && !other.error.is_nan());
        if better {
            *self = other;
        }
        better
    }
}

/// Of `gaussians` seen from the photos' `poses` beside the photos: the mean squared error.
fn error_of(gaussians: &Gaussians, photos: &[View], poses: &[DMat4]) -> Result<f64> {
    let rendered = render_views(gaussians, &cameras_at(photos, poses))?;
    let error = |(made, photo): (&Rendered, &View)| {
        mse(&made.rgb, &photo.image.to_device(made.rgb.device())).double_value(&[])
    };
    let errors = rendered.iter().zip(photos).map(error);
    Ok(errors.sum::<f64>() / photos.len() as f64)
}
