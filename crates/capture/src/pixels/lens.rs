//! Removal of lens distortion from photos (spec 10.5).

use super::distortion::Distortion;
use crate::geometry::{Camera, Intrinsics};
use glam::Vec4;
use image::RgbImage;
use rayon::prelude::*;
use std::ops::Range;

/// Returns the photo as `camera`, a pinhole camera, would have taken it.
///
/// Pixel (i, j) has the ray x = (j + ½ − cx)/fx, y = (i + ½ − cy)/fy, and takes its colour from the photo at (fx·x' + cx, fy·y' +
/// cy), interpolated linearly between the four surrounding pixel centres. Beyond the photo its border is repeated. Pixels outside
/// `window`'s columns and rows, if it is given, are unspecified.
pub(crate) fn undistort(
    photo: RgbImage,
    distortion: &Distortion,
    camera: &Camera,
    window: Option<[Range<usize>; 2]>,
) -> RgbImage {
    if *distortion == Distortion::default() {
        return photo;
    }
    let [columns, rows] = window.unwrap_or_else(|| whole(camera));
    let mut looks = RowLookup::new(distortion, camera, &columns);
    let mut row = vec![SamplePosition::default(); columns.len()];
    let mut picture = Undistortion::new(photo);
    for i in rows {
        looks.fill(i, &mut row);
        picture.fill(i, columns.start, &row);
    }
    picture.finish()
}

/// Returns all columns and rows of `camera`'s image.
fn whole(camera: &Camera) -> [Range<usize>; 2] {
    [camera.width, camera.height].map(|count| 0..count as usize)
}

/// Precomputed lookup positions that all photos of one camera share.
#[derive(Debug)]
pub(crate) struct Lens {
    distortion: Distortion,
    camera: Camera,
    columns: Range<usize>,
    rows: Range<usize>,
    /// Lookup positions, row by row.
    places: Vec<SamplePosition>,
}

impl Lens {
    /// Computes the positions for `window`'s columns and rows, or for the whole image.
    pub fn new(distortion: Distortion, camera: Camera, window: Option<[Range<usize>; 2]>) -> Self {
        let [columns, rows] = window.unwrap_or_else(|| whole(&camera));
        let mut places = vec![SamplePosition::default(); columns.len() * rows.len()];
        places.par_chunks_mut(columns.len()).zip(rows.clone()).for_each_init(
            || RowLookup::new(&distortion, &camera, &columns),
            |looks, (row, i)| looks.fill(i, row),
        );
        Lens { distortion, camera, columns, rows, places }
    }

    /// Returns `true` if the lens matches `distortion` and `camera`, whatever the camera's pose.
    pub fn matches_camera(&self, distortion: &Distortion, camera: &Camera) -> bool {
        let known = |camera: &Camera| (camera.intrinsics, camera.width, camera.height);
        self.distortion == *distortion && known(&self.camera) == known(camera)
    }

    /// Removes the distortion from `photo` like the function [`undistort`].
    pub fn undistort(&self, photo: RgbImage) -> RgbImage {
        let mut picture = Undistortion::new(photo);
        for (i, row) in self.rows.clone().zip(self.places.chunks(self.columns.len())) {
            picture.fill(i, self.columns.start, row);
        }
        picture.finish()
    }
}

/// Position in a photo to take a colour from: the pixel to the upper left, and the fractional distances to the next ones, 0 to 1.
#[derive(Debug, Clone, Copy, Default)]
struct SamplePosition {
    left: u32,
    top: u32,
    to_right: f32,
    to_bottom: f32,
}

/// Computes the lookup positions of a pinhole camera's pixels, row by row.
struct RowLookup<'a> {
    distortion: &'a Distortion,
    camera: &'a Camera,
    /// Ray coordinate x of each column.
    across: Vec<f64>,
    /// Distorted ray coordinates (x', y') of a row.
    seen: Vec<(f64, f64)>,
}

impl<'a> RowLookup<'a> {
    fn new(distortion: &'a Distortion, camera: &'a Camera, columns: &Range<usize>) -> Self {
        let Intrinsics { fx, cx, .. } = camera.intrinsics;
        let across: Vec<f64> = columns.clone().map(|j| (j as f64 + 0.5 - cx) / fx).collect();
        let seen = vec![(0., 0.); across.len()];
        RowLookup { distortion, camera, across, seen }
    }

    /// Computes the lookup positions of row `i`.
    fn fill(&mut self, i: usize, row: &mut [SamplePosition]) {
        let Camera { intrinsics: Intrinsics { fx, fy, cx, cy }, width, height, .. } = *self.camera;
        let [last_column, last_row] = [width, height].map(|count| f64::from(count - 1));
        let y = (i as f64 + 0.5 - cy) / fy;
        // A separate loop, so that the compiler vectorizes it over several pixels.
        for (seen, x) in self.seen.iter_mut().zip(&self.across) {
            *seen = self.distortion.apply(*x, y);
        }
        for (place, seen) in row.iter_mut().zip(&self.seen) {
            let (left, to_right) = between(fx * seen.0 + cx, last_column);
            let (top, to_bottom) = between(fy * seen.1 + cy, last_row);
            *place = SamplePosition { left, top, to_right, to_bottom };
        }
    }
}

/// Returns the index of the last pixel centre, along columns or rows, at or before `position`, and the fractional distance to the
/// next one. `position` is in pixels from the image's edge.
#[inline]
fn between(position: f64, last: f64) -> (u32, f32) {
    /// Constant 1.5·2⁵²: adding it rounds to integers, in the lowest bits.
    const WHOLE: f64 = 6_755_399_441_055_744.;
    let position = position - 0.5;
    // Comparisons instead of max() and min(), which handle NaN and take longer.
    let position = if position > 0. { position } else { 0. };
    let position = if position < last { position } else { last };
    // Halfway between two centres, either one may be chosen; with a fraction of 0 or 1 the result is the same.
    let whole = position - 0.5 + WHOLE;
    (whole.to_bits() as u32, (position - (whole - WHOLE)) as f32)
}

/// A photo and its undistorted version.
struct Undistortion {
    width: usize,
    height: usize,
    photo: Vec<u8>,
    /// Undistorted pixels and one more byte, so that four bytes can be written at the last pixel.
    undistorted: Vec<u8>,
}

impl Undistortion {
    fn new(photo: RgbImage) -> Self {
        let (width, height) = (photo.width() as usize, photo.height() as usize);
        let photo = photo.into_raw();
        Undistortion { width, height, undistorted: vec![0; photo.len() + 1], photo }
    }

    /// Fills row `i`, starting at column `first`.
    fn fill(&mut self, i: usize, first: usize, row: &[SamplePosition]) {
        /// Constant 2²³: a float32 this large has no fraction, and added integers below 256 are in its lowest bits.
        const WHOLE: f32 = 8_388_608.;
        let Undistortion { width, height, photo, undistorted } = self;
        // Read four bytes instead of three, to fill a vector.
        let colour = |bytes: &[u8]| {
            let bytes: [u8; 4] = bytes.try_into().expect("four numbers");
            Vec4::from_array(bytes.map(f32::from))
        };
        let mix = |a: Vec4, b: Vec4, share: f32| a + share * (b - a);
        // Interpolate between the pixel that begins at `byte` and the one to its right, which is unused in the last column.
        let along = |byte: usize, share: f32| match photo.get(byte..byte + 7) {
            Some(pair) => mix(colour(&pair[..4]), colour(&pair[3..]), share),
            None => {
                let mut pair = [0; 7];
                pair[..photo.len() - byte].copy_from_slice(&photo[byte..]);
                mix(colour(&pair[..4]), colour(&pair[3..]), share)
            }
        };
        let undistorted = &mut undistorted[3 * (i * *width + first)..];
        for (j, place) in row.iter().enumerate() {
            let (left, top) = (place.left as usize, place.top as usize);
            let bottom = (top + 1).min(*height - 1);
            let above = along(3 * (top * *width + left), place.to_right);
            let below = along(3 * (bottom * *width + left), place.to_right);
            // Round to the nearest of 256 levels. The fourth byte is overwritten by the next pixel.
            let levels = (mix(above, below, place.to_bottom) + WHOLE).to_array();
            undistorted[3 * j..][..4].copy_from_slice(&levels.map(|level| level.to_bits() as u8));
        }
    }

    fn finish(mut self) -> RgbImage {
        self.undistorted.pop();
        let [width, height] = [self.width, self.height].map(|count| count as u32);
        RgbImage::from_raw(width, height, self.undistorted).expect("three bytes a pixel")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat4, DVec3};
    use image::Rgb;

    const LENS: Distortion = Distortion {
        radial: [-0.12, 0.05, -0.01, 0.002],
        denominator: [0.1, -0.03, 0.],
        tangential: [0.003, -0.002],
    };
    const INTRINSICS: Intrinsics = Intrinsics { fx: 50., fy: 48., cx: 33., cy: 23. };
    const CAMERA: Camera = Camera { intrinsics: INTRINSICS, c2w: DMat4::IDENTITY, width: 64, height: 48 };

    #[test]
    fn no_distortion_changes_no_pixel() {
        let photo = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 4, y as u8 * 5, (x * y % 251) as u8]));
        assert_eq!(undistort(photo.clone(), &Distortion::default(), &CAMERA, None), photo);
        // This distortion is small enough to pass through the interpolation without visible change.
        let tiny = Distortion { radial: [1e-12, 0., 0., 0.], ..Distortion::default() };
        assert_eq!(undistort(photo.clone(), &tiny, &CAMERA, None), photo);
    }

    /// Colours agree with the formulas of [`undistort`] in float64.
    #[test]
    fn colours_are_between_their_neighbours() {
        let photo = RgbImage::from_fn(64, 48, |x, y| {
            let level = |k: u32| ((x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761) >> 24) as u8;
            Rgb([level(1), level(2), level(3)])
        });
        let removed = undistort(photo.clone(), &LENS, &CAMERA, None);
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
                // The nearest level, up to the rounding of float32.
                assert!((f64::from(found[k]) - exact).abs() < 0.5001, "{found:?} for {exact} at ({j}, {i})");
            }
        }
    }

    #[test]
    fn a_window_has_the_same_pixels_as_the_full_image() {
        let photo = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 4, y as u8 * 5, (x * y % 251) as u8]));
        let whole = undistort(photo.clone(), &LENS, &CAMERA, None);
        let window = Some([7..40, 0..29]);
        let part = undistort(photo.clone(), &LENS, &CAMERA, window.clone());
        for (x, y) in (7..40).flat_map(|x| (0..29).map(move |y| (x, y))) {
            assert_eq!(part.get_pixel(x, y), whole.get_pixel(x, y), "({x}, {y})");
        }
        assert_ne!(part, whole);
        // A shared lens gives the same pixels.
        let lens = |window| Lens::new(LENS, CAMERA, window);
        assert_eq!(lens(None).undistort(photo.clone()), whole);
        assert_eq!(lens(window).undistort(photo), part);
    }

    #[test]
    fn matches_camera_compares_distortion_intrinsics_and_size() {
        let lens = Lens::new(LENS, CAMERA, None);
        let elsewhere = Camera { c2w: DMat4::from_translation(DVec3::ONE), ..CAMERA };
        assert!(lens.matches_camera(&LENS, &CAMERA) && lens.matches_camera(&LENS, &elsewhere));
        assert!(!lens.matches_camera(&Distortion::default(), &CAMERA));
        let longer = Camera { intrinsics: Intrinsics { fx: 51., ..INTRINSICS }, ..CAMERA };
        assert!(
            !lens.matches_camera(&LENS, &longer)
                && !lens.matches_camera(&LENS, &Camera { width: 65, ..CAMERA })
        );
    }

    #[test]
    fn the_narrowest_images_have_edges_alone() {
        for (width, height) in [(1, 1), (1, 5), (5, 1), (2, 2)] {
            let photo = RgbImage::from_fn(width, height, |x, y| Rgb([40 * x as u8, 50 * y as u8, 7]));
            let camera = Camera { width, height, ..CAMERA };
            let removed = undistort(photo, &LENS, &camera, None);
            assert_eq!(removed.dimensions(), (width, height));
            assert!(removed.pixels().all(|pixel| pixel[2] == 7), "{width}×{height}: {removed:?}");
        }
    }
}
