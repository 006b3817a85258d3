//! Distortion of fisheye lenses (spec 10.5).

use super::invert;
use glam::DVec2;
use std::f64::consts::PI;

/// Distortion of the equidistant projection. A ray at the angle θ from the optical axis is at the distance θ from the center of the
/// undistorted image plane, at q. With r = |q| it is shown at
///
/// ```text
/// R(q) = q (1 + k₁r² + k₂r⁴ + … + k₆r¹²)                                                     radial
/// T(q) = (2p₁ab + p₂(r² + 2a²),  p₁(r² + 2b²) + 2p₂ab)   with q = (a, b)                       tangential
/// S(q) = (s₁r² + s₂r⁴,  s₃r² + s₄r⁴)                                                          thin prism
/// ```
///
/// R(q) + T(q) + S(q), or R + T(R) + S(R) if the distortions are applied in sequence. OpenCV's fisheye has k₁ to k₄ alone; in COLMAP,
/// THIN_PRISM_FISHEYE adds all at once, and RAD_TAN_THIN_PRISM_FISHEYE, the model of Aria's glasses, applies them in sequence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fisheye {
    radial: [f64; 6],
    tangential: [f64; 2],
    prism: [f64; 4],
    is_sequential: bool,
    /// Largest angle in radians that the lens shows, up to which R grows, at most π.
    pub max_angle: f64,
}

impl Fisheye {
    /// Creates the distortion with coefficients k, p and s, applied in sequence or not.
    pub fn new(radial: [f64; 6], tangential: [f64; 2], prism: [f64; 4], is_sequential: bool) -> Self {
        Fisheye { radial, tangential, prism, is_sequential, max_angle: max_angle(&radial) }
    }

    /// Lists the coefficients for an error message.
    pub fn describe(&self) -> String {
        format!("k {:?}, p {:?}, s {:?}", self.radial, self.tangential, self.prism)
    }

    /// Returns the distorted point of `q`.
    pub fn apply(&self, q: DVec2) -> DVec2 {
        let radial = q * factor(&self.radial, q.length_squared());
        let at = if self.is_sequential { radial } else { q };
        let (DVec2 { x, y }, r2) = (at, at.length_squared());
        let ([p1, p2], [s1, s2, s3, s4]) = (self.tangential, self.prism);
        radial
            + DVec2::new(
                2. * p1 * x * y + p2 * (r2 + 2. * x * x) + r2 * (s1 + r2 * s2),
                p1 * (r2 + 2. * y * y) + 2. * p2 * x * y + r2 * (s3 + r2 * s4),
            )
    }

    /// Returns the point whose distorted point is `distorted`, or `None` if there is none at an angle that the lens shows.
    pub fn invert(&self, distorted: DVec2) -> Option<DVec2> {
        let radius = distorted.length();
        let is_radial = self.tangential == [0.; 2] && self.prism == [0.; 4];
        let distance = |angle: f64| angle * factor(&self.radial, angle * angle);
        let is_beyond = distance(self.max_angle) < radius;
        if is_radial && is_beyond || !distance(self.max_angle).is_finite() {
            return None;
        }
        // R grows up to the largest angle, so that bisection finds the point of a radial distortion.
        let angle = bisect(0., self.max_angle, |angle| distance(angle) < radius);
        let near = if radius == 0. { DVec2::ZERO } else { distorted * (angle / radius) };
        if is_radial {
            return Some(near);
        }
        invert(|q| self.apply(q), distorted, near).filter(|q| q.length() <= self.max_angle)
    }
}

/// Returns the number between `low` and `high` up to which `is_below` holds.
fn bisect(mut low: f64, mut high: f64, is_below: impl Fn(f64) -> bool) -> f64 {
    loop {
        let middle = (low + high) / 2.;
        if !(low < middle && middle < high) {
            return low;
        }
        if is_below(middle) {
            low = middle
        } else {
            high = middle
        };
    }
}

/// Returns 1 + k₁r² + … + k₆r¹².
fn factor(radial: &[f64; 6], r2: f64) -> f64 {
    1. + radial.iter().rev().fold(0., |sum, k| (sum + k) * r2)
}

/// Returns the angle up to which the distance from the center grows: where 1 + 3k₁θ² + 5k₂θ⁴ + … first falls to 0, at most π.
fn max_angle(radial: &[f64; 6]) -> f64 {
    /// Number of angles at which the slope is examined.
    const STEPS: u32 = 720;
    if radial.iter().all(|&k| k == 0.) {
        return PI;
    }
    let grows = |angle: f64| {
        let r2 = angle * angle;
        let slope = radial.iter().zip([3., 5., 7., 9., 11., 13.]).rev();
        1. + slope.fold(0., |sum, (k, order)| (sum + k * order) * r2) > 0.
    };
    let at = |step: u32| PI * f64::from(step) / f64::from(STEPS);
    let Some(first) = (0..=STEPS).find(|&step| !grows(at(step))) else { return PI };
    bisect(at(first.saturating_sub(1)), at(first), grows)
}
