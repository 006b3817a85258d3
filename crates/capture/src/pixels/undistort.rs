//! Photos as pinhole cameras would have taken them (spec 10.5).

use crate::geometry::{Camera, Intrinsics};
use crate::lens::{Distortion, Projection};
use glam::{DVec3, Vec4};
use image::RgbImage;
use rayon::prelude::*;
use std::ops::Range;

/// Pixels of a pinhole view.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ViewPixels {
    pub image: RgbImage,
    /// 255 for each pixel that the photo shows and 0 for the others, row by row. `None` if the photo shows all of them.
    pub mask: Option<Vec<u8>>,
}

/// Takes the pixels of a pinhole view from its photo.
///
/// Pixel (i, j) has the ray x = (j + ½ − cx)/fx, y = (i + ½ − cy)/fy, and takes its color from the position in the photo to which
/// the projection maps the ray, interpolated linearly between the four surrounding pixel centers. Beyond the photo its border is
/// repeated, or, if the view is a part of the photo, pixels are black and masked out.
#[derive(Debug)]
pub(crate) struct Undistorter {
    projection: Projection,
    camera: Camera,
    columns: Range<usize>,
    rows: Range<usize>,
    /// Positions of the pixels of `columns` and `rows`, row by row, or nothing to compute them for each photo anew.
    positions: Vec<SamplePosition>,
}

impl Undistorter {
    /// Creates the undistorter of the view with the projection and the camera. Pixels outside `window`'s columns and rows, if it is
    /// given, are unspecified.
    pub fn new(projection: Projection, camera: Camera, window: Option<[Range<usize>; 2]>) -> Self {
        let [columns, rows] = window.unwrap_or([camera.width, camera.height].map(|count| 0..count as usize));
        Undistorter { projection, camera, columns, rows, positions: vec![] }
    }

    /// Computes the positions in the photo, which several photos then share.
    pub fn precompute(mut self) -> Self {
        let mut positions = vec![SamplePosition::default(); self.columns.len() * self.rows.len()];
        let rows = positions.par_chunks_mut(self.columns.len()).zip(self.rows.clone());
        rows.for_each_init(|| RowLookup::new(&self), |lookup, (row, i)| lookup.fill(i, row));
        self.positions = positions;
        self
    }

    /// Returns `true` if the undistorter is that of `projection` and `camera`, whatever the camera's pose.
    pub fn matches_camera(&self, projection: &Projection, camera: &Camera) -> bool {
        let known = |camera: &Camera| (camera.intrinsics, camera.width, camera.height);
        self.projection == *projection && known(&self.camera) == known(camera)
    }

    /// Returns the pixels of the view of `photo`.
    pub fn apply(&self, photo: &RgbImage) -> ViewPixels {
        let Camera { width, height, .. } = self.camera;
        let pixels = width as usize * height as usize;
        // One more byte, so that four bytes can be written at the last pixel.
        let mut colors = vec![0; 3 * pixels + 1];
        let mut mask = matches!(self.projection, Projection::Part(_)).then(|| vec![0; pixels]);
        let mut lookup = RowLookup::new(self);
        let mut row = vec![SamplePosition::default(); self.columns.len()];
        for (n, i) in self.rows.clone().enumerate() {
            let known = self.positions.get(n * row.len()..(n + 1) * row.len());
            if known.is_none() {
                lookup.fill(i, &mut row);
            }
            let row = known.unwrap_or(&row);
            let start = i * width as usize + self.columns.start;
            interpolate(photo, row, &mut colors[3 * start..]);
            let Some(mask) = &mut mask else { continue };
            let pixels = colors[3 * start..].chunks_exact_mut(3).zip(&mut mask[start..]);
            for ((color, weight), position) in pixels.zip(row) {
                match position.to_right.is_nan() {
                    true => color.fill(0),
                    false => *weight = u8::MAX,
                }
            }
        }
        colors.pop();
        let image = RgbImage::from_raw(width, height, colors).expect("three bytes a pixel");
        // Most views lie inside the photo.
        ViewPixels { image, mask: mask.filter(|mask| mask.contains(&0)) }
    }
}

/// Position in a photo to take a color from: the pixel to the upper left, and the fractional distances to the next ones, 0 to 1.
/// Outside the photo, `to_right` is NaN.
#[derive(Debug, Clone, Copy, Default)]
struct SamplePosition {
    left: u32,
    top: u32,
    to_right: f32,
    to_bottom: f32,
}

/// Computes the lookup positions of a pinhole camera's pixels, row by row.
struct RowLookup<'a> {
    projection: &'a Projection,
    camera: &'a Camera,
    /// Ray coordinate x of each column.
    across: Vec<f64>,
    /// Distorted ray coordinates (x', y') of a row.
    seen: Vec<(f64, f64)>,
}

impl<'a> RowLookup<'a> {
    fn new(Undistorter { projection, camera, columns, .. }: &'a Undistorter) -> Self {
        let Intrinsics { fx, cx, .. } = camera.intrinsics;
        let across: Vec<f64> = columns.clone().map(|j| (j as f64 + 0.5 - cx) / fx).collect();
        let seen = vec![(0., 0.); across.len()];
        RowLookup { projection, camera, across, seen }
    }

    /// Computes the lookup positions of row `i`.
    fn fill(&mut self, i: usize, row: &mut [SamplePosition]) {
        let Intrinsics { fy, cy, .. } = self.camera.intrinsics;
        let y = (i as f64 + 0.5 - cy) / fy;
        let part = match self.projection {
            Projection::Distortion(distortion) => return self.fill_distorted(distortion, y, row),
            Projection::Part(part) => part,
        };
        let last = part.lens.size();
        let [last_column, last_row] = [last.width, last.height].map(|count| f64::from(count - 1));
        for (place, &x) in row.iter_mut().zip(&self.across) {
            *place = match part.project_into_photo(DVec3::new(x, y, 1.)) {
                Some(position) => {
                    let (left, to_right) = between(position.x, last_column);
                    let (top, to_bottom) = between(position.y, last_row);
                    SamplePosition { left, top, to_right, to_bottom }
                }
                None => SamplePosition { to_right: f32::NAN, ..SamplePosition::default() },
            };
        }
    }

    /// Computes the lookup positions of the row with the ray coordinate `y` in a photo with the camera's intrinsics and size.
    fn fill_distorted(&mut self, distortion: &Distortion, y: f64, row: &mut [SamplePosition]) {
        let Camera { intrinsics: Intrinsics { fx, fy, cx, cy }, width, height, .. } = *self.camera;
        let [last_column, last_row] = [width, height].map(|count| f64::from(count - 1));
        // A separate loop, so that the compiler vectorizes it over several pixels.
        for (seen, x) in self.seen.iter_mut().zip(&self.across) {
            *seen = distortion.apply(*x, y);
        }
        for (place, seen) in row.iter_mut().zip(&self.seen) {
            let (left, to_right) = between(fx * seen.0 + cx, last_column);
            let (top, to_bottom) = between(fy * seen.1 + cy, last_row);
            *place = SamplePosition { left, top, to_right, to_bottom };
        }
    }
}

/// Returns the index of the last pixel center, along columns or rows, at or before `position`, and the fractional distance to the
/// next one. `position` is in pixels from the image's edge.
#[inline]
fn between(position: f64, last: f64) -> (u32, f32) {
    /// Constant 1.5·2⁵²: adding it rounds to integers, in the lowest bits.
    const WHOLE: f64 = 6_755_399_441_055_744.;
    let position = position - 0.5;
    // Comparisons instead of max() and min(), which handle NaN and take longer.
    let position = if position > 0. { position } else { 0. };
    let position = if position < last { position } else { last };
    // Halfway between two centers, either one may be chosen; with a fraction of 0 or 1 the result is the same.
    let whole = position - 0.5 + WHOLE;
    (whole.to_bits() as u32, (position - (whole - WHOLE)) as f32)
}

/// Writes the colors at the positions `row` in `photo`, three bytes each, and one more byte.
fn interpolate(photo: &RgbImage, row: &[SamplePosition], colors: &mut [u8]) {
    /// Constant 2²³: a float32 this large has no fraction, and added integers below 256 are in its lowest bits.
    const WHOLE: f32 = 8_388_608.;
    let [width, height] = [photo.width(), photo.height()].map(|count| count as usize);
    let photo: &[u8] = photo.as_raw();
    // Read four bytes instead of three, to fill a vector.
    let color = |bytes: &[u8]| {
        let bytes: [u8; 4] = bytes.try_into().expect("four numbers");
        Vec4::from_array(bytes.map(f32::from))
    };
    let mix = |a: Vec4, b: Vec4, share: f32| a + share * (b - a);
    // Interpolate between the pixel that begins at `byte` and the one to its right, which is unused in the last column.
    let along = |byte: usize, share: f32| match photo.get(byte..byte + 7) {
        Some(pair) => mix(color(&pair[..4]), color(&pair[3..]), share),
        None => {
            let mut pair = [0; 7];
            pair[..photo.len() - byte].copy_from_slice(&photo[byte..]);
            mix(color(&pair[..4]), color(&pair[3..]), share)
        }
    };
    for (j, place) in row.iter().enumerate() {
        let (left, top) = (place.left as usize, place.top as usize);
        let bottom = (top + 1).min(height - 1);
        let above = along(3 * (top * width + left), place.to_right);
        let below = along(3 * (bottom * width + left), place.to_right);
        // Round to the nearest of 256 levels. The fourth byte is overwritten by the next pixel.
        let levels = (mix(above, below, place.to_bottom) + WHOLE).to_array();
        colors[3 * j..][..4].copy_from_slice(&levels.map(|level| level.to_bits() as u8));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;
    use image::Rgb;

    const DISTORTION: Distortion = Distortion {
        radial: [-0.12, 0.05, -0.01, 0.002],
        denominator: [0.1, -0.03, 0.],
        tangential: [0.003, -0.002],
    };
    const LENS: Projection = Projection::Distortion(DISTORTION);
    const INTRINSICS: Intrinsics = Intrinsics { fx: 50., fy: 48., cx: 33., cy: 23. };
    const CAMERA: Camera = Camera { intrinsics: INTRINSICS, c2w: DMat4::IDENTITY, width: 64, height: 48 };

    fn noise(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let level = |k: u32| ((x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761) >> 24) as u8;
            Rgb([level(1), level(2), level(3)])
        })
    }

    /// Colors agree with the formulas of [`Undistorter`] in float64.
    #[test]
    fn colors_are_between_their_neighbours() {
        for (width, height) in [(64, 48), (1, 1), (1, 5), (5, 1), (2, 2)] {
            let (photo, camera) = (noise(width, height), Camera { width, height, ..CAMERA });
            let removed = Undistorter::new(LENS, camera, None).apply(&photo).image;
            let level = |x: f64, y: f64, k: usize| f64::from(photo.get_pixel(x as u32, y as u32)[k]);
            let [last_x, last_y] = [width, height].map(|count| f64::from(count - 1));
            for (j, i, found) in removed.enumerate_pixels() {
                let (x, y) = (f64::from(j) + 0.5 - INTRINSICS.cx, f64::from(i) + 0.5 - INTRINSICS.cy);
                let (x, y) = DISTORTION.apply(x / INTRINSICS.fx, y / INTRINSICS.fy);
                let u = (INTRINSICS.fx * x + INTRINSICS.cx - 0.5).clamp(0., last_x);
                let v = (INTRINSICS.fy * y + INTRINSICS.cy - 0.5).clamp(0., last_y);
                let (s, t, right, below) = (u.fract(), v.fract(), (u + 1.).min(last_x), (v + 1.).min(last_y));
                for k in 0..3 {
                    let top = level(u, v, k) * (1. - s) + level(right, v, k) * s;
                    let bottom = level(u, below, k) * (1. - s) + level(right, below, k) * s;
                    let exact = top * (1. - t) + bottom * t;
                    // The nearest level, up to the rounding of float32.
                    assert!(
                        (f64::from(found[k]) - exact).abs() < 0.5001,
                        "{found:?} for {exact} at ({j}, {i})"
                    );
                }
            }
        }
    }

    #[test]
    fn a_window_and_precomputed_positions_give_the_same_pixels() {
        let photo = noise(64, 48);
        let whole = Undistorter::new(LENS, CAMERA, None).apply(&photo);
        let part = || Undistorter::new(LENS, CAMERA, Some([7..40, 0..29]));
        let expected = part().apply(&photo);
        for (x, y) in (7..40).flat_map(|x| (0..29).map(move |y| (x, y))) {
            assert_eq!(expected.image.get_pixel(x, y), whole.image.get_pixel(x, y), "({x}, {y})");
        }
        assert_ne!(expected, whole);
        assert_eq!(part().precompute().apply(&photo), expected);
        assert_eq!(Undistorter::new(LENS, CAMERA, None).precompute().apply(&photo), whole);
    }

    #[test]
    fn an_undistorter_fits_its_projection_intrinsics_and_size() {
        let table = Undistorter::new(LENS, CAMERA, None);
        let elsewhere = Camera { c2w: DMat4::from_translation(DVec3::ONE), ..CAMERA };
        let longer = Camera { intrinsics: Intrinsics { fx: 51., ..INTRINSICS }, ..CAMERA };
        for (projection, camera, fits) in [
            (LENS, CAMERA, true),
            (LENS, elsewhere, true),
            (Projection::default(), CAMERA, false),
            (LENS, longer, false),
            (LENS, Camera { width: 65, ..CAMERA }, false),
        ] {
            assert_eq!(table.matches_camera(&projection, &camera), fits, "{projection:?} {camera:?}");
        }
    }
}
