//! Lens distortion (spec 10.5).

use super::jacobian;
use glam::DVec2;

/// Lens distortion in the OpenCV model. The lens shows a ray (x, y, 1) in camera axes where a pinhole camera would show the ray
/// (x', y', 1):
///
/// ```text
/// r² = x² + y²
/// L  = (1 + k₁r² + k₂r⁴ + k₃r⁶ + k₄r⁸) / (1 + d₁r² + d₂r⁴ + d₃r⁶)
/// x' = xL + 2p₁xy + p₂(r² + 2x²)
/// y' = yL + p₁(r² + 2y²) + 2p₂xy
/// ```
///
/// The position in pixels is (fx·x' + cx, fy·y' + cy). The default, with all coefficients 0, is the identity. k₁ and k₂ have the
/// same meaning in OpenCV, COLMAP and nerfstudio; k₃ in OpenCV and nerfstudio; k₄ in nerfstudio. The denominator's d₁ to d₃ are k₄
/// to k₆ of OpenCV's rational model, which is COLMAP's FULL_OPENCV.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Distortion {
    /// Numerator coefficients k₁ to k₄.
    pub radial: [f64; 4],
    /// Denominator coefficients d₁ to d₃.
    pub denominator: [f64; 3],
    /// Tangential coefficients p₁ and p₂.
    pub tangential: [f64; 2],
}

impl Distortion {
    /// Returns the distorted point (x', y') of `point`.
    pub fn apply(&self, point: DVec2) -> DVec2 {
        let ([k1, k2, k3, k4], [p1, p2]) = (self.radial, self.tangential);
        let (DVec2 { x, y }, r2) = (point, point.length_squared());
        let l = (1. + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))) / self.divisor(r2);
        DVec2::new(
            x * l + 2. * p1 * x * y + p2 * (r2 + 2. * x * x),
            y * l + p1 * (r2 + 2. * y * y) + 2. * p2 * x * y,
        )
    }

    /// Returns the denominator of L.
    fn divisor(&self, r2: f64) -> f64 {
        let [d1, d2, d3] = self.denominator;
        1. + r2 * (d1 + r2 * (d2 + r2 * d3))
    }

    /// Returns `true` if the lens folds the image over at `point`, so that a pixel sees several rays: the determinant of the Jacobian or the
    /// denominator isn't above 0. It happens if a polynomial is used beyond the image it was fitted to.
    pub fn folds_at(&self, point: DVec2) -> bool {
        let determinant = jacobian(&|point| self.apply(point), point).determinant();
        !(determinant > 0. && determinant.is_finite() && self.divisor(point.length_squared()) > 0.)
    }

    /// Lists the coefficients for an error message.
    pub fn describe(&self) -> String {
        let Distortion { radial: [k1, k2, k3, k4], denominator, tangential: [p1, p2] } = self;
        let over = if *denominator == [0.; 3] { String::new() } else { format!(" over {denominator:?}") };
        format!("k1 {k1}, k2 {k2}, k3 {k3}, k4 {k4}{over}, p1 {p1}, p2 {p2}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distorted_points_follow_the_equations() {
        let lens = Distortion {
            radial: [-0.12, 0.05, -0.01, 0.002],
            denominator: [0.; 3],
            tangential: [0.003, -0.002],
        };
        let rational = Distortion { denominator: [0.3, -0.07, 0.02], ..lens };
        // Computed by hand: r² = 0.25, L = 1 − 0.03 + 0.003125 − 0.00015625 + 0.0000078125, and the denominator of the rational lens is
        // 1 + 0.075 − 0.004375 + 0.0003125.
        let l = 0.9729765625;
        for (lens, l) in [(lens, l), (rational, l / 1.0709375)] {
            let expected = DVec2::new(0.3 * l - 0.00072 - 0.002 * 0.43, -0.4 * l + 0.003 * 0.57 + 0.00048);
            let found = lens.apply(DVec2::new(0.3, -0.4));
            assert!(found.abs_diff_eq(expected, 1e-12), "{found} {expected}");
        }
    }
}
