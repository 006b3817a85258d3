//! In which size and place a model sees a scene: the best of several, judged by the photos that it is shown (spec 9.9).

use super::{Model, Reconstruction, pass};
use crate::data::View;
use crate::error::{Error, Result};
use crate::loss::mse;
use crate::render::render_views;
use crate::scene::{Camera, Gaussians, Normalization, Placement};
use glam::DMat4;
use std::time::Instant;

/// What a placement is changed by: cameras are moved forward, and then the scene is enlarged, by a factor's logarithm.
const NUDGES: [[f64; 2]; 2] = [[0.15, 0.], [0., 0.1]];

/// How far, one round after the other.
const ROUNDS: [f64; 2] = [1., 0.5];

/// Of what the model makes of `views`, those of each photo, in each of `data.extents` and around the best of them, that which
/// shows `photos` best. `normalization` has the poses of photos and then of targets.
///
/// # Errors
/// Those of a pass and of rendering; no extents at all.
pub(super) fn best_placed(
    model: Model,
    photos: &[View],
    views: &[Vec<View>],
    normalization: &Normalization,
) -> Result<Reconstruction> {
    let extents = &model.config.data.extents;
    let several = extents.len() > 1;
    let start = Instant::now();
    let attempt = |placement: Placement| -> Result<(f64, Reconstruction)> {
        let Normalization { c2w, world_from_normalized } = normalization.placed(placement);
        let (photo_poses, target_poses) = c2w.split_at(photos.len());
        let (tokens, gaussians) = pass(model, views, photo_poses)?;
        let error = if several { error_of(&gaussians, photos, photo_poses)? } else { 0. };
        let (target_poses, forward_time) = (target_poses.to_vec(), start.elapsed());
        let made = Reconstruction {
            tokens,
            gaussians,
            placement,
            world_from_normalized,
            target_poses,
            forward_time,
        };
        Ok((error, made))
    };

    let mut best: Option<(f64, Reconstruction)> = None;
    for &extent in extents {
        let tried = attempt(Placement { extent, forward: 0. })?;
        if best.as_ref().is_none_or(|(least, _)| tried.0.total_cmp(least).is_lt()) {
            best = Some(tried);
        }
    }
    let mut best = best.ok_or_else(|| Error::setting("data.extents", "[]", "one or more numbers above 0"))?;
    for share in ROUNDS.into_iter().filter(|_| several) {
        for nudge in NUDGES {
            for way in [share, -share] {
                let tried = attempt(best.1.placement.nudged(nudge.map(|by| way * by)))?;
                if tried.0 < best.0 {
                    best = tried;
                    break;
                }
            }
        }
    }
    Ok(Reconstruction { forward_time: start.elapsed(), ..best.1 })
}

/// Of `gaussians` seen from the photos' `poses` beside the photos: the mean squared error.
fn error_of(gaussians: &Gaussians, photos: &[View], poses: &[DMat4]) -> Result<f64> {
    let cameras: Vec<Camera> =
        photos.iter().zip(poses).map(|(photo, &c2w)| Camera { c2w, ..photo.camera }).collect();
    let rendered = render_views(gaussians, &cameras)?;
    let errors =
        rendered.iter().zip(photos).map(|(made, photo)| mse(&made.rgb, &photo.image).double_value(&[]));
    Ok(errors.sum::<f64>() / photos.len() as f64)
}
