//! Test of poses by photos: a photo has to look as the depths of another one predict.

use super::depth_search::{SmallPhoto, pixels_between};
use super::sweep::{DepthMap, PlaneSweepOutput, numbers, truths};
use super::view_selection::pixel_and_depth;
use crate::scene::Camera;
use glam::DVec3;

/// Radius of a patch, whose side has 2 · `RADIUS` + 1 pixels.
const RADIUS: usize = 3;
/// Distance in pixels between the centers of compared patches.
const STEP: usize = 2;
/// Minimum standard deviation of a patch's gray values that tells a depth.
const MIN_DEVIATION: f32 = 0.02;
/// Minimum correlation of patches that show the same surface: less than that of the plane sweep, as the photos are farther apart.
const MIN_CORRELATION: f32 = 0.6;
/// Minimum ratio of a surface's depth to that of what a photo shows there, for it to be occluded.
const OCCLUDED: f64 = 1.1;
/// Distance of wrong places from the right one, relative to the photo's longer side: about 5° for most lenses.
const WRONG_PLACE: f64 = 0.08;
/// Cosine of the maximum angle between the directions from which two photos see a surface.
const MIN_COSINE: f64 = 0.866;

/// Downscaled photo that others are compared with.
pub(crate) struct ComparablePhoto {
    pub camera: Camera,
    /// Gray values, row by row; not a number where the photo is masked out.
    gray: Vec<f32>,
    /// Depths of the pixels on which photos agree, infinite for others; `None` if no depth of the photo is known.
    depths: Option<Vec<f32>>,
}

impl ComparablePhoto {
    /// Returns the photos of a plane sweep, in their order.
    pub fn of_sweep(swept: &PlaneSweepOutput) -> Vec<Self> {
        let photo = |photo: &SmallPhoto| {
            let mut gray = numbers(&photo.gray);
            if let Some(counted) = photo.counted() {
                let masked_out = gray.iter_mut().zip(truths(&counted)).filter(|(_, is_counted)| !is_counted);
                masked_out.for_each(|(value, _)| *value = f32::NAN);
            }
            ComparablePhoto { camera: photo.camera, gray, depths: None }
        };
        let mut photos: Vec<Self> = swept.photos.iter().map(photo).collect();
        for (index, map) in &swept.depth_maps {
            photos[*index].depths = Some(map.sure_depths());
        }
        photos
    }

    /// Returns a function that tells whether the photo shows a position: whether it is inside, and nothing is known to be in front of it.
    pub fn shows(&self) -> impl Fn(DVec3) -> bool {
        let project = pixel_and_depth(&self.camera);
        move |position| {
            project(position).is_some_and(|(pixel, z)| {
                self.gray[pixel].is_finite()
                    && self.depths.as_ref().is_none_or(|depths| z <= OCCLUDED * f64::from(depths[pixel]))
            })
        }
    }
}

/// Surfaces that a photo shows, by the depths of its pixels.
pub(crate) struct PhotoSurface {
    camera: Camera,
    gray: Vec<f32>,
    inverse_depths: Vec<f64>,
    /// Centers of patches that count, evenly spaced.
    pub patches: Vec<SurfacePatch>,
}

/// Patch of a photo.
pub(crate) struct SurfacePatch {
    /// Index of the pixel in the middle.
    pixel: usize,
    /// Position of the surface in the middle.
    pub position: DVec3,
    /// `true` if the gray values differ enough to tell a depth.
    pub is_textured: bool,
    /// `true` if the photos agree on the depth.
    pub is_sure: bool,
}

/// Agreement of another photo with the surfaces of a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Agreement {
    /// Fraction of the patches whose surface the other photo shows from a similar direction, of those that count.
    pub overlap: f64,
    /// Fraction of them that look alike in both photos, corrected for chance like Cohen's kappa: 1 if all do, and 0 if as many do as at wrong
    /// places nearby, where smooth or repeated textures look alike, too.
    pub kappa: f64,
}

impl PhotoSurface {
    pub fn new(map: &DepthMap) -> Self {
        let camera = map.camera;
        let (width, height) = (camera.width as usize, camera.height as usize);
        let gray = numbers(&map.image.mean_dim([0i64].as_slice(), false, tch::Kind::Float));
        let (depths, sure, counted) = (map.depths(), map.sure_pixels(), map.counted_pixels());
        let inner = |side: usize| (RADIUS..side.saturating_sub(RADIUS)).step_by(STEP);
        let pixels = inner(height).flat_map(|y| inner(width).map(move |x| (x, y)));
        let patch = |(x, y): (usize, usize)| {
            let pixel = y * width + x;
            SurfacePatch {
                pixel,
                position: camera.unproject(x as f64 + 0.5, y as f64 + 0.5, depths[pixel].into()),
                is_textured: PatchValues::read(&gray, width, pixel).variance() > MIN_DEVIATION.powi(2),
                is_sure: sure[pixel],
            }
        };
        let is_counted = |patch: &SurfacePatch| counted.as_ref().is_none_or(|counted| counted[patch.pixel]);
        let patches = pixels.map(patch).filter(is_counted).collect();
        let inverse_depths = depths.into_iter().map(|depth| 1. / f64::from(depth)).collect();
        PhotoSurface { camera, gray, inverse_depths, patches }
    }

    /// Compares `photo` with this one, warped to it by this one's depths.
    pub fn agreement(&self, photo: &ComparablePhoto) -> Agreement {
        let shows = photo.shows();
        let [from, to] = [&self.camera, &photo.camera].map(|camera| camera.c2w.w_axis.truncate());
        let is_seen_alike = |patch: &&SurfacePatch| {
            let directions = [from, to].map(|center| (patch.position - center).normalize());
            patch.is_textured
                && patch.is_sure
                && directions[0].dot(directions[1]) > MIN_COSINE
                && shows(patch.position)
        };
        let compared: Vec<&SurfacePatch> = self.patches.iter().filter(is_seen_alike).collect();
        let overlap = compared.len() as f64 / self.patches.len().max(1) as f64;
        if compared.is_empty() {
            return Agreement { overlap, kappa: 0. };
        }
        let warped = self.warp(photo);
        let [width, height] = [self.camera.width, self.camera.height].map(|side| side as usize);
        let shift = (width.max(height) as f64 * WRONG_PLACE) as isize;
        // Numbers of patches that look alike and of all, at the right place and at wrong ones.
        let (mut right, mut wrong) = ([0, 0], [0, 0]);
        for patch in compared {
            let this = PatchValues::read(&self.gray, width, patch.pixel);
            let (x, y) = ((patch.pixel % width) as isize, (patch.pixel / width) as isize);
            for (dx, dy) in [(0, 0), (shift, 0), (-shift, 0), (0, shift), (0, -shift)] {
                let is_inside =
                    |at: isize, side: usize| (RADIUS as isize..side as isize - RADIUS as isize).contains(&at);
                if !(is_inside(x + dx, width) && is_inside(y + dy, height)) {
                    continue;
                }
                let other = PatchValues::read(&warped, width, (y + dy) as usize * width + (x + dx) as usize);
                if other.0.iter().all(|value| value.is_finite()) {
                    let counts = if (dx, dy) == (0, 0) { &mut right } else { &mut wrong };
                    counts[0] += usize::from(this.correlation(&other) > MIN_CORRELATION);
                    counts[1] += 1;
                }
            }
        }
        if right[1] == 0 {
            return Agreement { overlap: 0., kappa: 0. };
        }
        let [right, chance] = [right, wrong].map(|[alike, all]| alike as f64 / f64::from(all.max(1) as u32));
        Agreement { overlap, kappa: (right - chance) / (1. - chance).max(1e-6) }
    }

    /// Returns the gray value of `photo` at the surface of each pixel, not a number outside of the photo.
    fn warp(&self, photo: &ComparablePhoto) -> Vec<f32> {
        let [width, height] = [photo.camera.width, photo.camera.height].map(|side| side as usize);
        let [u, v, one, inverse] = pixels_between(&self.camera, &photo.camera);
        let value = |(pixel, inverse_depth): (usize, &f64)| {
            let (x, y) = (pixel % self.camera.width as usize, pixel / self.camera.width as usize);
            let at = u * (x as f64 + 0.5) + v * (y as f64 + 0.5) + one + inverse * *inverse_depth;
            let (x, y) = (at.x / at.z - 0.5, at.y / at.z - 0.5);
            let is_inside =
                at.z > 0. && x >= 0. && y >= 0. && x < (width - 1) as f64 && y < (height - 1) as f64;
            if !is_inside {
                return f32::NAN;
            }
            let (left, top) = (x as usize, y as usize);
            let (x, y) = ((x - left as f64) as f32, (y - top as f64) as f32);
            let row = |row: usize| {
                photo.gray[row * width + left] * (1. - x) + photo.gray[row * width + left + 1] * x
            };
            row(top) * (1. - y) + row(top + 1) * y
        };
        self.inverse_depths.iter().enumerate().map(value).collect()
    }
}

const PATCH: usize = (2 * RADIUS + 1) * (2 * RADIUS + 1);

/// Gray values of a patch minus their mean.
struct PatchValues([f32; PATCH]);

impl PatchValues {
    /// Reads the patch around `pixel` of an image of `width`.
    fn read(gray: &[f32], width: usize, pixel: usize) -> Self {
        let first = pixel - RADIUS * width - RADIUS;
        let side = 2 * RADIUS + 1;
        let values: [f32; PATCH] = std::array::from_fn(|i| gray[first + i / side * width + i % side]);
        let mean = values.iter().sum::<f32>() / PATCH as f32;
        PatchValues(values.map(|value| value - mean))
    }

    fn variance(&self) -> f32 {
        self.0.iter().map(|value| value * value).sum::<f32>() / PATCH as f32
    }

    fn correlation(&self, other: &Self) -> f32 {
        let covariance = self.0.iter().zip(&other.0).map(|(a, b)| a * b).sum::<f32>() / PATCH as f32;
        covariance / (self.variance() * other.variance()).max(1e-12).sqrt()
    }
}
