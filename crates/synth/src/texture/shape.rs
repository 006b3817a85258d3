//! Signed distances to shapes around the origin, negative inside, and a step function for soft edges.

use glam::Vec2;

/// Interpolates smoothly from 0 at `low` to 1 at `high`, with zero slope at both ends.
pub(super) fn smoothstep(low: f32, high: f32, value: f32) -> f32 {
    let t = ((value - low) / (high - low)).clamp(0., 1.);
    t * t * (3. - 2. * t)
}

/// Returns the signed distance to a disk.
pub(super) fn disk(offset: Vec2, radius: f32) -> f32 {
    offset.length() - radius
}

/// Returns the signed distance to an ellipse, exact on its edge and approximate elsewhere.
pub(super) fn ellipse(offset: Vec2, radii: Vec2) -> f32 {
    ((offset / radii).length() - 1.) * radii.min_element()
}

/// Returns the signed distance to a rectangle with corners rounded by `rounding`.
pub(super) fn rectangle(offset: Vec2, half: Vec2, rounding: f32) -> f32 {
    let beyond = offset.abs() - half + Vec2::splat(rounding);
    beyond.max(Vec2::ZERO).length() + beyond.max_element().min(0.) - rounding
}

/// Returns the signed distance to a stroke with round ends.
pub(super) fn stroke(offset: Vec2, from: Vec2, to: Vec2, radius: f32) -> f32 {
    let along = to - from;
    let t = ((offset - from).dot(along) / along.length_squared().max(1e-12)).clamp(0., 1.);
    (offset - from - along * t).length() - radius
}

/// Returns the signed distance to a regular polygon with `corners` corners whose inscribed circle has radius `radius`.
pub(super) fn polygon(offset: Vec2, radius: f32, corners: usize) -> f32 {
    let turn = std::f32::consts::TAU / corners as f32;
    let angle = offset.to_angle() / turn;
    offset.length() * ((angle - angle.round()) * turn).cos() - radius
}

/// Returns the approximate signed distance to a flower with `petals` petals, whose notches are `depth` times the radius deep.
pub(super) fn flower(offset: Vec2, radius: f32, petals: usize, depth: f32) -> f32 {
    let wave = (offset.to_angle() * petals as f32).cos();
    offset.length() - radius * (1. - depth * (0.5 - 0.5 * wave))
}

/// Returns the approximate signed distance to a leaf between two points on the x axis, `length` apart and `width` across.
pub(super) fn leaf(offset: Vec2, length: f32, width: f32) -> f32 {
    let t = (offset.x / length + 0.5).clamp(0., 1.);
    let half = 2. * width * t * (1. - t);
    (offset.y.abs() - half).max(offset.x.abs() - 0.5 * length)
}
