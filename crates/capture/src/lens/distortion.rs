//! Lens distortion (spec 10.5).

use crate::geometry::{ImageSize, Intrinsics};

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
    /// Returns the distorted point (x', y') of (x, y).
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let [p1, p2] = self.tangential;
        let (r2, l, _) = self.radial_factor(x, y);
        (x * l + 2. * p1 * x * y + p2 * (r2 + 2. * x * x), y * l + p1 * (r2 + 2. * y * y) + 2. * p2 * x * y)
    }

    /// Returns (r², L, dL/dr²).
    fn radial_factor(&self, x: f64, y: f64) -> (f64, f64, f64) {
        let ([k1, k2, k3, k4], r2) = (self.radial, x * x + y * y);
        let above = 1. + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let slope = k1 + r2 * (2. * k2 + r2 * (3. * k3 + r2 * 4. * k4));
        let (below, slope_below) = self.divisor(r2);
        let l = above / below;
        (r2, l, (slope - l * slope_below) / below)
    }

    /// Returns the denominator of L, and its derivative with respect to r².
    fn divisor(&self, r2: f64) -> (f64, f64) {
        let [d1, d2, d3] = self.denominator;
        (1. + r2 * (d1 + r2 * (d2 + r2 * d3)), d1 + r2 * (2. * d2 + r2 * 3. * d3))
    }

    /// Returns ∂x'/∂x, ∂x'/∂y = ∂y'/∂x, and ∂y'/∂y at (x, y). With L' = dL/dr²:
    ///
    /// ```text
    /// ∂x'/∂x = L + 2x²L' + 2p₁y + 6p₂x
    /// ∂x'/∂y = 2xyL' + 2p₁x + 2p₂y
    /// ∂y'/∂y = L + 2y²L' + 6p₁y + 2p₂x
    /// ```
    fn jacobian(&self, x: f64, y: f64) -> [f64; 3] {
        let [p1, p2] = self.tangential;
        let (_, l, slope) = self.radial_factor(x, y);
        [
            l + 2. * x * x * slope + 2. * p1 * y + 6. * p2 * x,
            2. * x * y * slope + 2. * p1 * x + 2. * p2 * y,
            l + 2. * y * y * slope + 6. * p1 * y + 2. * p2 * x,
        ]
    }

    /// Checks that no two rays of the pinhole image of `size` map to one point of the photo, which happens if a polynomial is used
    /// beyond the image it was fitted to. The Jacobian's determinant and the denominator must be above 0 all over the image.
    ///
    /// # Errors
    /// Returns (what was found, what was expected).
    pub fn check(&self, intrinsics: &Intrinsics, size: ImageSize) -> Result<(), (String, String)> {
        /// Number of sample points along each side of the image.
        const POINTS: u32 = 33;
        let Intrinsics { fx, fy, cx, cy } = *intrinsics;
        let at = |i: u32, size: u32| f64::from(i) / f64::from(POINTS - 1) * f64::from(size);
        let folds = (0..POINTS * POINTS).any(|i| {
            let (u, v) = (at(i % POINTS, size.width), at(i / POINTS, size.height));
            let (x, y) = ((u - cx) / fx, (v - cy) / fy);
            let [xx, xy, yy] = self.jacobian(x, y);
            let determinant = xx * yy - xy * xy;
            !(determinant > 0. && determinant.is_finite() && self.divisor(x * x + y * y).0 > 0.)
        });
        if !folds {
            return Ok(());
        }
        let Distortion { radial: [k1, k2, k3, k4], denominator, tangential: [p1, p2] } = self;
        let over = if *denominator == [0.; 3] { String::new() } else { format!(" over {denominator:?}") };
        let found = format!(
            "k1 {k1}, k2 {k2}, k3 {k3}, k4 {k4}{over}, p1 {p1}, p2 {p2}, by which the lens folds the image over"
        );
        Err((found, "coefficients by which every pixel sees a ray of its own".into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: Distortion =
        Distortion { radial: [-0.12, 0.05, -0.01, 0.002], denominator: [0.; 3], tangential: [0.003, -0.002] };
    const RATIONAL: Distortion = Distortion { denominator: [0.3, -0.07, 0.02], ..LENS };
    const INTRINSICS: Intrinsics = Intrinsics { fx: 50., fy: 48., cx: 33., cy: 23. };
    const SIZE: ImageSize = ImageSize { height: 48, width: 64 };

    #[test]
    fn distorted_points_follow_the_equations() {
        // Computed by hand: r² = 0.25, L = 1 − 0.03 + 0.003125 − 0.00015625 + 0.0000078125.
        let (x, y) = LENS.apply(0.3, -0.4);
        let l = 0.9729765625;
        assert!((x - (0.3 * l - 0.00072 - 0.002 * 0.43)).abs() < 1e-12, "{x}");
        assert!((y - (-0.4 * l + 0.003 * 0.57 + 0.00048)).abs() < 1e-12, "{y}");
        // The denominator is 1 + 0.075 − 0.004375 + 0.0003125.
        let (x, _) = RATIONAL.apply(0.3, -0.4);
        assert!((x - (0.3 * l / 1.0709375 - 0.00072 - 0.002 * 0.43)).abs() < 1e-12, "{x}");
    }

    #[test]
    fn jacobian_matches_finite_differences() {
        let h = 1e-6;
        let points = [(0.3, -0.5), (-0.7, 0.2), (0.6, 0.6)];
        for (lens, (x, y)) in [LENS, RATIONAL].iter().flat_map(|lens| points.map(|point| (lens, point))) {
            let difference = |dx: f64, dy: f64| {
                let (a, b) = (lens.apply(x + dx, y + dy), lens.apply(x - dx, y - dy));
                ((a.0 - b.0) / (2. * h), (a.1 - b.1) / (2. * h))
            };
            let (along_x, along_y) = (difference(h, 0.), difference(0., h));
            let [xx, xy, yy] = lens.jacobian(x, y);
            for (found, expected) in [(xx, along_x.0), (xy, along_x.1), (xy, along_y.0), (yy, along_y.1)] {
                assert!((found - expected).abs() < 1e-8, "{found} {expected}");
            }
        }
    }

    #[test]
    fn a_lens_that_folds_is_refused() {
        let radial = |k1| Distortion { radial: [k1, 0., 0., 0.], ..Distortion::default() };
        // The map 1 / (1 − 3r²) has a pole inside the image, and is steep on either side of it.
        let pole = Distortion { denominator: [-3., 0., 0.], ..Distortion::default() };
        for (lens, found) in [
            (LENS, None),
            (RATIONAL, None),
            // The map x − x³ turns back at x = 0.577, which lies inside the image.
            (radial(-1.), Some("k1 -1,")),
            (radial(f64::NAN), Some("k1 NaN,")),
            (radial(f64::INFINITY), Some("k1 inf,")),
            (pole, Some("over [-3.0, 0.0, 0.0]")),
        ] {
            let refused = lens.check(&INTRINSICS, SIZE).err().map(|(found, _)| found);
            assert_eq!(refused.is_some(), found.is_some(), "{lens:?}");
            assert!(refused.unwrap_or_default().contains(found.unwrap_or_default()), "{lens:?}");
        }
    }
}
