//! Lens distortion, and photos without it (spec 10.5).

use crate::scene::{Camera, Intrinsics};
use image::RgbImage;
use std::ops::Range;

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

    /// The photo as `camera`, a pinhole camera, would have taken it. Its pixel (i, j) looks along x = (j + ½ − cx)/fx,
    /// y = (i + ½ − cy)/fy, and takes its colour from the photo at (fx·x' + cx, fy·y' + cy), interpolated linearly between the
    /// four pixel centres around; beyond the photo its border goes on. Of pixels beside `window`'s columns and rows, if there are
    /// such, nothing is said.
    pub fn remove(&self, photo: RgbImage, camera: &Camera, window: Option<[Range<usize>; 2]>) -> RgbImage {
        if *self == Distortion::default() {
            return photo;
        }
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
        let (width, height) = photo.dimensions();
        let [columns, rows] = window.unwrap_or([0..width as usize, 0..height as usize]);
        let across: Vec<f64> = columns.clone().map(|j| (j as f64 + 0.5 - cx) / fx).collect();
        let mut seen = vec![(0., 0.); across.len()];
        let (mut along_x, mut along_y) =
            (Between::of(across.len(), width), Between::of(across.len(), height));
        let source = Source::of(photo);
        // And a byte more, as in the source.
        let mut removed = vec![0; 3 * width as usize * height as usize + 1];
        for i in rows {
            let y = (i as f64 + 0.5 - cy) / fy;
            // By themselves, as processors do these for several pixels at a time.
            for (seen, x) in seen.iter_mut().zip(&across) {
                *seen = self.apply(*x, y);
            }
            along_x.fill(seen.iter().map(|seen| fx * seen.0 + cx));
            along_y.fill(seen.iter().map(|seen| fy * seen.1 + cy));
            let first = 3 * (i * width as usize + columns.start);
            for (j, (u, v)) in along_x.iter().zip(along_y.iter()).enumerate() {
                // The fourth is the next one's.
                removed[first + 3 * j..][..4].copy_from_slice(&source.interpolate(u, v));
            }
        }
        removed.pop();
        RgbImage::from_raw(width, height, removed).expect("three bytes a pixel")
    }
}

/// Where colours are between two columns, or rows, of pixel centres: the one before, and how far it is to the next, 0 to 1.
struct Between {
    /// The last column or row.
    last: f64,
    first: Vec<u32>,
    share: Vec<f32>,
}

impl Between {
    fn of(count: usize, size: u32) -> Self {
        Between { last: f64::from(size - 1), first: vec![0; count], share: vec![0.; count] }
    }

    /// `positions` are in pixels from the image's edge.
    #[inline]
    fn fill(&mut self, positions: impl Iterator<Item = f64>) {
        /// 1.5·2⁵²: adding it rounds to whole numbers, in the lowest bits.
        const WHOLE: f64 = 6_755_399_441_055_744.;
        for ((first, share), position) in self.first.iter_mut().zip(&mut self.share).zip(positions) {
            let position = position - 0.5;
            // Not max() and min(), which think of NaN and take longer.
            let position = if position > 0. { position } else { 0. };
            let position = if position < self.last { position } else { self.last };
            // Halfway between two, the one or the other, which is the same with a share of 0 or 1.
            let whole = position - 0.5 + WHOLE;
            (*first, *share) = (whole.to_bits() as u32, (position - (whole - WHOLE)) as f32);
        }
    }

    fn iter(&self) -> impl Iterator<Item = (usize, f32)> {
        self.first.iter().zip(&self.share).map(|(first, share)| (*first as usize, *share))
    }
}

/// A photo that colours are read from between its pixels.
struct Source {
    /// And a byte more, that four can be read where the last pixel begins.
    bytes: Vec<u8>,
    width: usize,
    height: usize,
}

impl Source {
    fn of(photo: RgbImage) -> Source {
        let (width, height) = (photo.width() as usize, photo.height() as usize);
        let mut bytes = photo.into_raw();
        bytes.push(0);
        Source { bytes, width, height }
    }

    /// The colour there, to the nearest of 256 levels, and a byte more.
    #[inline]
    fn interpolate(&self, (left, s): (usize, f32), (top, t): (usize, f32)) -> [u8; 4] {
        /// 2²³: a float32 number this large has no fraction, and what is below 256 in its lowest bits.
        const WHOLE: f32 = 8_388_608.;
        let (right, bottom) = ((left + 1).min(self.width - 1), (top + 1).min(self.height - 1));
        // Four bytes for three, which are a vector.
        let at = |x: usize, y: usize| -> [f32; 4] {
            let first = 3 * (y * self.width + x);
            let bytes: [u8; 4] = self.bytes[first..first + 4].try_into().expect("four numbers");
            bytes.map(f32::from)
        };
        let between = |a: [f32; 4], b: [f32; 4], share: f32| -> [f32; 4] {
            std::array::from_fn(|k| a[k] + share * (b[k] - a[k]))
        };
        let (above, below) =
            (between(at(left, top), at(right, top), s), between(at(left, bottom), at(right, bottom), s));
        between(above, below, t).map(|level| (level + WHOLE).to_bits() as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;
    use image::Rgb;

    const LENS: Distortion = Distortion { radial: [-0.12, 0.05, -0.01, 0.002], tangential: [0.003, -0.002] };
    const INTRINSICS: Intrinsics = Intrinsics { fx: 50., fy: 48., cx: 33., cy: 23. };
    const CAMERA: Camera = Camera { intrinsics: INTRINSICS, c2w: DMat4::IDENTITY, width: 64, height: 48 };

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
        assert_eq!(Distortion::default().remove(photo.clone(), &CAMERA, None), photo);
        // So little that it goes through the interpolation and changes nothing that is visible.
        let tiny = Distortion { radial: [1e-12, 0., 0., 0.], tangential: [0.; 2] };
        assert_eq!(tiny.remove(photo.clone(), &CAMERA, None), photo);
    }

    /// By the formulas of [`Distortion::remove`] in float64.
    #[test]
    fn colours_are_between_their_neighbours() {
        let photo = RgbImage::from_fn(64, 48, |x, y| {
            let level = |k: u32| ((x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761) >> 24) as u8;
            Rgb([level(1), level(2), level(3)])
        });
        let removed = LENS.remove(photo.clone(), &CAMERA, None);
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
    fn a_part_is_that_of_the_whole() {
        let photo = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 4, y as u8 * 5, (x * y % 251) as u8]));
        let [whole, part] =
            [None, Some([7..40, 0..29])].map(|window| LENS.remove(photo.clone(), &CAMERA, window));
        for (x, y) in (7..40).flat_map(|x| (0..29).map(move |y| (x, y))) {
            assert_eq!(part.get_pixel(x, y), whole.get_pixel(x, y), "({x}, {y})");
        }
        assert_ne!(part, whole);
    }

    #[test]
    fn a_lens_that_folds_is_refused() {
        LENS.check(&CAMERA).expect("a good lens");
        // x − x³ turns back at x = 0.577, which the image reaches.
        for k1 in [-1., f64::NAN, f64::INFINITY] {
            let (found, _) =
                Distortion { radial: [k1, 0., 0., 0.], tangential: [0.; 2] }.check(&CAMERA).unwrap_err();
            assert!(found.contains(&format!("k1 {k1}")) && found.contains("folds"), "{found}");
        }
    }
}
