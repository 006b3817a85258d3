//! Camera paths for viewing a result.

use super::camera::{Camera, look_at};
use glam::{DMat4, DVec3};
use globalsplat_files::{Error, Result};
use std::f64::consts::TAU;

/// Returns `frames` cameras on an ellipse around the mean of `cameras`, as wide and high as their own spread. All look at the point
/// at `distance` in front of the mean camera. It suits captures taken by walking, because the path stays close to the photos.
///
/// # Errors
/// Fails if there are no cameras.
pub fn orbit_around_cameras(cameras: &[Camera], distance: f64, frames: usize) -> Result<Vec<Camera>> {
    let poses: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
    let normalization = super::normalize(&poses)?;
    let to_world = normalization.world_from_normalized;
    let spread = |axis: usize| {
        let n = poses.len() as f64;
        (normalization.c2w.iter().map(|pose| pose.w_axis[axis].powi(2)).sum::<f64>() / n).sqrt()
            * to_world.scale
    };
    // At least a tenth of the distance to the target, so that cameras that only moved forward still give an orbit.
    let (x, y) = (spread(0).max(0.1 * distance), spread(1).max(0.05 * distance));
    let [right, down, forward] =
        [to_world.rotation.x_axis, to_world.rotation.y_axis, to_world.rotation.z_axis];
    let target = to_world.translation + forward * distance;
    let reference = cameras.first().ok_or_else(|| Error::request("an orbit needs a camera"))?;
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = to_world.translation + right * (x * angle.cos()) + down * (y * angle.sin());
        Camera { c2w: look_at(eye, target, down), ..*reference }
    };
    Ok((0..frames).map(camera).collect())
}

/// Returns `frames` cameras on a circle of `radius` around `target`, slightly above it (y points down). Everything but the pose is
/// copied from `reference`.
pub fn orbit_around_point(target: DVec3, radius: f64, reference: &Camera, frames: usize) -> Vec<Camera> {
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = target + radius * DVec3::new(angle.sin(), -0.3, -angle.cos());
        Camera { c2w: look_at(eye, target, DVec3::Y), ..*reference }
    };
    (0..frames).map(camera).collect()
}
