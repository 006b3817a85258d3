//! Camera paths for looking at a result.

use super::camera::{Camera, look_at};
use crate::error::{Error, Result};
use glam::{DMat4, DVec3};
use std::f64::consts::TAU;

/// `frames` cameras on an ellipse around the mean of `cameras`, as wide and high as their own spread, all looking at the
/// point that the mean camera looks at in `distance`. For captures taken by walking: the path stays where photos were.
///
/// # Errors
/// No cameras.
pub fn orbit_around_cameras(cameras: &[Camera], distance: f64, frames: usize) -> Result<Vec<Camera>> {
    let poses: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
    let normalization = super::normalize(&poses)?;
    let to_world = normalization.world_from_normalized;
    let spread = |axis: usize| {
        let n = poses.len() as f64;
        (normalization.c2w.iter().map(|pose| pose.w_axis[axis].powi(2)).sum::<f64>() / n).sqrt()
            * to_world.scale
    };
    // A camera that only moved forward still gives a look around: a tenth of the way to the target at least.
    let (x, y) = (spread(0).max(0.1 * distance), spread(1).max(0.05 * distance));
    let [right, down, forward] =
        [to_world.rotation.x_axis, to_world.rotation.y_axis, to_world.rotation.z_axis];
    let target = to_world.translation + forward * distance;
    let reference = cameras.first().ok_or_else(|| Error::Request("an orbit needs a camera".into()))?;
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = to_world.translation + right * (x * angle.cos()) + down * (y * angle.sin());
        Camera { c2w: look_at(eye, target, down), ..*reference }
    };
    Ok((0..frames).map(camera).collect())
}

/// `frames` cameras on a circle of `radius` around `target`, a little above it (y points down), like `reference` in
/// everything but the pose.
pub fn orbit_around_point(target: DVec3, radius: f64, reference: &Camera, frames: usize) -> Vec<Camera> {
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = target + radius * DVec3::new(angle.sin(), -0.3, -angle.cos());
        Camera { c2w: look_at(eye, target, DVec3::Y), ..*reference }
    };
    (0..frames).map(camera).collect()
}
