//! Photos that a splat is refined on, at several sizes.

use super::config::RefineConfig;
use super::known_depths::KnownDepths;
use crate::data::{
    Capture, MIN_SHORTER_SIDE, MIN_SIDE, PhotoSize, Pixels, View, ViewBatch, load_views, select_views,
    view_matrices,
};
use crate::error::{Error, Result};
use crate::scene::{Camera, ImageSize};
use crate::stereo::{DepthMap, are_near_duplicates, pool_masked};
use rand::Rng;
use rand::seq::index::sample;
use std::collections::BTreeMap;
use tch::{Device, Kind, Tensor};

/// Number of photos that are read between two calls of `should_continue`.
const READ_AT_ONCE: usize = 8;
/// Longer side in pixels of the downscaled images by which near duplicates are found.
const COMPARED_SIDE: f64 = 64.;
/// Maximum mean squared difference of near duplicates: 40 dB.
const NEARLY_EQUAL: f64 = 1e-4;

/// Reads the photos of `indices` at `size`. `should_continue` is called with the number of photos read so far, and ends the work if it returns `false`.
///
/// # Errors
/// Fails like [`Capture::load`], if a photo has fewer than [`MIN_SIDE`] pixels along a side, or if `should_continue` ends the work before
/// all photos are read.
pub fn load_photos(
    capture: &Capture,
    indices: &[usize],
    size: PhotoSize,
    mut should_continue: impl FnMut(usize) -> bool,
) -> Result<Vec<View>> {
    let cameras = capture.cameras();
    let size_of = |index: usize| size.resized(&cameras[index]);
    for &index in indices {
        let ImageSize { width, height } = size.of(&cameras[index]);
        if width.min(height) < MIN_SIDE {
            let field = format!("the size of {}", capture.names().nth(index).unwrap_or_default());
            let expected = format!("{MIN_SIDE} pixels or more along each side");
            return Err(Error::input(capture.file(), field, format!("{width}×{height}"), expected));
        }
    }
    let mut views = vec![];
    for some in indices.chunks(READ_AT_ONCE) {
        if !should_continue(views.len()) {
            return Err(Error::failed("stopped before all photos were read: nothing is written"));
        }
        // Photos of one size are loaded together, as they share the lens undistortion.
        for group in some.chunk_by(|&a, &b| size_of(a) == size_of(b)) {
            views.extend(load_views(capture, group, size_of(group[0]))?);
        }
    }
    Ok(views)
}

/// Returns the indices of the photos that aren't near duplicates of a photo before them. Near duplicates of a scene at `depth` show nearly
/// the same pixels from nearly the same position: copies, or frames of a video in which the camera rests.
pub(super) fn distinct(photos: &[View], depth: f64) -> Vec<usize> {
    let small: Vec<Tensor> = photos
        .iter()
        .map(|View { image, mask, camera, .. }| {
            let factor = (COMPARED_SIDE / f64::from(camera.width.max(camera.height))).min(1.);
            let side = |pixels: u32| ((f64::from(pixels) * factor).round() as i64).max(1);
            // A photo with another mask shows something else.
            let image = match mask {
                Some(mask) => {
                    let mask = mask.to_float();
                    Tensor::cat(&[image.to_float() * &mask, mask], 0)
                }
                None => image.to_float(),
            };
            image.unsqueeze(0).adaptive_avg_pool2d([side(camera.height), side(camera.width)])
        })
        .collect();
    let mut kept: Vec<usize> = vec![];
    for index in 0..photos.len() {
        let is_nearly = |&other: &usize| {
            are_near_duplicates(&photos[index].camera, &photos[other].camera, depth)
                && small[index].size() == small[other].size()
                && (&small[index] - &small[other]).square().mean(Kind::Float).double_value(&[])
                    <= NEARLY_EQUAL
        };
        if !kept.iter().any(is_nearly) {
            kept.push(index);
        }
    }
    kept
}

/// Photos at several sizes, from the smallest to the full size. Photos of one size are grouped.
#[derive(Debug)]
pub struct Photos {
    sizes: Vec<Vec<Group>>,
    /// Fractions of the optimization at which the next size begins.
    schedule: Vec<f64>,
}

/// Group of photos of one size.
#[derive(Debug)]
struct Group {
    /// Indices among all photos.
    indices: Vec<usize>,
    /// Image of each photo, [3, H, W].
    images: Vec<Pixels>,
    /// Mask of each photo, [1, H, W]; `None` if every pixel of all photos counts.
    masks: Option<Vec<Pixels>>,
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
    /// Creates a group of photos, some of which have a map in `depth_maps` at their index among all photos.
    fn new(
        indices: Vec<usize>,
        images: Vec<Pixels>,
        masks: Option<Vec<Pixels>>,
        matrices: [Tensor; 3],
        depth_maps: &[Option<&DepthMap>],
    ) -> Self {
        let (size, device) = (images[0].size(), matrices[0].device());
        let known =
            |&index: &usize| depth_maps[index].map(|map| KnownDepths::new(map, size[2], size[1], device));
        Group { depths: indices.iter().map(known).collect(), indices, images, masks, matrices }
    }

    /// Creates a group of `views` of one size on `device`, which have the indices `indices` among all photos.
    fn from_views(
        indices: Vec<usize>,
        views: &[&View],
        depth_maps: &[Option<&DepthMap>],
        device: Device,
    ) -> Self {
        let images: Vec<Pixels> = views.iter().map(|view| view.image.to_device(device)).collect();
        let has_masks = views.iter().any(|view| view.mask.is_some());
        let masks =
            has_masks.then(|| views.iter().map(|view| view.mask_or_ones().to_device(device)).collect());
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        Group::new(indices, images, masks, view_matrices(&cameras, device), depth_maps)
    }

    /// Returns the photos at `positions` as a batch.
    fn select(&self, positions: &[usize]) -> ViewBatch {
        let stack = |pixels: &[Pixels]| {
            let chosen: Vec<&Pixels> = positions.iter().map(|&view| &pixels[view]).collect();
            Pixels::stack(&chosen).unsqueeze(0)
        };
        let [c2w, w2c, intrinsics] =
            self.matrices.each_ref().map(|matrices| select_views(matrices, positions));
        let masks = self.masks.as_deref().map(stack);
        ViewBatch { images: stack(&self.images), masks, depths: None, c2w, w2c, intrinsics }
    }

    /// Returns the photos at half their width and height, or as they are if they would become too small. Pixels are rounded to 8 bits.
    fn halved(&self, depth_maps: &[Option<&DepthMap>]) -> Self {
        let size = self.images[0].size();
        let [c2w, w2c, intrinsics] = self.matrices.each_ref().map(Tensor::shallow_clone);
        if size[1].min(size[2]) < 2 * i64::from(MIN_SHORTER_SIDE) {
            let clones = |pixels: &[Pixels]| pixels.iter().map(Pixels::shallow_clone).collect();
            let (images, masks) = (clones(&self.images), self.masks.as_deref().map(clones));
            return Group::new(self.indices.clone(), images, masks, [c2w, w2c, intrinsics], depth_maps);
        }
        let half = |t: &Tensor| t.unsqueeze(0).avg_pool2d(2, 2, 0, false, true, None).squeeze_dim(0);
        let allocate = |channels: i64| {
            let shape = [channels, size[1] / 2, size[2] / 2];
            Pixels::allocate(self.images.len() as i64, shape, c2w.device())
        };
        let (mut images, mut masks) = (allocate(3), self.masks.as_ref().map(|_| allocate(1)));
        for (index, image) in self.images.iter().enumerate() {
            let mask = self.masks.as_ref().map(|masks| masks[index].to_float());
            let (image, mask) = pool_masked(&image.to_float(), mask.as_ref(), half);
            images[index].copy_from_floats(&image);
            if let (Some(masks), Some(mask)) = (&mut masks, mask) {
                masks[index].copy_from_floats(&mask);
            }
        }
        let intrinsics = intrinsics.copy();
        let _ = intrinsics.narrow(2, 0, 2).g_mul_scalar_(0.5);
        Group::new(self.indices.clone(), images, masks, [c2w, w2c, intrinsics], depth_maps)
    }
}

impl Photos {
    /// Creates photos from `views` at their own size only.
    pub(crate) fn from_batch(views: ViewBatch) -> Self {
        assert!(views.masks.is_none(), "no masks are expected here");
        let (size, device) = (views.images.size(), views.images.device());
        let mut images = Pixels::allocate(size[1], [size[2], size[3], size[4]], device);
        for (index, image) in images.iter_mut().enumerate() {
            image.copy_from_floats(&views.images.get(0).get(index as i64));
        }
        let matrices = [views.c2w, views.w2c, views.intrinsics];
        let group =
            Group::new((0..images.len()).collect(), images, None, matrices, &vec![None; size[1] as usize]);
        Photos { sizes: vec![vec![group]], schedule: vec![] }
    }

    /// Creates photos from `views`, at least one, at the sizes of `config`'s schedule, each half as wide and high as the next. Depths of
    /// some of them are known from `depth_maps`.
    pub fn new(views: &[View], depth_maps: &[DepthMap], config: &RefineConfig, device: Device) -> Self {
        let map_of = |view: &View| depth_maps.iter().find(|map| map.photo == view.name);
        let depth_maps: Vec<Option<&DepthMap>> = views.iter().map(map_of).collect();
        let longest_side = views.iter().map(|view| view.camera.width.max(view.camera.height)).max();
        let schedule = config.schedule(longest_side.unwrap_or(0));
        let mut groups: BTreeMap<(u32, u32), Vec<usize>> = BTreeMap::new();
        for (index, View { camera, .. }) in views.iter().enumerate() {
            groups.entry((camera.height, camera.width)).or_default().push(index);
        }
        let group = |indices: Vec<usize>| {
            let views: Vec<&View> = indices.iter().map(|&i| &views[i]).collect();
            Group::from_views(indices, &views, &depth_maps, device)
        };
        let whole = groups.into_values().map(group).collect();
        let mut sizes: Vec<Vec<Group>> = vec![whole];
        for _ in &schedule {
            let halves = sizes[sizes.len() - 1].iter().map(|group| group.halved(&depth_maps)).collect();
            sizes.push(halves);
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
    use crate::scene::Intrinsics;
    use glam::DMat4;

    /// Smaller copies are means of four pixels, or of those that count, rounded to 8 bits; photos stay as they were read.
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
        for mask in [None, Some(mask)] {
            let view = View {
                name: String::new(),
                image: levels.shallow_clone().into(),
                mask: mask.as_ref().map(|mask| mask.shallow_clone().into()),
                camera,
            };
            let photos = Photos::new(&[view], &[], &RefineConfig::default(), Device::Cpu);
            let [half, whole] = [1, 2].map(|size| photos.sizes[size][0].select(&[0]));
            assert!(whole.images.equal(&(&levels / 255.).view([1, 1, 3, height, width])));
            let halves = |t: &Tensor| t.unsqueeze(0).avg_pool2d(2, 2, 0, false, true, None).squeeze_dim(0);
            let expected = pool_masked(&(&levels / 255.), mask.as_ref(), halves);
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
