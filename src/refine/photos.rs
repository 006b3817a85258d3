//! Photos that a splat is refined on, at several sizes.

use super::known_depths::KnownDepths;
use super::options::RefineOptions;
use crate::data::{
    Capture, MIN_SHORTER_SIDE, PhotoSize, Pixels, View, ViewBatch, read_in_batches, select_views,
    view_matrices,
};
use crate::error::{Error, Result};
use crate::scene::{Camera, Intrinsics};
use crate::stereo::{DepthMap, are_near_duplicates, pool_masked};
use rand::Rng;
use rand::seq::index::sample;
use std::collections::BTreeMap;
use tch::{Device, Kind, Tensor};

/// Longer side in pixels of the downscaled images by which near duplicates are found.
const COMPARED_SIDE: f64 = 64.;
/// Maximum mean squared difference of near duplicates: 40 dB.
const NEARLY_EQUAL: f64 = 1e-4;

/// Reads the photos of `indices` at `size`. `should_continue` is called with the number of photos read so far, and ends the work if it returns
/// `false`.
///
/// # Errors
/// Fails like [`read_in_batches`], and if `should_continue` ends the work before all photos are read.
pub(super) fn load_photos(
    capture: &Capture,
    indices: &[usize],
    size: PhotoSize,
    should_continue: impl FnMut(usize) -> bool,
) -> Result<Vec<View>> {
    let mut views = vec![];
    match read_in_batches(capture, indices, size, should_continue, |some| views.extend(some))? {
        true => Ok(views),
        false => Err(Error::failed("stopped before all photos were read: nothing is written")),
    }
}

/// Returns the longest side of the photos, in pixels.
pub(super) fn longest_side(photos: &[View]) -> u32 {
    photos.iter().map(|photo| photo.camera.width.max(photo.camera.height)).max().unwrap_or(0)
}

/// Returns for each photo whether it isn't a near duplicate of one before it. Near duplicates of a scene at `depth` show nearly the same pixels
/// from nearly the same position: copies, or frames of a video in which the camera rests.
pub(super) fn distinct(photos: &[View], depth: f64) -> Vec<bool> {
    let small = |View { image, mask, camera, .. }: &View| {
        let factor = (COMPARED_SIDE / f64::from(camera.width.max(camera.height))).min(1.);
        let side = |pixels: u32| ((f64::from(pixels) * factor).round() as i64).max(1);
        // A photo with another mask shows something else.
        let image = match mask.as_ref().map(Pixels::to_float) {
            Some(mask) => Tensor::cat(&[image.to_float() * &mask, mask], 0),
            None => image.to_float(),
        };
        image.unsqueeze(0).adaptive_avg_pool2d([side(camera.height), side(camera.width)])
    };
    let mut kept: Vec<(Camera, Tensor)> = vec![];
    let is_kept = |view: &View| {
        let small = small(view);
        let is_nearly = |(camera, image): &(Camera, Tensor)| {
            are_near_duplicates(&view.camera, camera, depth)
                && small.size() == image.size()
                && (&small - image).square().mean(Kind::Float).double_value(&[]) <= NEARLY_EQUAL
        };
        let is_distinct = !kept.iter().any(is_nearly);
        if is_distinct {
            kept.push((view.camera, small));
        }
        is_distinct
    };
    photos.iter().map(is_kept).collect()
}

/// Photos at several sizes, from the smallest to the full size. Photos of one size are grouped.
#[derive(Debug)]
pub(crate) struct Photos {
    sizes: Vec<Vec<Group>>,
    /// Fractions of the optimization at which the next size begins.
    schedule: Vec<f64>,
}

/// Group of photos of one size.
#[derive(Debug)]
struct Group {
    /// Indices among all photos.
    indices: Vec<usize>,
    /// Photos on the device of the optimization, all of them with a mask or none.
    views: Vec<View>,
    /// Camera-to-world and world-to-camera matrices [1, V, 4, 4], and intrinsics [1, V, 3, 3].
    matrices: [Tensor; 3],
    /// Known depths of each photo.
    depths: Vec<Option<KnownDepths>>,
}

/// Photos of a step.
#[derive(Debug)]
pub(super) struct TrainBatch<'a> {
    /// Indices among all photos.
    pub which: Vec<i64>,
    pub views: ViewBatch,
    /// Known depths of each.
    pub depths: Vec<Option<&'a KnownDepths>>,
}

impl Group {
    /// Creates a group of `views`, some of which have a map in `depth_maps`.
    fn new(indices: &[usize], views: Vec<View>, depth_maps: &[Option<&DepthMap>], device: Device) -> Self {
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let known = |(&index, view): (&usize, &View)| {
            depth_maps[index].map(|map| KnownDepths::new(map, &view.camera, device))
        };
        let depths = indices.iter().zip(&views).map(known).collect();
        Group { depths, indices: indices.into(), matrices: view_matrices(&cameras, device), views }
    }

    /// Returns the photos at `positions` as a batch.
    fn select(&self, positions: &[usize]) -> ViewBatch {
        let stack = |pixels: Vec<&Pixels>| Pixels::stack(&pixels).unsqueeze(0);
        let masks: Option<Vec<&Pixels>> =
            positions.iter().map(|&view| self.views[view].mask.as_ref()).collect();
        let [c2w, w2c, intrinsics] =
            self.matrices.each_ref().map(|matrices| select_views(matrices, positions));
        let images = stack(positions.iter().map(|&view| &self.views[view].image).collect());
        ViewBatch { images, masks: masks.map(stack), depths: None, c2w, w2c, intrinsics }
    }
}

/// Returns views of one size at half their width and height, or as they are if they would become too small. Pixels are rounded to 8 bits.
/// Photos that are multiplied by their masks stay so if they are `over_black`.
fn halved(views: &[View], over_black: bool, device: Device) -> Vec<View> {
    let Camera { width, height, .. } = views[0].camera;
    if width.min(height) < 2 * MIN_SHORTER_SIDE {
        return views.iter().map(View::shallow_clone).collect();
    }
    let half = |t: &Tensor| t.unsqueeze(0).avg_pool2d(2, 2, 0, false, true, None).squeeze_dim(0);
    let (width, height) = (width / 2, height / 2);
    let allocate = |channels: i64| {
        Pixels::allocate(views.len() as i64, [channels, i64::from(height), i64::from(width)], device)
    };
    let mut masks = views[0].mask.is_some().then(|| allocate(1)).into_iter().flatten();
    let halve = |(view, mut small): (&View, Pixels)| {
        let mask = view.mask.as_ref().map(Pixels::to_float);
        let image = view.image.to_float();
        let (image, mask) = match over_black {
            true => (half(&image), mask.as_ref().map(half)),
            false => pool_masked(&image, mask.as_ref(), half),
        };
        small.copy_from_floats(&image);
        let mask = masks.next().zip(mask).map(|(mut small, mask)| {
            small.copy_from_floats(&mask);
            small
        });
        let Intrinsics { fx, fy, cx, cy } = view.camera.intrinsics;
        let intrinsics = Intrinsics { fx: fx / 2., fy: fy / 2., cx: cx / 2., cy: cy / 2. };
        let camera = Camera { intrinsics, width, height, ..view.camera };
        View { name: view.name.clone(), image: small, mask, camera }
    };
    views.iter().zip(allocate(3)).map(halve).collect()
}

impl Photos {
    /// Creates photos from `views`, at least one, at the sizes of `options`' schedule, each half as wide and high as the next, on its device.
    /// With a background for masked pixels, `views` are over black ([`Capture::over_black`]). Depths of some of them are known from
    /// `depth_maps`.
    pub(crate) fn new(views: &[View], depth_maps: &[DepthMap], options: &RefineOptions) -> Self {
        let device = options.device;
        let map_of = |view: &View| depth_maps.iter().find(|map| map.photo == view.name);
        let depth_maps: Vec<Option<&DepthMap>> = views.iter().map(map_of).collect();
        let schedule = options.schedule(longest_side(views));
        let mut groups: BTreeMap<(u32, u32), Vec<usize>> = BTreeMap::new();
        for (index, View { camera, .. }) in views.iter().enumerate() {
            groups.entry((camera.height, camera.width)).or_default().push(index);
        }
        let whole = |indices: Vec<usize>| {
            let has_masks = indices.iter().any(|&index| views[index].mask.is_some());
            let on_device = |&index: &usize| View {
                image: views[index].image.to_device(device),
                mask: has_masks.then(|| views[index].mask_or_ones().to_device(device)),
                ..views[index].shallow_clone()
            };
            Group::new(&indices, indices.iter().map(on_device).collect(), &depth_maps, device)
        };
        let mut sizes: Vec<Vec<Group>> = vec![groups.into_values().map(whole).collect()];
        for _ in &schedule {
            let over_black = options.mask_background.is_some();
            let half = |group: &Group| {
                let views = halved(&group.views, over_black, device);
                Group::new(&group.indices, views, &depth_maps, device)
            };
            sizes.push(sizes[sizes.len() - 1].iter().map(half).collect());
        }
        sizes.reverse();
        Photos { sizes, schedule }
    }

    /// Samples up to `views` different photos of one size, the size for `progress` from 0 to 1.
    pub(super) fn sample(&self, progress: f64, views: usize, random: &mut impl Rng) -> TrainBatch<'_> {
        let size = self.schedule.iter().filter(|&&part| progress >= part).count();
        let groups = &self.sizes[size.min(self.sizes.len() - 1)];
        let count = |group: &Group| group.indices.len();
        let mut owners = groups.iter().flat_map(|group| (0..count(group)).map(move |_| group));
        let of = random.random_range(0..groups.iter().map(count).sum::<usize>());
        let group = owners.nth(of).expect("a number below the sum");
        let mut chosen = sample(random, count(group), views.min(count(group))).into_vec();
        chosen.sort_unstable();
        TrainBatch {
            which: chosen.iter().map(|&k| group.indices[k] as i64).collect(),
            views: group.select(&chosen),
            depths: chosen.iter().map(|&k| group.depths[k].as_ref()).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::refine::MaskBackground;
    use glam::DMat4;

    /// Smaller copies are means of four pixels, or of those that count unless the others are black, rounded to 8 bits; photos stay as they
    /// were read.
    #[test]
    fn photos_are_halved_and_kept_as_bytes() {
        let options = (Kind::Float, Device::Cpu);
        let (height, width) = (2 * i64::from(MIN_SHORTER_SIDE), 2 * i64::from(MIN_SHORTER_SIDE) + 6);
        let levels = Tensor::randint(256, [3, height, width], (Kind::Uint8, Device::Cpu));
        let mask = Tensor::ones([1, height, width], options);
        let _ = mask.narrow(2, 0, 7).zero_();
        let (k, size) = (f64::from(MIN_SHORTER_SIDE), (width as u32, height as u32));
        let intrinsics = Intrinsics { fx: k, fy: k, cx: k, cy: k };
        let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width: size.0, height: size.1 };
        let black = Some(MaskBackground::Black);
        for (mask, mask_background) in [(None, None), (Some(&mask), None), (Some(&mask), black)] {
            let view = View {
                name: String::new(),
                image: levels.shallow_clone().into(),
                mask: mask.map(|mask| mask.shallow_clone().into()),
                camera,
            };
            let photos =
                Photos::new(&[view], &[], &RefineOptions { mask_background, ..RefineOptions::default() });
            let [half, whole] = [1, 2].map(|size| photos.sizes[size][0].select(&[0]));
            assert!(whole.images.equal(&(&levels / 255.).view([1, 1, 3, height, width])));
            let halves = |t: &Tensor| t.unsqueeze(0).avg_pool2d(2, 2, 0, false, true, None).squeeze_dim(0);
            let pixels = &levels / 255.;
            let expected = match mask_background {
                Some(_) => (halves(&pixels), mask.map(halves)),
                None => pool_masked(&pixels, mask, halves),
            };
            let off = |found: &Tensor, expected: &Tensor| {
                (found.get(0).get(0) - expected).abs().max().double_value(&[]) * 255.
            };
            let off_image = off(&half.images, &expected.0);
            assert!(off_image > 0.1 && off_image < 0.501, "{off_image} levels");
            if let Some(expected) = expected.1 {
                assert!(off(&half.masks.unwrap(), &expected) < 0.501);
            }
            assert_eq!(half.intrinsics.double_value(&[0, 0, 0, 2]), k / 2.);
        }
    }
}
