//! Geometric and color augmentation in training, identical for all views of a sample (spec 8.3 and 8.4).

use super::config::DataConfig;
use super::jitter::Jitter;
use crate::error::{Error, Result};
use crate::scene::{Camera, ImageSize};
use glam::{DMat4, DVec4};
use globalsplat_capture::{Region, Resampler};
use image::RgbImage;
use rand::Rng;

/// Minimum side length, in pixels of the photo, of the usable rectangle around its principal point.
const SMALLEST_PART: f64 = 8.;

/// Random augmentation parameters, drawn once per sample.
#[derive(Debug, Clone, PartialEq)]
pub struct Augmentation {
    /// Factor, 1 or more, by which the visible part of the photo is smaller than the largest possible one.
    pub zoom: f64,
    /// Position of the visible part within the largest possible one, horizontally and vertically, from 0 to 1.
    pub shift: [f64; 2],
    /// `true` to swap left and right.
    pub flip: bool,
    /// Color jitter.
    pub jitter: Jitter,
}

impl Augmentation {
    /// Draws parameters within the limits of `config`.
    pub fn draw(config: &DataConfig, random: &mut impl Rng) -> Self {
        Augmentation {
            zoom: 1. + random.random_range(0. ..=config.extra_crop),
            shift: [random.random_range(0. ..=1.), random.random_range(0. ..=1.)],
            flip: random.random_bool(0.5) && config.flip,
            jitter: Jitter::draw(&config.jitter, random),
        }
    }

    /// Returns the visible region of a photo, and the camera of an image of `size` that shows it. The region is the largest
    /// rectangle with `size`'s aspect ratio centred at the principal point, reduced by the extra crop. Its edges may lie inside
    /// pixels. Resampling handles that, so the intrinsics are exact.
    ///
    /// # Errors
    /// Fails if the principal point is so close to the photo's edge that too little is left.
    pub fn visible_region(&self, camera: &Camera, size: ImageSize) -> Result<(Region, Camera)> {
        let (full_width, full_height) = (f64::from(camera.width), f64::from(camera.height));
        let k = camera.intrinsics;
        let (centred_width, centred_height) =
            (2. * k.cx.min(full_width - k.cx), 2. * k.cy.min(full_height - k.cy));
        let aspect = f64::from(size.width) / f64::from(size.height);
        let width = centred_width.min(centred_height * aspect);
        let height = width / aspect;
        if width.min(height) < SMALLEST_PART {
            return Err(Error::failed(format!(
                "the principal point ({:.1}, {:.1}) of a photo of {}×{} leaves less than {SMALLEST_PART} pixels around it",
                k.cx, k.cy, camera.width, camera.height
            )));
        }
        let (left, top) = (k.cx - width / 2., k.cy - height / 2.);
        let (shown_width, shown_height) = (width / self.zoom, height / self.zoom);
        let region = Region {
            left: (left + self.shift[0] * (width - shown_width)).max(0.),
            top: (top + self.shift[1] * (height - shown_height)).max(0.),
            width: shown_width,
            height: shown_height,
        };
        let (scale_x, scale_y) =
            (f64::from(size.width) / region.width, f64::from(size.height) / region.height);
        let intrinsics = k.cropped(region.left, region.top).resized(scale_x, scale_y);
        let shown = Camera { intrinsics, c2w: camera.c2w, width: size.width, height: size.height };
        Ok((region, if self.flip { mirrored(&shown) } else { shown }))
    }

    /// Writes `region` of `photo` into `planes`, `[3, H, W]` at `size`, with all augmentation except color jitter.
    pub fn crop_and_flip(
        &self,
        resampler: &mut Resampler,
        photo: &RgbImage,
        region: Region,
        size: ImageSize,
        planes: &mut [u8],
    ) {
        resampler.resample(photo, region, size, planes);
        if self.flip {
            planes.chunks_exact_mut(size.width as usize).for_each(<[u8]>::reverse);
        }
    }
}

/// Returns the camera whose image of the mirrored world is the mirror image of `camera`'s: its pose is F·c2w·F with F = diag(−1, 1,
/// 1, 1).
fn mirrored(camera: &Camera) -> Camera {
    let mirror = DMat4::from_diagonal(DVec4::new(-1., 1., 1., 1.));
    let mut intrinsics = camera.intrinsics;
    intrinsics.cx = f64::from(camera.width) - intrinsics.cx;
    Camera { intrinsics, c2w: mirror * camera.c2w * mirror, ..*camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DQuat, DVec3};
    use globalsplat_capture::check_pose;

    const SIZE: ImageSize = ImageSize { height: 96, width: 128 };

    fn camera() -> Camera {
        let intrinsics = Intrinsics { fx: 500., fy: 510., cx: 331.3, cy: 170.6 };
        let c2w = DMat4::from_rotation_translation(DQuat::from_rotation_y(0.4), DVec3::new(1., -2., 0.5));
        Camera { intrinsics, c2w, width: 640, height: 360 }
    }

    fn plain() -> Augmentation {
        Augmentation { zoom: 1., shift: [0.; 2], flip: false, jitter: Jitter::default() }
    }

    #[test]
    fn the_principal_point_is_in_the_middle() {
        let (region, shown) = plain().visible_region(&camera(), SIZE).unwrap();
        // There are 170.6 pixels above and 189.4 below: the region is 341.2 high, and by the aspect ratio 454.93 wide.
        assert!((region.top - 0.).abs() < 1e-9 && (region.height - 341.2).abs() < 1e-9, "{region:?}");
        assert!((region.width - 341.2 * 128. / 96.).abs() < 1e-9);
        assert!((shown.intrinsics.cx - 64.).abs() < 1e-9 && (shown.intrinsics.cy - 48.).abs() < 1e-9);
        assert!((shown.intrinsics.fx / shown.intrinsics.fy - 500. / 510.).abs() < 1e-9);
    }

    /// A bright dot on black keeps its ray in the world. The dot's position in the image is its centroid.
    #[test]
    fn augmentation_keeps_the_rays_of_pixels() {
        let (x, y) = (300u32, 200u32);
        let mut photo = RgbImage::new(640, 360);
        for (dx, dy) in (0..8).flat_map(|dx| (0..8).map(move |dy| (dx, dy))) {
            photo.put_pixel(x + dx, y + dy, image::Rgb([255; 3]));
        }
        let ray = |camera: &Camera, u: f64, v: f64| {
            let k = camera.intrinsics;
            let point = DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.);
            (camera.c2w.transform_point3(DVec3::ZERO), camera.c2w.transform_vector3(point))
        };
        let expected = ray(&camera(), f64::from(x) + 4., f64::from(y) + 4.);
        for (zoom, shift, flip) in
            [(1., [0., 0.], false), (1.3, [0.2, 0.7], false), (1., [0., 0.], true), (1.25, [0.9, 0.4], true)]
        {
            let augmentation = Augmentation { zoom, shift, flip, ..plain() };
            let (region, shown) = augmentation.visible_region(&camera(), SIZE).unwrap();
            let mut planes = vec![0; 3 * 96 * 128];
            augmentation.crop_and_flip(&mut Resampler::default(), &photo, region, SIZE, &mut planes);
            let (mut weight, mut sx, mut sy) = (0., 0., 0.);
            for (i, &byte) in planes[..96 * 128].iter().enumerate() {
                let (u, v) = ((i % 128) as f64 + 0.5, (i / 128) as f64 + 0.5);
                (weight, sx, sy) =
                    (weight + f64::from(byte), sx + f64::from(byte) * u, sy + f64::from(byte) * v);
            }
            let (mut origin, mut direction) = ray(&shown, sx / weight, sy / weight);
            check_pose(&shown.c2w).expect("a rigid motion");
            if flip {
                // The world is mirrored, so mirror the ray back.
                (origin.x, direction.x) = (-origin.x, -direction.x);
            }
            let off = (direction - expected.1).length();
            assert!(origin.abs_diff_eq(expected.0, 1e-9) && off < 2e-3, "{zoom} {shift:?} {flip}: {off}");
        }
    }

    #[test]
    fn a_principal_point_at_the_edge_is_refused() {
        let mut camera = camera();
        for cx in [-0.5, 3., 639.] {
            camera.intrinsics.cx = cx;
            let error = plain().visible_region(&camera, SIZE).unwrap_err().to_string();
            assert!(error.contains("principal point"), "{error}");
        }
    }
}
