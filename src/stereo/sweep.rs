//! Depth estimation by a plane sweep (Collins 1996): finds for every pixel the depth at which its neighbourhood looks most alike in photos
//! taken from other positions. It needs no weights and no points.

use super::depth_search::{ComparedPhoto, Search, SmallPhoto};
use super::view_selection::{
    are_near_duplicates, at_octaves, distance, extent, farthest_first, neighbours, projection,
};
use crate::scene::Camera;
use globalsplat_capture::Point;
use tch::{Device, Kind, Tensor};

/// Longer side in pixels of the images that are compared.
pub(crate) const SWEEP_SIDE: f64 = 128.;
/// Number of inverse depths that are tried, evenly spaced from 0 to that of the nearest plane.
const PLANES: i64 = 128;
/// Longer side in pixels of the images that are compared to estimate the depth of the scene.
const COARSE_SIDE: f64 = 64.;
/// Number of inverse depths that are tried to estimate the depth of the scene.
const COARSE_PLANES: i64 = 48;
/// Shift of a pixel of the nearest plane in the nearest photo, as a fraction of the image width.
const LARGEST_MOVE: f64 = 0.7;
/// Maximum ratio of the scene's depth to that of the nearest plane, if it is estimated from photos alone.
const NEAREST: f64 = 24.;
/// Maximum depth of a pixel, in units of the nearest plane's depth.
const FARTHEST: f64 = 500.;
/// Maximum number of photos whose pixels get depths. Together they cover the scene.
const MAX_DEPTH_MAPS: usize = 32;
/// Number of distances that are tried for the depth of the scene: the extent of the cameras, its half, its quarter, and so on.
const OCTAVES: i32 = 9;
/// Minimum distance from infinity, in planes, of the median pixel for its depth to count as measured.
const RESOLVED: f64 = 2.;
/// Minimum fraction of the pixels that must agree on a depth.
const MIN_AGREEING_FRACTION: f64 = 0.05;
/// Correlation at or below which a depth has no weight.
const ZERO_WEIGHT_CORRELATION: f64 = 0.5;
/// Correlation above which a depth is usually right.
const MIN_CORRELATION: f64 = 0.8;
/// Number of times that known depths are spread to larger neighbourhoods.
const FILL_ROUNDS: usize = 6;
/// Factor of the weight of the spread depths, each time.
const FILL_DECAY: f64 = 0.1;
/// Minimum number of points that a view has to see. With fewer, its depths are estimated from the photos alone.
const MIN_POINTS: usize = 30;
/// Fraction of the points that may be nearer than the nearest plane.
const MAX_NEARER_FRACTION: f64 = 0.02;
/// Ratio of the depth of the nearest remaining point to that of the nearest plane.
const NEAR_PLANE_MARGIN: f64 = 1.3;

/// Result of a plane sweep.
pub(crate) struct PlaneSweepOutput {
    /// All views, downscaled.
    pub photos: Vec<SmallPhoto>,
    /// Depths of some of the views, with the views' indices, in their order.
    pub depth_maps: Vec<(usize, DepthMap)>,
    /// `true` if the work was not ended early.
    pub is_complete: bool,
}

/// Computes depths for the pixels of `photos`. If there are many photos, it processes a subset that together shows what all of them show,
/// without near duplicates. `points` of the scene, if some are known, determine the nearest depth. `should_continue` is called before each
/// photo with the number of photos that are done. If it returns `false`, only these get depths.
pub(crate) fn sweep(
    photos: Vec<SmallPhoto>,
    points: &[Point],
    mut should_continue: impl FnMut(usize) -> bool,
) -> PlaneSweepOutput {
    let mut sweep = Sweep::new(&photos, points);
    let (mut swept, mut is_complete) = (Vec::<(usize, DepthMap)>::new(), true);
    for index in farthest_first(&sweep.cameras, MAX_DEPTH_MAPS) {
        is_complete = should_continue(swept.len());
        if !is_complete {
            break;
        }
        let scene = sweep.scene_depth(index);
        let (this, cameras) = (&photos[index], &sweep.cameras);
        let is_new = |(other, _): &(usize, DepthMap)| {
            !are_near_duplicates(&this.camera, &cameras[*other], scene.depth)
        };
        if swept.iter().all(is_new) {
            let (others, nearest) = sweep.compared_with(index, &scene);
            let (inverse, correlation) = most_alike(this, &others, nearest, PLANES, Search::PatchCorrelation);
            let weight = (&correlation - ZERO_WEIGHT_CORRELATION).clamp_min(0.).square();
            let filled = filled(&inverse, &weight, this.counted().as_ref());
            let map = DepthMap {
                photo: this.name.clone(),
                camera: this.camera,
                image: this.image.shallow_clone(),
                depth: filled.clamp_min(nearest / FARTHEST).reciprocal(),
                sure: correlation.gt(MIN_CORRELATION),
                counted: this.counted(),
            };
            swept.push((index, map));
        }
    }
    swept.sort_by_key(|(index, _)| *index);
    PlaneSweepOutput { photos, depth_maps: swept, is_complete }
}

/// Photos whose depths are searched, one after the other.
pub(super) struct Sweep<'a> {
    photos: &'a [SmallPhoto],
    coarse: Vec<SmallPhoto>,
    cameras: Vec<Camera>,
    points: &'a [Point],
    /// Median depths of the photos so far, where they could be estimated.
    medians: Vec<f64>,
}

/// Distance of the scene from a photo.
pub(super) struct SceneDepth {
    /// Median depth of what the photo shows.
    depth: f64,
    /// Inverse depth of the nearest plane, if points determine it.
    nearest: Option<f64>,
}

impl<'a> Sweep<'a> {
    pub fn new(photos: &'a [SmallPhoto], points: &'a [Point]) -> Self {
        let coarse = photos.iter().map(|photo| photo.downscaled(COARSE_SIDE)).collect();
        let cameras = photos.iter().map(|photo| photo.camera).collect();
        Sweep { photos, coarse, cameras, points, medians: vec![] }
    }

    /// Estimates how far the scene is from photo `index`: from the points that the photo shows, else by comparing it with others. If the photo
    /// itself doesn't tell, uses those that came before.
    pub fn scene_depth(&mut self, index: usize) -> SceneDepth {
        let (median, nearest) = match inverse_depths_of(self.points, &self.coarse[index].camera) {
            Some(inverse) => {
                let last = ((1. - MAX_NEARER_FRACTION) * inverse.len() as f64) as usize;
                (Some(1. / inverse[inverse.len() / 2]), Some(NEAR_PLANE_MARGIN * inverse[last]))
            }
            None => (median_depth(index, &self.coarse), None),
        };
        self.medians.extend(median);
        let depth = median.unwrap_or_else(|| typical_depth(&self.medians, extent(&self.cameras)));
        SceneDepth { depth, nearest }
    }

    /// Returns the photos that photo `index` is compared with, which is about as far from the scene as `scene` says, and the inverse depth
    /// of the nearest plane.
    pub fn compared_with(&self, index: usize, scene: &SceneDepth) -> (Vec<&'a SmallPhoto>, f64) {
        let others = neighbours(index, &self.cameras, scene.depth);
        let others: Vec<&SmallPhoto> = others.into_iter().map(|other| &self.photos[other]).collect();
        let nearest = match (scene.nearest, others.first()) {
            (Some(nearest), _) => nearest,
            (None, Some(other)) => nearest_of_cameras(&self.photos[index], other).min(NEAREST / scene.depth),
            // Without other photos no depth can be measured: all pixels get the same depth.
            (None, None) => 2. / scene.depth,
        };
        (others, nearest)
    }
}

/// Estimates the median depth of photo `index` by comparing it with one photo at each of several distances, which are the extent of all
/// cameras times powers of ½. Photos that are too near show no parallax, and those that are too far show something else. The number of
/// photos at a distance makes no difference.
fn median_depth(index: usize, photos: &[SmallPhoto]) -> Option<f64> {
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    let others = at_octaves(index, &cameras, OCTAVES).into_iter();
    let compared = others.map(|other| measured(&photos[index], &photos[other]));
    let agreed: Vec<Measured> = compared.filter(|of| of.share >= MIN_AGREEING_FRACTION).collect();
    let resolved = agreed.iter().filter(|of| of.planes >= RESOLVED);
    // The farthest photo comes first. A scene without parallax there is at least that far away.
    let best = resolved.max_by(|a, b| a.share.total_cmp(&b.share)).or(agreed.first());
    best.map(|of| of.depth)
}

/// Depth on which two photos agree.
struct Measured {
    /// Median depth of the pixels whose correlation is above `MIN_CORRELATION`.
    depth: f64,
    /// Distance of the median from infinity, in planes.
    planes: f64,
    /// Fraction of the pixels that count whose correlation is above `MIN_CORRELATION`.
    share: f64,
}

fn measured(this: &SmallPhoto, other: &SmallPhoto) -> Measured {
    let nearest = nearest_of_cameras(this, other);
    let (inverse, correlation) = most_alike(this, &[other], nearest, COARSE_PLANES, Search::PatchCorrelation);
    let sure = inverse.masked_select(&correlation.gt(MIN_CORRELATION));
    let pixels =
        this.counted().map_or(inverse.numel() as i64, |counted| counted.sum(Kind::Int64).int64_value(&[]));
    let share = sure.numel() as f64 / pixels as f64;
    let plane = nearest / (COARSE_PLANES - 1) as f64;
    let median = if sure.numel() == 0 { 0. } else { sure.median().double_value(&[]) };
    Measured { depth: 1. / median.max(plane), planes: (median / plane).round(), share }
}

/// Returns the median of the depths of other photos. Without any, returns the extent of the cameras, or 1 if they don't move.
fn typical_depth(depths: &[f64], extent: f64) -> f64 {
    let mut sorted = depths.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.get(sorted.len() / 2) {
        Some(&depth) => depth,
        None if extent > 0. => extent,
        None => 1.,
    }
}

/// Returns the inverse depth of the nearest plane, chosen so that its pixels move by `LARGEST_MOVE` in the nearest photo.
fn nearest_of_cameras(this: &SmallPhoto, other: &SmallPhoto) -> f64 {
    let baseline = distance(&other.camera, &this.camera);
    LARGEST_MOVE * f64::from(this.camera.width) / (this.camera.intrinsics.fx * baseline)
}

/// Returns the sorted inverse depths of the points that the camera sees, or `None` if it sees too few.
fn inverse_depths_of(points: &[Point], camera: &Camera) -> Option<Vec<f64>> {
    let project = projection(camera);
    let mut inverse: Vec<f64> =
        points.iter().filter_map(|point| project(point.position)).map(|[_, _, z]| 1. / z).collect();
    inverse.sort_by(f64::total_cmp);
    (inverse.len() >= MIN_POINTS).then_some(inverse)
}

/// Returns the inverse depth of every pixel that `search` finds, and the correlation there or how sure it is, both [h, w]. The candidates
/// are `planes` inverse depths, evenly spaced from 0 to `nearest`.
pub(super) fn most_alike(
    this: &SmallPhoto,
    others: &[&SmallPhoto],
    nearest: f64,
    planes: i64,
    search: Search,
) -> (Tensor, Tensor) {
    if others.is_empty() {
        let options = (Kind::Float, Device::Cpu);
        return (Tensor::full(this.size(), nearest / 2., options), Tensor::zeros(this.size(), options));
    }
    let compared: Vec<ComparedPhoto> = others.iter().map(|other| other.compared_with(&this.camera)).collect();
    search.run(&this.gray, this.weight.as_ref(), &compared, nearest / (planes - 1) as f64, planes)
}

/// Replaces inverse depths of low weight by those of reliable pixels around them, the nearest weighted most.
pub(super) fn filled(inverse: &Tensor, weight: &Tensor, counted: Option<&Tensor>) -> Tensor {
    let size = inverse.size();
    let (mut sum, mut weights) = ((inverse * weight).unsqueeze(0), weight.unsqueeze(0));
    let (mut total, mut total_weights, mut factor) = (sum.copy(), weights.copy(), 1.);
    for _ in 0..FILL_ROUNDS {
        let pool = |t: &Tensor| t.avg_pool2d(5, 1, 2, false, true, None);
        (sum, weights) = (pool(&pool(&sum)), pool(&pool(&weights)));
        factor *= FILL_DECAY;
        total += &sum * factor;
        total_weights += &weights * factor;
    }
    // Pixels without any reliable pixel around them get the median.
    let median = counted.map_or(inverse.shallow_clone(), |counted| inverse.masked_select(counted)).median();
    let (least, median) = (1e-9, median.double_value(&[]));
    ((total + least * median) / (total_weights + least)).view(size.as_slice())
}

/// Downscaled photo with a depth for every pixel, on the CPU.
#[derive(Debug)]
pub struct DepthMap {
    /// Name of the photo.
    pub photo: String,
    /// Camera at the size of the downscaled photo.
    pub camera: Camera,
    /// Downscaled photo, [3, h, w].
    pub image: Tensor,
    /// Depth along the camera's axis, [h, w].
    pub depth: Tensor,
    /// Mask of the pixels on whose depth the photos agree, [h, w]. Other depths come from pixels around them.
    pub sure: Tensor,
    /// Mask of the pixels that count, [h, w], at least one; `None` if all do. The depths of the others are meaningless.
    pub counted: Option<Tensor>,
}

impl DepthMap {
    /// Returns the depth of every pixel, row by row.
    pub fn depths(&self) -> Vec<f32> {
        numbers(&self.depth)
    }

    /// Returns the depth of every pixel on which the photos agree, and infinity for the others, row by row.
    pub fn sure_depths(&self) -> Vec<f32> {
        let depths = self.depths().into_iter().zip(self.sure_pixels());
        depths.map(|(depth, is_sure)| if is_sure { depth } else { f32::INFINITY }).collect()
    }

    /// Returns the median depth of the pixels that count.
    pub fn median_depth(&self) -> f64 {
        let depths = self.counted.as_ref().map(|counted| self.depth.masked_select(counted));
        depths.as_ref().unwrap_or(&self.depth).median().double_value(&[])
    }

    /// Returns the photo's values, channel by channel.
    pub fn colors(&self) -> Vec<f32> {
        numbers(&self.image)
    }

    /// Returns for every pixel whether the photos agree on its depth.
    pub fn sure_pixels(&self) -> Vec<bool> {
        truths(&self.sure)
    }

    /// Returns for every pixel whether it counts; `None` if all do.
    pub fn counted_pixels(&self) -> Option<Vec<bool>> {
        self.counted.as_ref().map(truths)
    }

    /// Returns a map of one depth in black, all of it sure and counted, of a camera at the origin.
    #[cfg(test)]
    pub fn flat(width: u32, height: u32, depth: f64) -> Self {
        use crate::scene::Intrinsics;
        let (k, size) = (f64::from(width) / 2., [i64::from(height), i64::from(width)]);
        let options = (Kind::Float, Device::Cpu);
        DepthMap {
            photo: String::new(),
            camera: Camera {
                intrinsics: Intrinsics { fx: k, fy: k, cx: k, cy: f64::from(height) / 2. },
                c2w: glam::DMat4::IDENTITY,
                width,
                height,
            },
            image: Tensor::zeros([3, size[0], size[1]], options),
            depth: Tensor::full(size, depth, options),
            sure: Tensor::ones(size, (Kind::Bool, Device::Cpu)),
            counted: None,
        }
    }
}

/// Returns the values of a float32 tensor.
pub(crate) fn numbers(t: &Tensor) -> Vec<f32> {
    Vec::try_from(t.contiguous().view([-1])).expect("numbers")
}

/// Returns the values of a Boolean tensor.
pub(crate) fn truths(t: &Tensor) -> Vec<bool> {
    Vec::try_from(t.contiguous().view([-1])).expect("truths")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};

    /// Depths of a plane are found: a wave pattern at depth 4, seen by three cameras in a row.
    #[test]
    fn a_plane_is_found_where_it_is() {
        let (side, depth) = (64u32, 4.);
        let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 32. };
        let options = (Kind::Float, Device::Cpu);
        let photo = |at: f64, masked: bool| {
            let pixel = |offset: f64| (Tensor::arange(64, options) + 0.5 - 32.) / 60. * depth + offset;
            let x = pixel(at).view([1, 64]);
            let y = pixel(0.).view([64, 1]);
            let wave = ((&x * 5.).sin() * (&y * 4.).cos() + (&x * 11. + &y * 7.).sin()) * 0.25 + 0.5;
            let c2w = DMat4::from_translation(DVec3::new(at, 0., 0.));
            let camera = Camera { intrinsics, c2w, width: side, height: side };
            let (image, mask) = (wave.expand([3, 64, 64], false).copy(), Tensor::ones([1, 64, 64], options));
            // A mask of the left half, where the photos show something else.
            if masked {
                image.narrow(2, 0, 24).copy_(&Tensor::rand([3, 64, 24], options));
                let _ = mask.narrow(2, 0, 24).zero_();
            }
            SmallPhoto::new("", &image, masked.then_some(&mask), camera, SWEEP_SIDE)
        };
        let photos = |masked: bool| [-0.5, 0., 0.5].map(|at| photo(at, masked)).into();
        for (_, swept) in sweep(photos(true), &[], |_| true).depth_maps {
            let off = (&swept.depth / depth - 1.).abs();
            let counted = swept.counted.unwrap();
            assert_eq!(counted.sum(Kind::Int64).int64_value(&[]), 64 * 40);
            let off = off.masked_select(&counted).quantile_scalar(0.75, 0, false, "linear").double_value(&[]);
            assert!(off < 0.02, "{off}");
            // No pixel is sure that is masked out in its own photo, and most others are.
            let sure = |first: i64, count: i64| {
                swept.sure.narrow(1, first, count).to_kind(Kind::Double).mean(Kind::Double).double_value(&[])
            };
            assert_eq!(sure(0, 24), 0.);
            assert!(sure(24, 40) > 0.6, "{}", sure(24, 40));
        }
        for (_, swept) in sweep(photos(false), &[], |_| true).depth_maps {
            let off = (swept.depth / depth - 1.).abs().median().double_value(&[]);
            assert!(off < 0.02, "{off}");
        }
        // Points show that the scene begins at depth 3, so planes are closer together.
        let point = |i: i32| Point { position: DVec3::new(0.01 * f64::from(i), 0., 3.), color: [0.; 3] };
        let points: Vec<Point> = (0..40).map(point).collect();
        let photos: Vec<SmallPhoto> = photos(false);
        let nearest = |points: &[Point]| Sweep::new(&photos, points).scene_depth(1).nearest;
        assert!((nearest(&points).unwrap() - 1.3 / 3.).abs() < 1e-9);
        assert!(nearest(&points[..20]).is_none());
        // A single photo has no measurable depth, and the result must not be NaN.
        let alone = sweep(vec![photo(0., false)], &[], |_| true).depth_maps;
        assert!(alone[0].1.depth.isfinite().all().int64_value(&[]) == 1);
    }
}
