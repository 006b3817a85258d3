//! Photos as pinhole cameras would have taken them (spec 10.5).

use crate::geometry::{Camera, Intrinsics};
use crate::lens::{Lens, LensModel, Projection};
use glam::{DVec2, Vec4};
use image::{Rgb, RgbImage};
use std::ops::Range;

/// Returns the pinhole view of `photo` that has the projection and the camera, and a mask with equal channels: white where the photo shows
/// the view, and black elsewhere; `None` if the photo shows all of it. Only the pixels in the `window` of columns and rows are computed.
///
/// Pixel (i, j) has the ray x = (j + ½ − cx)/fx, y = (i + ½ − cy)/fy, and takes its color from the position in the photo to which the
/// projection maps the ray, interpolated linearly between the four surrounding pixel centers. The border of a photo of a perspective lens
/// is repeated beyond it.
pub(crate) fn undistort(
    photo: &RgbImage,
    projection: &Projection,
    camera: &Camera,
    window: &[Range<usize>; 2],
) -> (RgbImage, Option<RgbImage>) {
    let Lens { intrinsics: Intrinsics { fx, fy, cx, cy }, model, .. } = projection.lens;
    match model {
        // A loop of its own, which the compiler vectorizes.
        LensModel::Perspective(distortion) => {
            let (focal, center) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
            sample(photo, camera, window, |point| distortion.apply(point) * focal + center)
        }
        _ => {
            sample(photo, camera, window, |point| projection.position(point.extend(1.)).unwrap_or(DVec2::NAN))
        }
    }
}

/// Returns the pixels of the view and its mask. `position` maps a ray (x, y, 1) to its position in the photo, NaN if there is none.
fn sample(
    photo: &RgbImage,
    camera: &Camera,
    [columns, rows]: &[Range<usize>; 2],
    position: impl Fn(DVec2) -> DVec2,
) -> (RgbImage, Option<RgbImage>) {
    let Camera { width, height, intrinsics: Intrinsics { fx, fy, cx, cy }, .. } = *camera;
    let across: Vec<f64> = columns.clone().map(|j| (j as f64 + 0.5 - cx) / fx).collect();
    let mut positions = vec![DVec2::ZERO; across.len()];
    let (mut view, mut mask) = (RgbImage::new(width, height), None);
    for (i, row) in view.enumerate_rows_mut().take(rows.end).skip(rows.start) {
        let y = (f64::from(i) + 0.5 - cy) / fy;
        positions.iter_mut().zip(&across).for_each(|(place, &x)| *place = position(DVec2::new(x, y)));
        for ((j, i, pixel), &position) in row.skip(columns.start).zip(&positions) {
            if !position.is_nan() {
                *pixel = interpolate(photo, position);
            } else {
                let white = || RgbImage::from_pixel(width, height, Rgb([u8::MAX; 3]));
                mask.get_or_insert_with(white).put_pixel(j, i, Rgb([0; 3]));
            }
        }
    }
    (view, mask)
}

/// Returns the color at a position in a photo, in pixels from its corner.
fn interpolate(photo: &RgbImage, position: DVec2) -> Rgb<u8> {
    /// Constant 2²³: a float32 this large has no fraction, and added integers below 256 are in its lowest bits.
    const WHOLE: f32 = 8_388_608.;
    let (left, to_right) = before(position.x, photo.width());
    let (top, to_bottom) = before(position.y, photo.height());
    let bottom = (top + 1).min(photo.height() as usize - 1);
    // Four bytes in place of three, to fill a vector. The last one is unused.
    let color = |bytes: &[u8]| {
        let bytes: [u8; 4] = bytes.try_into().expect("four bytes");
        Vec4::from_array(bytes.map(f32::from))
    };
    let mix = |a: Vec4, b: Vec4, share: f32| a + share * (b - a);
    // The pixel to the right has no weight in the last column.
    let mix_pair = |pair: &[u8]| mix(color(&pair[..4]), color(&pair[3..]), to_right);
    let row = |y: usize| {
        let bytes = &photo.as_raw()[3 * (y * photo.width() as usize + left)..];
        match bytes.get(..7) {
            Some(pair) => mix_pair(pair),
            None => mix_pair(&std::array::from_fn::<u8, 7, _>(|i| bytes.get(i).copied().unwrap_or(0))),
        }
    };
    // Round to the nearest of 256 levels.
    let levels = (mix(row(top), row(bottom), to_bottom) + WHOLE).to_array();
    let [red, green, blue, _] = levels.map(|level| level.to_bits() as u8);
    Rgb([red, green, blue])
}

/// Returns the last of `count` pixel centers, along columns or rows, at or before `position`, and the fractional distance to the next one.
/// Positions beyond the outermost centers count as these.
fn before(position: f64, count: u32) -> (usize, f32) {
    /// Constant 1.5·2⁵²: adding it rounds to integers, in the lowest bits.
    const WHOLE: f64 = 6_755_399_441_055_744.;
    let (position, last) = (position - 0.5, f64::from(count - 1));
    // Comparisons instead of max() and min(), which handle NaN and take longer.
    let position = if position > 0. { position } else { 0. };
    let position = if position < last { position } else { last };
    // Halfway between two centers, either one may be chosen; with a fraction of 0 or 1 the result is the same.
    let whole = position - 0.5 + WHOLE;
    (whole.to_bits() as u32 as usize, (position - (whole - WHOLE)) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::ImageSize;
    use glam::{DMat3, DMat4, DVec3};

    /// Colors agree with the formulas of [`undistort`] in float64.
    #[test]
    fn colors_are_between_their_neighbours() {
        let parameters = [50., 48., 33., 23., -0.12, 0.05, 0.003, -0.002, -0.01, 0.1, -0.03, 0.];
        let size = ImageSize { height: 48, width: 64 };
        let whole = Lens::from_colmap("FULL_OPENCV", &parameters, size).unwrap();
        for (width, height) in [(64, 48), (1, 1), (1, 5), (5, 1), (2, 2)] {
            let photo = RgbImage::from_fn(width, height, |x, y| {
                let hash = |k: u32| (x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761);
                Rgb([1, 2, 3].map(|k| (hash(k) >> 24) as u8))
            });
            let camera = Camera { intrinsics: whole.intrinsics, c2w: DMat4::IDENTITY, width, height };
            let lens = Lens::new(&camera, whole.model);
            let projection = Projection { lens, rotation: DMat3::IDENTITY };
            let window = [width, height].map(|count| 0..count as usize);
            let (view, mask) = undistort(&photo, &projection, &camera, &window);
            assert!(mask.is_none());
            let level = |x: f64, y: f64, k: usize| f64::from(photo.get_pixel(x as u32, y as u32)[k]);
            let [last_x, last_y] = [width, height].map(|count| f64::from(count - 1));
            for (j, i, found) in view.enumerate_pixels() {
                let Intrinsics { fx, fy, cx, cy } = lens.intrinsics;
                let ray = DVec3::new((f64::from(j) + 0.5 - cx) / fx, (f64::from(i) + 0.5 - cy) / fy, 1.);
                let position = lens.project(ray).unwrap() - 0.5;
                let (u, v) = (position.x.clamp(0., last_x), position.y.clamp(0., last_y));
                let (s, t, right, below) = (u.fract(), v.fract(), (u + 1.).min(last_x), (v + 1.).min(last_y));
                for k in 0..3 {
                    let top = level(u, v, k) * (1. - s) + level(right, v, k) * s;
                    let bottom = level(u, below, k) * (1. - s) + level(right, below, k) * s;
                    let exact = top * (1. - t) + bottom * t;
                    // The nearest level, up to the rounding of float32.
                    let off = (f64::from(found[k]) - exact).abs();
                    assert!(off < 0.5001, "{found:?} for {exact} at ({j}, {i})");
                }
            }
        }
    }
}
