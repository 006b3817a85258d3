//! Lens distortion, and photos without it (spec 10.5).

use crate::scene::{Camera, Intrinsics};
use image::{Rgb, RgbImage};

/// The OpenCV model. A ray (x, y, 1) in camera axes is seen through the lens where a pinhole camera would see
///
/// ```text
/// r² = x² + y²
/// L  = 1 + k₁r² + k₂r⁴ + k₃r⁶ + k₄r⁸
/// x' = xL + 2p₁xy + p₂(r² + 2x²)
/// y' = yL + p₁(r² + 2y²) + 2p₂xy
/// ```
///
/// which is pixel (fx·x' + cx, fy·y' + cy). The default, all coefficients 0, is the identity. k₁ and k₂ mean the same in
/// OpenCV, COLMAP and nerfstudio; k₃ in OpenCV and nerfstudio, k₄ in nerfstudio.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(in crate::data) struct Distortion {
    /// k₁ to k₄.
    pub radial: [f64; 4],
    /// p₁ and p₂.
    pub tangential: [f64; 2],
}

impl Distortion {
    /// (x', y') of (x, y).
    fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let [p1, p2] = self.tangential;
        let (r2, l, _) = self.radial_factor(x, y);
        (x * l + 2. * p1 * x * y + p2 * (r2 + 2. * x * x), y * l + p1 * (r2 + 2. * y * y) + 2. * p2 * x * y)
    }

    /// (r², L, dL/dr²).
    fn radial_factor(&self, x: f64, y: f64) -> (f64, f64, f64) {
        let [k1, k2, k3, k4] = self.radial;
        let r2 = x * x + y * y;
        let l = 1. + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        (r2, l, k1 + r2 * (2. * k2 + r2 * (3. * k3 + r2 * 4. * k4)))
    }

    /// ∂x'/∂x, ∂x'/∂y = ∂y'/∂x, and ∂y'/∂y at (x, y); with L' = dL/dr²:
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

    /// Checks that no two rays of `camera`'s pinhole image meet in one point of the photo, as they do where a polynomial is
    /// used beyond the image it was fitted to: the Jacobian's determinant is above 0 all over the image.
    ///
    /// # Errors
    /// (what was found, what was expected).
    pub fn check(&self, camera: &Camera) -> Result<(), (String, String)> {
        /// Points looked at, along each side of the image.
        const POINTS: u32 = 33;
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
        let at = |i: u32, size: u32| f64::from(i) / f64::from(POINTS - 1) * f64::from(size);
        let folds = (0..POINTS * POINTS).any(|i| {
            let (u, v) = (at(i % POINTS, camera.width), at(i / POINTS, camera.height));
            let [xx, xy, yy] = self.jacobian((u - cx) / fx, (v - cy) / fy);
            let determinant = xx * yy - xy * xy;
            !(determinant > 0. && determinant.is_finite())
        });
        if !folds {
            return Ok(());
        }
        let Distortion { radial: [k1, k2, k3, k4], tangential: [p1, p2] } = self;
        let found = format!(
            "k1 {k1}, k2 {k2}, k3 {k3}, k4 {k4}, p1 {p1}, p2 {p2}, by which the lens folds the image over"
        );
        Err((found, "coefficients by which every pixel sees a ray of its own".into()))
    }

    /// The photo as a pinhole camera with the same `intrinsics` would have taken it, of the same size. Its pixel (i, j) looks
    /// along x = (j + ½ − cx)/fx, y = (i + ½ − cy)/fy, and takes its colour from the photo at (fx·x' + cx, fy·y' + cy),
    /// interpolated linearly between the four pixel centres around; beyond the photo its border goes on.
    pub fn remove(&self, photo: RgbImage, intrinsics: &Intrinsics) -> RgbImage {
        if *self == Distortion::default() {
            return photo;
        }
        let Intrinsics { fx, fy, cx, cy } = *intrinsics;
        let (width, height) = photo.dimensions();
        let across: Vec<f64> = (0..width).map(|j| (f64::from(j) + 0.5 - cx) / fx).collect();
        let mut seen = vec![(0., 0.); across.len()];
        let source = Source::of(photo);
        let mut removed = RgbImage::new(width, height);
        for (i, row) in removed.rows_mut().enumerate() {
            let y = (i as f64 + 0.5 - cy) / fy;
            // By itself, as processors do it for several pixels at a time.
            for (seen, x) in seen.iter_mut().zip(&across) {
                let (x, y) = self.apply(*x, y);
                *seen = (fx * x + cx, fy * y + cy);
            }
            for (pixel, (u, v)) in row.zip(&seen) {
                *pixel = source.interpolate(*u, *v);
            }
        }
        removed
    }
}

/// A photo that colours are read from between its pixels.
struct Source {
    /// And a byte more, that four can be read where the last pixel begins.
    bytes: Vec<u8>,
    width: u32,
    height: u32,
}

impl Source {
    fn of(photo: RgbImage) -> Source {
        let (width, height) = photo.dimensions();
        let mut bytes = photo.into_raw();
        bytes.push(0);
        Source { bytes, width, height }
    }

    /// The colour at (u, v), in pixels from the image's corner, to the nearest of 256 levels.
    #[inline]
    fn interpolate(&self, u: f64, v: f64) -> Rgb<u8> {
        /// 2²³: a float32 number this large has no fraction, and what is below 256 in its lowest bits.
        const WHOLE: f32 = 8_388_608.;
        let along = |position: f64, size: u32| {
            let position = (position - 0.5).max(0.).min(f64::from(size - 1));
            // Processors convert to signed numbers of 32 bits the fastest.
            let first = position as i32;
            (
                first as usize,
                (first as usize + 1).min(size as usize - 1),
                (position - f64::from(first)) as f32,
            )
        };
        let (left, right, s) = along(u, self.width);
        let (top, bottom, t) = along(v, self.height);
        // Four bytes for three, which are a vector.
        let at = |x: usize, y: usize| -> [f32; 4] {
            let first = 3 * (y * self.width as usize + x);
            let bytes: [u8; 4] = self.bytes[first..first + 4].try_into().expect("four numbers");
            bytes.map(f32::from)
        };
        let between = |a: [f32; 4], b: [f32; 4], s: f32| -> [f32; 4] {
            std::array::from_fn(|k| a[k] + s * (b[k] - a[k]))
        };
        let (above, below) =
            (between(at(left, top), at(right, top), s), between(at(left, bottom), at(right, bottom), s));
        let [red, green, blue, _] = between(above, below, t).map(|level| (level + WHOLE).to_bits() as u8);
        Rgb([red, green, blue])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;

    const LENS: Distortion = Distortion { radial: [-0.12, 0.05, -0.01, 0.002], tangential: [0.003, -0.002] };
    const INTRINSICS: Intrinsics = Intrinsics { fx: 50., fy: 48., cx: 33., cy: 23. };

    /// The ray that is seen at (x', y'), by Newton's method on the equations and their Jacobian.
    fn invert(lens: &Distortion, distorted: (f64, f64)) -> (f64, f64) {
        let (mut x, mut y) = distorted;
        for _ in 0..8 {
            let at = lens.apply(x, y);
            let (dx, dy) = (distorted.0 - at.0, distorted.1 - at.1);
            let [xx, xy, yy] = lens.jacobian(x, y);
            let determinant = xx * yy - xy * xy;
            x += (yy * dx - xy * dy) / determinant;
            y += (xx * dy - xy * dx) / determinant;
        }
        (x, y)
    }

    /// Newton's method only gets to the last digit within eight rounds if the Jacobian is the equations' own.
    #[test]
    fn distorting_and_back_is_the_identity() {
        for i in 0..11 {
            for j in 0..11 {
                let (x, y) = (f64::from(i) * 0.16 - 0.8, f64::from(j) * 0.12 - 0.6);
                let distorted = LENS.apply(x, y);
                let (u, v) = invert(&LENS, distorted);
                assert!((u - x).abs() < 1e-13 && (v - y).abs() < 1e-13, "({x}, {y}) became ({u}, {v})");
            }
        }
        // Worked out by hand: r² = 0.25, L = 1 − 0.03 + 0.003125 − 0.00015625 + 0.0000078125.
        let (x, y) = LENS.apply(0.3, -0.4);
        let l = 0.9729765625;
        assert!((x - (0.3 * l - 0.00072 - 0.002 * 0.43)).abs() < 1e-12, "{x}");
        assert!((y - (-0.4 * l + 0.003 * 0.57 + 0.00048)).abs() < 1e-12, "{y}");
    }

    #[test]
    fn the_jacobian_is_that_of_the_equations() {
        let h = 1e-6;
        for (x, y) in [(0.3, -0.5), (-0.7, 0.2), (0.6, 0.6)] {
            let difference = |dx: f64, dy: f64| {
                let (a, b) = (LENS.apply(x + dx, y + dy), LENS.apply(x - dx, y - dy));
                ((a.0 - b.0) / (2. * h), (a.1 - b.1) / (2. * h))
            };
            let (along_x, along_y) = (difference(h, 0.), difference(0., h));
            let [xx, xy, yy] = LENS.jacobian(x, y);
            for (found, expected) in [(xx, along_x.0), (xy, along_x.1), (xy, along_y.0), (yy, along_y.1)] {
                assert!((found - expected).abs() < 1e-8, "{found} {expected}");
            }
        }
    }

    #[test]
    fn no_distortion_changes_no_pixel() {
        let photo = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 4, y as u8 * 5, (x * y % 251) as u8]));
        assert_eq!(Distortion::default().remove(photo.clone(), &INTRINSICS), photo);
        // So little that it goes through the interpolation and changes nothing that is visible.
        let tiny = Distortion { radial: [1e-12, 0., 0., 0.], tangential: [0.; 2] };
        assert_eq!(tiny.remove(photo.clone(), &INTRINSICS), photo);
    }

    /// By the formulas of [`Distortion::remove`] in float64.
    #[test]
    fn colours_are_between_their_neighbours() {
        let photo = RgbImage::from_fn(64, 48, |x, y| {
            let level = |k: u32| ((x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761) >> 24) as u8;
            Rgb([level(1), level(2), level(3)])
        });
        let removed = LENS.remove(photo.clone(), &INTRINSICS);
        let level = |x: f64, y: f64, k: usize| f64::from(photo.get_pixel(x as u32, y as u32)[k]);
        for (j, i, found) in removed.enumerate_pixels() {
            let (x, y) = (f64::from(j) + 0.5 - INTRINSICS.cx, f64::from(i) + 0.5 - INTRINSICS.cy);
            let (x, y) = LENS.apply(x / INTRINSICS.fx, y / INTRINSICS.fy);
            let u = (INTRINSICS.fx * x + INTRINSICS.cx - 0.5).clamp(0., 63.);
            let v = (INTRINSICS.fy * y + INTRINSICS.cy - 0.5).clamp(0., 47.);
            let (s, t, right, below) = (u.fract(), v.fract(), (u + 1.).min(63.), (v + 1.).min(47.));
            for k in 0..3 {
                let top = level(u, v, k) * (1. - s) + level(right, v, k) * s;
                let bottom = level(u, below, k) * (1. - s) + level(right, below, k) * s;
                let exact = top * (1. - t) + bottom * t;
                // The nearest level, but for float32's last digits.
                assert!((f64::from(found[k]) - exact).abs() < 0.5001, "{found:?} for {exact} at ({j}, {i})");
            }
        }
    }

    #[test]
    fn a_lens_that_folds_is_refused() {
        let camera = Camera { intrinsics: INTRINSICS, c2w: DMat4::IDENTITY, width: 64, height: 48 };
        LENS.check(&camera).expect("a good lens");
        // x − x³ turns back at x = 0.577, which the image reaches.
        for k1 in [-1., f64::NAN, f64::INFINITY] {
            let (found, _) =
                Distortion { radial: [k1, 0., 0., 0.], tangential: [0.; 2] }.check(&camera).unwrap_err();
            assert!(found.contains(&format!("k1 {k1}")) && found.contains("folds"), "{found}");
        }
    }
}
