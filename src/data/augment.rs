//! Augmentation in training, identical for all views of a sample: geometry (spec 8.3), and color jitter with the semantics of
//! torchvision's `ColorJitter` on floating-point images (spec 8.4). Every loop of the latter runs over whole planes without branches, so
//! that the compiler vectorizes it.

use super::config::{DataConfig, JitterConfig};
use crate::error::{Error, Result};
use crate::scene::{Camera, ImageSize};
use glam::{DMat4, DVec4};
use globalsplat_capture::{CHANNELS, Region, Resampler};
use image::RgbImage;
use rand::Rng;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

/// Weights of the color channels in the gray value, as in torchvision.
const GRAY: [f32; CHANNELS] = [0.2989, 0.587, 0.114];

/// A color adjustment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Adjustment {
    /// Factor on all color values.
    Brightness(f32),
    /// Factor on the distance from the image's mean gray.
    Contrast(f32),
    /// Factor on the distance from the pixel's gray.
    Saturation(f32),
    /// Rotation of the hue as a fraction of the full circle, −½ to ½.
    Hue(f32),
}

/// A sequence of color adjustments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Jitter {
    /// Adjustments in the order of application.
    pub adjustments: Vec<Adjustment>,
}

impl Jitter {
    /// Draws uniform factors within the limits of `config`, and a random order.
    pub fn draw(config: &JitterConfig, random: &mut impl Rng) -> Self {
        let mut factor = |strength: f64| random.random_range((1. - strength).max(0.)..=1. + strength) as f32;
        let mut adjustments = vec![
            Adjustment::Brightness(factor(config.brightness)),
            Adjustment::Contrast(factor(config.contrast)),
            Adjustment::Saturation(factor(config.saturation)),
            Adjustment::Hue(random.random_range(-config.hue..=config.hue) as f32),
        ];
        adjustments.shuffle(random);
        adjustments.retain(|adjustment| match *adjustment {
            Adjustment::Brightness(_) => config.brightness > 0.,
            Adjustment::Contrast(_) => config.contrast > 0.,
            Adjustment::Saturation(_) => config.saturation > 0.,
            Adjustment::Hue(_) => config.hue > 0.,
        });
        Jitter { adjustments }
    }

    /// Adjusts 8-bit `planes`, `[3, H, W]`, and rounds once, at the end. `scratch` is a buffer for reuse; its contents don't
    /// matter.
    pub fn apply_to_bytes(&self, planes: &mut [u8], scratch: &mut Vec<f32>) {
        if self.adjustments.is_empty() {
            return;
        }
        scratch.clear();
        scratch.extend(planes.iter().map(|&byte| f32::from(byte) / 255.));
        self.apply(scratch);
        for (byte, value) in planes.iter_mut().zip(scratch) {
            // Adding 2^23 leaves the nearest integer in the lowest bits of a float32.
            *byte = (*value * 255. + 8_388_608.).to_bits() as u8;
        }
    }

    /// Adjusts `planes`, `[3, H, W]`, values in [0, 1].
    pub fn apply(&self, planes: &mut [f32]) {
        for adjustment in &self.adjustments {
            match *adjustment {
                Adjustment::Brightness(factor) => {
                    planes.iter_mut().for_each(|value| *value = in_range(*value * factor));
                }
                Adjustment::Contrast(factor) => {
                    let offset = (1. - factor) * mean_gray(planes);
                    planes.iter_mut().for_each(|value| *value = in_range(factor * *value + offset));
                }
                Adjustment::Saturation(factor) => for_pixels(planes, |pixel| {
                    let gray = (1. - factor) * gray(pixel);
                    pixel.map(|value| in_range(factor * value + gray))
                }),
                Adjustment::Hue(turn) => {
                    let shift = 6. * (turn - turn.floor());
                    for_pixels(planes, |pixel| shift_hue(pixel, shift));
                }
            }
        }
    }
}

fn in_range(value: f32) -> f32 {
    value.clamp(0., 1.)
}

fn gray([red, green, blue]: [f32; CHANNELS]) -> f32 {
    GRAY[0] * red + GRAY[1] * green + GRAY[2] * blue
}

fn split(planes: &mut [f32]) -> [&mut [f32]; CHANNELS] {
    let pixels = planes.len() / CHANNELS;
    let (red, rest) = planes.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    [red, green, blue]
}

fn for_pixels(planes: &mut [f32], change: impl Fn([f32; CHANNELS]) -> [f32; CHANNELS]) {
    let [red, green, blue] = split(planes);
    for ((red, green), blue) in red.iter_mut().zip(green).zip(blue) {
        [*red, *green, *blue] = change([*red, *green, *blue]);
    }
}

/// Returns the mean gray of the image. Each float32 partial sum covers only a few hundred values, which keeps it accurate.
fn mean_gray(planes: &[f32]) -> f32 {
    const LANES: usize = 16;
    let pixels = planes.len() / CHANNELS;
    let plane_sum = |plane: &[f32]| {
        let mut total = 0f64;
        for block in plane.chunks(LANES * 64) {
            let mut lanes = [0f32; LANES];
            let whole = block.chunks_exact(LANES);
            let rest: f32 = whole.remainder().iter().sum();
            for part in whole {
                lanes.iter_mut().zip(part).for_each(|(lane, value)| *lane += value);
            }
            total += f64::from(lanes.iter().sum::<f32>() + rest);
        }
        total
    };
    let sum: f64 =
        planes.chunks_exact(pixels).zip(GRAY).map(|(p, share)| f64::from(share) * plane_sum(p)).sum();
    (sum / pixels as f64) as f32
}

/// Rotates the hue by `shift` sixths of the circle, 0 to 6, with value and chroma unchanged: HSV and back in one formula.
fn shift_hue([red, green, blue]: [f32; CHANNELS], shift: f32) -> [f32; CHANNELS] {
    let (value, least) = (red.max(green).max(blue), red.min(green).min(blue));
    let chroma = value - least;
    let inverse = if chroma > 0. { 1. / chroma } else { 0. };
    // Hues are in sixths of the circle: red is at 0, green at 2, blue at 4.
    let from_red = (green - blue) * inverse;
    let from_green = 2. + (blue - red) * inverse;
    let from_blue = 4. + (red - green) * inverse;
    let hue = if value == red {
        from_red
    } else if value == green {
        from_green
    } else {
        from_blue
    };
    let wrap = |sixths: f32| if sixths >= 6. { sixths - 6. } else { sixths };
    let hue = hue + shift;
    let hue = wrap(if hue < 0. { hue + 6. } else { hue });
    // A channel is at its minimum over two sixths of the circle, at its maximum over two sixths, and linear in between.
    [5., 3., 1.].map(|offset: f32| {
        let from = wrap(offset + hue);
        value - chroma * from.min(4. - from).clamp(0., 1.)
    })
}

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
    /// rectangle with `size`'s aspect ratio centered at the principal point, reduced by the extra crop. Its edges may lie inside
    /// pixels. Resampling handles that, so the intrinsics are exact.
    ///
    /// # Errors
    /// Fails if the principal point is so close to the photo's edge that too little is left.
    pub fn visible_region(&self, camera: &Camera, size: ImageSize) -> Result<(Region, Camera)> {
        let (full_width, full_height) = (f64::from(camera.width), f64::from(camera.height));
        let k = camera.intrinsics;
        let (centered_width, centered_height) =
            (2. * k.cx.min(full_width - k.cx), 2. * k.cy.min(full_height - k.cy));
        let aspect = f64::from(size.width) / f64::from(size.height);
        let width = centered_width.min(centered_height * aspect);
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
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn picture() -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(0);
        (0..3 * 40 * 33).map(|_| random.random_range(0f32..=1.)).collect()
    }

    fn adjusted(adjustments: &[Adjustment]) -> Vec<f32> {
        let mut planes = picture();
        Jitter { adjustments: adjustments.to_vec() }.apply(&mut planes);
        planes
    }

    fn farthest(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).fold(0., |most, (a, b)| most.max((a - b).abs()))
    }

    #[test]
    fn jitter_of_strength_0_is_the_identity() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(Jitter::draw(&JitterConfig::OFF, &mut random), Jitter::default());
        use Adjustment::*;
        for adjustment in [Brightness(1.), Contrast(1.), Saturation(1.), Hue(0.), Hue(1.)] {
            assert!(farthest(&adjusted(&[adjustment]), &picture()) < 1e-6, "{adjustment:?}");
        }
        let bytes: Vec<u8> = (0..=255).cycle().take(3 * 256).collect();
        let mut same = bytes.clone();
        let nothing = Jitter { adjustments: vec![Brightness(1.), Hue(0.)] };
        nothing.apply_to_bytes(&mut same, &mut vec![]);
        assert_eq!(same, bytes);
    }

    #[test]
    fn factors_and_orders_are_drawn_within_their_limits() {
        let config = JitterConfig { brightness: 0.2, contrast: 2., saturation: 0., hue: 0.5 };
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let mut first = std::collections::BTreeSet::new();
        for _ in 0..200 {
            let jitter = Jitter::draw(&config, &mut random);
            assert_eq!(jitter.adjustments.len(), 3);
            for adjustment in &jitter.adjustments {
                match *adjustment {
                    Adjustment::Brightness(factor) => assert!((0.8..=1.2).contains(&factor)),
                    Adjustment::Contrast(factor) => assert!((0. ..=3.).contains(&factor)),
                    Adjustment::Saturation(_) => panic!("it has no strength"),
                    Adjustment::Hue(turn) => assert!((-0.5..=0.5).contains(&turn)),
                }
            }
            first.insert(format!("{:?}", std::mem::discriminant(&jitter.adjustments[0])));
        }
        assert_eq!(first.len(), 3, "every adjustment comes first sometimes");
    }

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
