//! Resizing and cropping of an image to the model's size (spec 9.2), with exact intrinsics.

use super::planes::Planes;
use super::resample::{Region, Resampler, source_range};
use crate::geometry::{Camera, ImageSize};
use image::RgbImage;
use std::ops::Range;

/// The first resize rounds the width to a multiple of this, at least one (spec 9.2).
const WIDTH_MULTIPLE: f64 = 8.;

/// The largest centered rectangle of a target aspect ratio in a camera's image, and the first resize.
struct Crop {
    /// The rectangle, in pixels of the source image.
    region: Region,
    /// Size of the rectangle after the first resize.
    size: ImageSize,
    /// Scale of the first resize along x and y.
    scale: (f64, f64),
    /// Top left corner after the first resize, in whole pixels.
    corner: (f64, f64),
}

impl Crop {
    fn new(camera: &Camera, size: ImageSize) -> Self {
        let (full_width, full_height) = (f64::from(camera.width), f64::from(camera.height));
        let scaled = full_width * f64::from(size.height) / full_height;
        let width = ((scaled / WIDTH_MULTIPLE).round() * WIDTH_MULTIPLE).max(WIDTH_MULTIPLE);
        let height = f64::from(size.height);
        let (scale_x, scale_y) = (width / full_width, height / full_height);

        let aspect = f64::from(size.width) / height;
        // At least one pixel is left, however elongated the target size is.
        let crop_width = f64::from(size.width).min(width).max(1.);
        let crop_height = (width / aspect).min(height).round().max(1.);
        let (left, top) = (((width - crop_width) / 2.).floor(), ((height - crop_height) / 2.).floor());
        Crop {
            // Only the part that is kept is resampled.
            region: Region {
                left: left / scale_x,
                top: top / scale_y,
                width: crop_width / scale_x,
                height: crop_height / scale_y,
            },
            size: ImageSize { height: crop_height as u32, width: crop_width as u32 },
            scale: (scale_x, scale_y),
            corner: (left, top),
        }
    }
}

fn has_size(camera: &Camera, size: ImageSize) -> bool {
    (camera.height, camera.width) == (size.height, size.width)
}

/// Returns the columns and the rows of a camera's image that [`resize_and_crop`] to `size` reads.
pub(crate) fn source_window(camera: &Camera, size: ImageSize) -> [Range<usize>; 2] {
    let [width, height] = [camera.width, camera.height].map(|count| count as usize);
    if has_size(camera, size) {
        return [0..width, 0..height];
    }
    let Crop { region, size, .. } = Crop::new(camera, size);
    [
        source_range((width, region.left, region.width, size.width as usize)),
        source_range((height, region.top, region.height, size.height as usize)),
    ]
}

/// Resizes the image to the height of `size` with the aspect ratio kept (width rounded to a multiple of 8), cuts out the largest
/// centered rectangle with the aspect ratio of `size`, and resizes again if the result doesn't have `size` yet. Returns the planes,
/// `[3, H, W]`, and the camera with adjusted intrinsics; an image of `size` already is returned unchanged.
pub fn resize_and_crop(image: &RgbImage, camera: &Camera, size: ImageSize) -> (Planes, Camera) {
    if has_size(camera, size) {
        return (Planes::from_rgb(image), *camera);
    }
    let crop = Crop::new(camera, size);
    let planes = resample_planes(image, crop.region, crop.size);
    let intrinsics =
        camera.intrinsics.resized(crop.scale.0, crop.scale.1).cropped(crop.corner.0, crop.corner.1);

    let (planes, intrinsics) = if crop.size == size {
        (planes, intrinsics)
    } else {
        let cropped = planes.to_rgb();
        let x = f64::from(size.width) / f64::from(cropped.width());
        let y = f64::from(size.height) / f64::from(cropped.height());
        (resample_planes(&cropped, Region::whole(&cropped), size), intrinsics.resized(x, y))
    };
    (planes, Camera { intrinsics, c2w: camera.c2w, width: size.width, height: size.height })
}

/// Returns `region` of the image, resampled to `size`.
pub(super) fn resample_planes(image: &RgbImage, region: Region, size: ImageSize) -> Planes {
    let mut planes = Planes::new(size.width, size.height);
    Resampler::default().resample(image, region, size, planes.bytes_mut());
    planes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Intrinsics;
    use glam::{DMat4, DVec2};

    fn camera(width: u32, height: u32) -> Camera {
        let (w, h) = (f64::from(width), f64::from(height));
        let intrinsics = Intrinsics { fx: 500., fy: 510., cx: w / 2., cy: h / 2. };
        Camera { intrinsics, c2w: DMat4::IDENTITY, width, height }
    }

    #[test]
    fn images_are_cut_to_the_aspect_ratio_around_their_center() {
        for (width, height, size, [fx, fy]) in [
            // 640×360 → 456×256 (455.1 rounded to a multiple of 8) → 256×256.
            (640, 360, [256, 256], [500. * 456. / 640., 510. * 256. / 360.]),
            // 1080×1920 → 72×128 → 72×48 → 192×128.
            (1080, 1920, [128, 192], [500. * 192. / 1080., 510. * 128. / 1920. * 128. / 48.]),
        ] {
            let image = RgbImage::new(width, height);
            let (_, Camera { intrinsics: k, .. }) =
                resize_and_crop(&image, &camera(width, height), size.into());
            let [cy, cx] = size.map(|count| f64::from(count) / 2.);
            for (found, expected) in [(k.fx, fx), (k.fy, fy), (k.cx, cx), (k.cy, cy)] {
                assert!((found - expected).abs() < 1e-9, "{k:?}");
            }
        }
        // At least a pixel of a row or a column is left.
        for size in [[1, 4000], [4000, 1], [11, 2000]] {
            let (image, fitted) = resize_and_crop(&RgbImage::new(40, 40), &camera(40, 40), size.into());
            let (width, height) = image.to_rgb().dimensions();
            assert_eq!(([height, width], [fitted.height, fitted.width]), (size, size));
        }
    }

    #[test]
    fn pixels_outside_the_source_window_are_not_read() {
        let (camera, size) = (camera(200, 360), [24, 24].into());
        let [columns, rows] = source_window(&camera, size);
        assert!(columns.len() == 200 && rows.len() < 330, "{columns:?} {rows:?}");
        let image = RgbImage::from_fn(200, 360, |x, y| image::Rgb([(x * 7 + y * 13) as u8; 3]));
        let mut window = image.clone();
        let outside = window.enumerate_pixels_mut().filter(|(_, y, _)| !rows.contains(&(*y as usize)));
        outside.for_each(|(_, _, pixel)| pixel.0 = [0; 3]);
        assert_ne!(window, image);
        let [whole, window] = [&image, &window].map(|image| resize_and_crop(image, &camera, size).0);
        assert!(whole == window);
    }

    #[test]
    fn resizing_keeps_the_rays_of_pixels() {
        // A bright dot on black keeps its ray. The dot's position in the fitted image is its centroid.
        let is_dot = |x, y| (300..308).contains(&x) && (200..208).contains(&y);
        let image = RgbImage::from_fn(640, 360, |x, y| image::Rgb([if is_dot(x, y) { 255 } else { 0 }; 3]));
        let before = camera(640, 360);
        let (fitted, after) = resize_and_crop(&image, &before, [128, 128].into());
        let (mut weight, mut sum) = (0., DVec2::ZERO);
        for (x, y, pixel) in fitted.to_rgb().enumerate_pixels() {
            let level = f64::from(pixel[0]);
            weight += level;
            sum += level * (DVec2::new(x.into(), y.into()) + 0.5);
        }
        let ray = |k: Intrinsics, pixel: DVec2| (pixel - DVec2::new(k.cx, k.cy)) / DVec2::new(k.fx, k.fy);
        let found = ray(after.intrinsics, sum / weight);
        let expected = ray(before.intrinsics, DVec2::new(304., 204.));
        assert!(found.abs_diff_eq(expected, 2e-3), "{found} {expected}");
    }
}
