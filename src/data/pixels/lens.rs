//! Photos without lens distortion (spec 10.5).

use super::distortion::Distortion;
use crate::scene::{Camera, Intrinsics};
use glam::Vec4;
use image::RgbImage;
use rayon::prelude::*;
use std::ops::Range;

/// The photo as `camera`, a pinhole camera, would have taken it. Its pixel (i, j) looks along x = (j + ½ − cx)/fx,
/// y = (i + ½ − cy)/fy, and takes its colour from the photo at (fx·x' + cx, fy·y' + cy), interpolated linearly between the
/// four pixel centres around; beyond the photo its border goes on. Of pixels beside `window`'s columns and rows, if there are
/// such, nothing is said.
pub(in crate::data) fn undistort(
    photo: RgbImage,
    distortion: &Distortion,
    camera: &Camera,
    window: Option<[Range<usize>; 2]>,
) -> RgbImage {
    if *distortion == Distortion::default() {
        return photo;
    }
    let [columns, rows] = window.unwrap_or_else(|| whole(camera));
    let mut looks = Looks::new(distortion, camera, &columns);
    let mut row = vec![Place::default(); columns.len()];
    let mut picture = Picture::of(photo);
    for i in rows {
        looks.fill(i, &mut row);
        picture.fill(i, columns.start, &row);
    }
    picture.finish()
}

/// All columns and rows of `camera`'s image.
fn whole(camera: &Camera) -> [Range<usize>; 2] {
    [camera.width, camera.height].map(|count| 0..count as usize)
}

/// What all photos that one camera took have in common, looked up once.
#[derive(Debug)]
pub(in crate::data) struct Lens {
    distortion: Distortion,
    camera: Camera,
    columns: Range<usize>,
    rows: Range<usize>,
    /// Row by row.
    places: Vec<Place>,
}

impl Lens {
    /// For `window`'s columns and rows, or all.
    pub fn new(distortion: Distortion, camera: Camera, window: Option<[Range<usize>; 2]>) -> Self {
        let [columns, rows] = window.unwrap_or_else(|| whole(&camera));
        let mut places = vec![Place::default(); columns.len() * rows.len()];
        places.par_chunks_mut(columns.len()).zip(rows.clone()).for_each_init(
            || Looks::new(&distortion, &camera, &columns),
            |looks, (row, i)| looks.fill(i, row),
        );
        Lens { distortion, camera, columns, rows, places }
    }

    /// Whether `camera`, wherever it is, looks through it.
    pub fn is_of(&self, distortion: &Distortion, camera: &Camera) -> bool {
        let known = |camera: &Camera| (camera.intrinsics, camera.width, camera.height);
        self.distortion == *distortion && known(&self.camera) == known(camera)
    }

    /// As the function of this name.
    pub fn undistort(&self, photo: RgbImage) -> RgbImage {
        let mut picture = Picture::of(photo);
        for (i, row) in self.rows.clone().zip(self.places.chunks(self.columns.len())) {
            picture.fill(i, self.columns.start, row);
        }
        picture.finish()
    }
}

/// Where in a photo a colour is: the pixel to the left and above, and how far it is to the next ones, 0 to 1.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
    left: u32,
    top: u32,
    to_right: f32,
    to_bottom: f32,
}

/// Where pixels of a pinhole camera look, row by row.
struct Looks<'a> {
    distortion: &'a Distortion,
    camera: &'a Camera,
    /// x of the columns.
    across: Vec<f64>,
    /// (x', y') of a row.
    seen: Vec<(f64, f64)>,
}

impl<'a> Looks<'a> {
    fn new(distortion: &'a Distortion, camera: &'a Camera, columns: &Range<usize>) -> Self {
        let Intrinsics { fx, cx, .. } = camera.intrinsics;
        let across: Vec<f64> = columns.clone().map(|j| (j as f64 + 0.5 - cx) / fx).collect();
        let seen = vec![(0., 0.); across.len()];
        Looks { distortion, camera, across, seen }
    }

    /// Row `i`.
    fn fill(&mut self, i: usize, row: &mut [Place]) {
        let Camera { intrinsics: Intrinsics { fx, fy, cx, cy }, width, height, .. } = *self.camera;
        let [last_column, last_row] = [width, height].map(|count| f64::from(count - 1));
        let y = (i as f64 + 0.5 - cy) / fy;
        // By themselves, as processors do these for several pixels at a time.
        for (seen, x) in self.seen.iter_mut().zip(&self.across) {
            *seen = self.distortion.apply(*x, y);
        }
        for (place, seen) in row.iter_mut().zip(&self.seen) {
            let (left, to_right) = between(fx * seen.0 + cx, last_column);
            let (top, to_bottom) = between(fy * seen.1 + cy, last_row);
            *place = Place { left, top, to_right, to_bottom };
        }
    }
}

/// The centre, of columns or rows, before `position`, which is in pixels from the image's edge, and how far it is to the next.
#[inline]
fn between(position: f64, last: f64) -> (u32, f32) {
    /// 1.5·2⁵²: adding it rounds to whole numbers, in the lowest bits.
    const WHOLE: f64 = 6_755_399_441_055_744.;
    let position = position - 0.5;
    // Not max() and min(), which think of NaN and take longer.
    let position = if position > 0. { position } else { 0. };
    let position = if position < last { position } else { last };
    // Halfway between two, the one or the other, which is the same with a share of 0 or 1.
    let whole = position - 0.5 + WHOLE;
    (whole.to_bits() as u32, (position - (whole - WHOLE)) as f32)
}

/// A photo, and what it becomes.
struct Picture {
    width: usize,
    height: usize,
    photo: Vec<u8>,
    /// And a byte more, that four can be written where the last pixel begins.
    undistorted: Vec<u8>,
}

impl Picture {
    fn of(photo: RgbImage) -> Self {
        let (width, height) = (photo.width() as usize, photo.height() as usize);
        let photo = photo.into_raw();
        Picture { width, height, undistorted: vec![0; photo.len() + 1], photo }
    }

    /// Of row `i`, from column `first` on.
    fn fill(&mut self, i: usize, first: usize, row: &[Place]) {
        /// 2²³: a float32 number this large has no fraction, and what is below 256 in its lowest bits.
        const WHOLE: f32 = 8_388_608.;
        let Picture { width, height, photo, undistorted } = self;
        // Four bytes for three, which are a vector.
        let colour = |bytes: &[u8]| {
            let bytes: [u8; 4] = bytes.try_into().expect("four numbers");
            Vec4::from_array(bytes.map(f32::from))
        };
        let mix = |a: Vec4, b: Vec4, share: f32| a + share * (b - a);
        // Between the pixel that begins at a byte and that to its right, which in the last column nobody asks for.
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
            // To the nearest of 256 levels. The fourth is the next one's.
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
        // So little that it goes through the interpolation and changes nothing that is visible.
        let tiny = Distortion { radial: [1e-12, 0., 0., 0.], ..Distortion::default() };
        assert_eq!(undistort(photo.clone(), &tiny, &CAMERA, None), photo);
    }

    /// By the formulas of [`undistort`] in float64.
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
                // The nearest level, but for float32's last digits.
                assert!((f64::from(found[k]) - exact).abs() < 0.5001, "{found:?} for {exact} at ({j}, {i})");
            }
        }
    }

    #[test]
    fn a_part_is_that_of_the_whole() {
        let photo = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 4, y as u8 * 5, (x * y % 251) as u8]));
        let whole = undistort(photo.clone(), &LENS, &CAMERA, None);
        let window = Some([7..40, 0..29]);
        let part = undistort(photo.clone(), &LENS, &CAMERA, window.clone());
        for (x, y) in (7..40).flat_map(|x| (0..29).map(move |y| (x, y))) {
            assert_eq!(part.get_pixel(x, y), whole.get_pixel(x, y), "({x}, {y})");
        }
        assert_ne!(part, whole);
        // And so where many share what is looked up.
        let lens = |window| Lens::new(LENS, CAMERA, window);
        assert_eq!(lens(None).undistort(photo.clone()), whole);
        assert_eq!(lens(window).undistort(photo), part);
    }

    #[test]
    fn a_lens_knows_its_cameras() {
        let lens = Lens::new(LENS, CAMERA, None);
        let elsewhere = Camera { c2w: DMat4::from_translation(DVec3::ONE), ..CAMERA };
        assert!(lens.is_of(&LENS, &CAMERA) && lens.is_of(&LENS, &elsewhere));
        assert!(!lens.is_of(&Distortion::default(), &CAMERA));
        let longer = Camera { intrinsics: Intrinsics { fx: 51., ..INTRINSICS }, ..CAMERA };
        assert!(!lens.is_of(&LENS, &longer) && !lens.is_of(&LENS, &Camera { width: 65, ..CAMERA }));
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
