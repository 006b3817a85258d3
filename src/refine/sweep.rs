//! Where the pixels of posed photos lie: for every pixel the depth at which its surroundings look alike in the photos taken
//! from other places (a plane sweep; Collins 1996). No weights are needed, and no points.

use super::view_selection::{
    are_near_duplicates, at_octaves, extent, farthest_first, neighbours, projection,
};
use crate::data::{Point, View};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat4, DVec3};
use tch::{Device, Kind, Tensor};

/// Pixels along the longer side of the pictures that are compared.
const LONGEST_SIDE: f64 = 128.;
/// Inverse depths that are tried, evenly from 0 to the nearest plane's.
const PLANES: i64 = 128;
/// Pixels along the longer side, and inverse depths, where the depth of the scene is estimated.
const COARSE_SIDE: f64 = 64.;
const COARSE_PLANES: i64 = 48;
/// Of the picture's width: how far a pixel of the nearest plane moves in the photo taken nearest.
const LARGEST_MOVE: f64 = 0.7;
/// How much nearer than the scene the nearest plane is, at most, where photos alone tell it.
const NEAREST: f64 = 24.;
/// The farthest that pixels are put, in units of the nearest plane's distance.
const FARTHEST: f64 = 500.;
/// Photos whose pixels get depths, at the most: together they have seen what there is to see.
const MOST: usize = 32;
/// Distances at which the depth of the scene is looked for: the extent of the cameras, its half, its quarter, and so on.
const OCTAVES: i32 = 9;
/// Planes that a pixel has to be away from infinity, in the median, for its depth to count as measured.
const RESOLVED: f64 = 2.;
/// Pixels that have to agree on a depth, as a share of all.
const LEAST_SHARE: f64 = 0.05;
/// Side of the surroundings that are compared, pixels.
const PATCH: i64 = 9;
/// What is added to variances, so that noise is not taken for likeness.
const LEAST_VARIANCE: f64 = 1e-4;
/// Correlation at or below which a depth counts for nothing.
const UNSURE: f64 = 0.5;
/// Correlation above which a depth is right, most often.
const SURE: f64 = 0.8;
/// Times that what is known is spread to wider surroundings, and what it counts there, each time.
const SPREADS: usize = 6;
const SPREAD_WEIGHT: f64 = 0.1;
/// Points that a view has to see, or its depths are guessed from the photos alone.
const LEAST_POINTS: usize = 30;
/// Of the points, those that may be nearer than the nearest plane, and how much nearer it is than the others.
const NEARER: f64 = 0.02;
const ROOM: f64 = 1.3;

/// A photo with a depth for every pixel.
#[derive(Debug)]
pub struct Swept {
    /// At the size of the others, which is small.
    pub camera: Camera,
    /// [3, h, w].
    pub image: Tensor,
    /// Along the camera's axis, [h, w].
    pub depth: Tensor,
    /// Where photos agree on it, and not only what lies around, [h, w].
    pub sure: Tensor,
}

/// A small photo, on the device that compares it.
struct Small {
    camera: Camera,
    /// [3, h, w].
    image: Tensor,
    /// [h, w].
    grey: Tensor,
}

/// Finds depths for the pixels of the views, or where these are many, of some that together show what all of them show: near
/// duplicates don't count. `points` of the scene, where some are known, tell where it begins. `go_on` is asked before each view, with
/// how many are done; when it says no, these are all there is. The work is done on `device`, and its results are there.
pub fn sweep(
    views: &[View],
    points: &[Point],
    device: Device,
    mut go_on: impl FnMut(usize) -> bool,
) -> Vec<Swept> {
    let small: Vec<Small> = views.iter().map(|view| Small::of(view, LONGEST_SIDE, device)).collect();
    let cameras: Vec<Camera> = small.iter().map(|small| small.camera).collect();
    let coarse: Vec<Small> = views.iter().map(|view| Small::of(view, COARSE_SIDE, device)).collect();
    let (mut depths, mut swept): (Vec<f64>, Vec<(usize, Swept)>) = (vec![], vec![]);
    for index in farthest_first(&cameras, MOST) {
        if !go_on(swept.len()) {
            break;
        }
        let SceneDepth { median, nearest } = SceneDepth::of(index, &coarse, points);
        depths.extend(median);
        let depth = median.unwrap_or_else(|| typical_depth(&depths, extent(&cameras)));
        let is_new =
            |(other, _): &(usize, Swept)| !are_near_duplicates(&cameras[index], &cameras[*other], depth);
        if swept.iter().all(is_new) {
            let others = neighbours(index, &cameras, depth);
            let others: Vec<&Small> = others.into_iter().map(|other| &small[other]).collect();
            swept.push((index, sweep_one(&small[index], &others, nearest, depth)));
        }
    }
    swept.sort_by_key(|(index, _)| *index);
    swept.into_iter().map(|(_, swept)| swept).collect()
}

fn sweep_one(this: &Small, others: &[&Small], nearest: Option<f64>, depth: f64) -> Swept {
    let nearest = match (nearest, others.first()) {
        (Some(nearest), _) => nearest,
        (None, Some(other)) => nearest_of_cameras(this, other).min(NEAREST / depth),
        // Nothing tells a depth: all of it lies at one.
        (None, None) => 2. / depth,
    };
    let (inverse, likeness) = most_alike(this, others, nearest, PLANES);
    Swept {
        camera: this.camera,
        image: this.image.shallow_clone(),
        depth: filled(&inverse, &likeness).clamp_min(nearest / FARTHEST).reciprocal(),
        sure: likeness.gt(SURE),
    }
}

/// How far the scene is from a photo, before its depths are looked for.
struct SceneDepth {
    /// Of what the photo shows, where anything tells.
    median: Option<f64>,
    /// Inverse depth of the nearest plane, where points tell it.
    nearest: Option<f64>,
}

impl SceneDepth {
    /// By the points that the photo shows, else by comparing it with one photo at each of several distances, which are powers of two
    /// of the extent of all: too near ones show no parallax, too far ones something else. How many photos there are at a distance
    /// makes no difference.
    fn of(index: usize, photos: &[Small], points: &[Point]) -> Self {
        let this = &photos[index];
        if let Some(inverse) = inverse_depths_of(points, &this.camera) {
            let median = Some(1. / inverse[inverse.len() / 2]);
            let last = ((1. - NEARER) * inverse.len() as f64) as usize;
            return SceneDepth { median, nearest: Some(ROOM * inverse[last]) };
        }
        let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
        let compared = at_octaves(index, &cameras, OCTAVES).into_iter().map(|i| measured(this, &photos[i]));
        let agreed: Vec<Measured> = compared.filter(|of| of.share >= LEAST_SHARE).collect();
        let resolved = agreed.iter().filter(|of| of.planes >= RESOLVED);
        // The farthest photo is the first: what shows no parallax there is at least so far.
        let best = resolved.max_by(|a, b| a.share.total_cmp(&b.share)).or(agreed.first());
        SceneDepth { median: best.map(|of| of.depth), nearest: None }
    }
}

/// What two photos agree on.
struct Measured {
    /// Of the pixels that both are sure of, the median.
    depth: f64,
    /// How many planes from infinity it is.
    planes: f64,
    /// Those pixels, of all.
    share: f64,
}

fn measured(this: &Small, other: &Small) -> Measured {
    let nearest = nearest_of_cameras(this, other);
    let (inverse, likeness) = most_alike(this, &[other], nearest, COARSE_PLANES);
    let sure = inverse.masked_select(&likeness.gt(SURE));
    let share = sure.numel() as f64 / inverse.numel() as f64;
    let plane = nearest / (COARSE_PLANES - 1) as f64;
    let median = if sure.numel() == 0 { 0. } else { sure.median().double_value(&[]) };
    Measured { depth: 1. / median.max(plane), planes: (median / plane).round(), share }
}

/// The median of the depths of other photos; where there are none, the extent of the cameras, or 1 where they don't move.
fn typical_depth(depths: &[f64], extent: f64) -> f64 {
    let mut sorted = depths.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.get(sorted.len() / 2) {
        Some(&depth) => depth,
        None if extent > 0. => extent,
        None => 1.,
    }
}

impl Small {
    fn of(view: &View, longest_side: f64, device: Device) -> Self {
        let (camera, side) = (view.camera, |pixels: u32| f64::from(pixels));
        let factor = (longest_side / side(camera.width.max(camera.height))).min(1.);
        let resized = |pixels: u32| ((side(pixels) * factor).round() as i64).max(PATCH);
        let (height, width) = (resized(camera.height), resized(camera.width));
        let image = view.image.to_device(device).unsqueeze(0);
        let image = image.adaptive_avg_pool2d([height, width]).squeeze_dim(0);
        let grey = image.mean_dim([0].as_slice(), false, Kind::Float);
        let scale = (width as f64 / side(camera.width), height as f64 / side(camera.height));
        let intrinsics = camera.intrinsics.resized(scale.0, scale.1);
        Small {
            camera: Camera { intrinsics, width: width as u32, height: height as u32, ..camera },
            image,
            grey,
        }
    }

    fn centre(&self) -> DVec3 {
        self.camera.c2w.w_axis.truncate()
    }

    fn size(&self) -> [i64; 2] {
        [i64::from(self.camera.height), i64::from(self.camera.width)]
    }
}

/// The inverse depth of the nearest plane, such that nothing moves too far in the photo taken nearest.
fn nearest_of_cameras(this: &Small, other: &Small) -> f64 {
    let baseline = other.centre().distance(this.centre());
    LARGEST_MOVE * f64::from(this.camera.width) / (this.camera.intrinsics.fx * baseline)
}

/// Those of the points that the camera sees, sorted; none where it sees too few.
fn inverse_depths_of(points: &[Point], camera: &Camera) -> Option<Vec<f64>> {
    let project = projection(camera);
    let mut inverse: Vec<f64> =
        points.iter().filter_map(|point| project(point.position)).map(|[_, _, z]| 1. / z).collect();
    inverse.sort_by(f64::total_cmp);
    (inverse.len() >= LEAST_POINTS).then_some(inverse)
}

/// The inverse depth of every pixel, of so many evenly from 0 to `nearest`, at which it looks most alike in the others, and the
/// correlation there, both [h, w].
fn most_alike(this: &Small, others: &[&Small], nearest: f64, planes: i64) -> (Tensor, Tensor) {
    let (size, options) = (this.size(), (Kind::Float, this.grey.device()));
    if others.is_empty() {
        return (Tensor::full(size, nearest / 2., options), Tensor::zeros(size, options));
    }
    let step = nearest / (planes - 1) as f64;
    let planes = Tensor::linspace(0., nearest, planes, options).view([planes, 1]);
    let own = this.grey.unsqueeze(0);
    let (own_mean, own_variance) = mean_and_variance(&own);
    let alike = |other: &&Small| {
        let (seen, inside) = seen_by(other, this, &planes);
        let (mean, variance) = mean_and_variance(&seen);
        let covariance = around(&(&seen * &own)) - mean * &own_mean;
        (covariance / (variance * &own_variance).sqrt()).where_scalarother(&inside, -1.)
    };
    let correlations = Tensor::stack(&others.iter().map(alike).collect::<Vec<_>>(), 0);
    let half = (others.len() as i64 / 2).max(1);
    let (best, _) = correlations.topk(half, 0, true, false);
    let (likeness, plane) = best.mean_dim([0].as_slice(), false, Kind::Float).max_dim(0, false);
    (plane.to_kind(Kind::Float) * step, likeness)
}

/// What `other` shows where the pixels of `this` would be if they lay on each of the planes, and whether it shows them at all, both
/// [planes, h, w].
fn seen_by(other: &Small, this: &Small, planes: &Tensor) -> (Tensor, Tensor) {
    let [height, width] = this.size();
    let to_other: DMat4 = other.camera.c2w.inverse() * this.camera.c2w;
    let rows = to_other.transpose().to_cols_array_2d();
    // In proportion to what the camera sees of a pixel at inverse depth w: rotation · ray + w · translation.
    let rays = rays(&this.camera.intrinsics, height, width, planes.device());
    let coordinate = |row: [f64; 4]| {
        let turned = &rays[0] * row[0] + &rays[1] * row[1] + &rays[2] * row[2]; // [h·w]
        turned + planes * row[3]
    };
    let [x, y, z] = [rows[0], rows[1], rows[2]].map(coordinate);
    let Intrinsics { fx, fy, cx, cy } = other.camera.intrinsics;
    // From −1 to 1 across the picture.
    let u = (x / &z * fx + cx) * (2. / f64::from(other.camera.width)) - 1.;
    let v = (y / &z * fy + cy) * (2. / f64::from(other.camera.height)) - 1.;
    let count = planes.size()[0];
    let volume = [count, height, width];
    let inside = u.abs().le(1.).logical_and(&v.abs().le(1.)).logical_and(&z.gt(0.)).view(volume);
    let grid = Tensor::stack(&[u, v], -1).view([1, count * height, width, 2]);
    let (bilinear, at_the_border) = (0, 1);
    let seen = other.grey.unsqueeze(0).unsqueeze(0).grid_sampler(&grid, bilinear, at_the_border, false);
    (seen.view(volume), inside)
}

/// x, y and z of the pixels' rays, z being 1, [h·w] each.
fn rays(intrinsics: &Intrinsics, height: i64, width: i64, device: Device) -> [Tensor; 3] {
    let options = (Kind::Float, device);
    let x = (Tensor::arange(width, options) + 0.5 - intrinsics.cx) / intrinsics.fx;
    let y = (Tensor::arange(height, options) + 0.5 - intrinsics.cy) / intrinsics.fy;
    let all =
        |t: Tensor, shape: [i64; 2]| t.view(shape).expand([height, width], false).contiguous().view([-1]);
    [all(x, [1, width]), all(y, [height, 1]), Tensor::ones([height * width], options)]
}

/// Means over every pixel's surroundings, as far as these are inside: [.., h, w] of [.., h, w].
fn around(t: &Tensor) -> Tensor {
    let along = |t: &Tensor, window: [i64; 2]| {
        t.avg_pool2d(window, 1, window.map(|side| side / 2), false, false, None)
    };
    along(&along(t, [PATCH, 1]), [1, PATCH])
}

fn mean_and_variance(t: &Tensor) -> (Tensor, Tensor) {
    let mean = around(t);
    let variance = around(&t.square()) - mean.square() + LEAST_VARIANCE;
    (mean, variance)
}

/// Where pixels look alike nowhere, the inverse depths around them, as near as some are known.
fn filled(inverse: &Tensor, likeness: &Tensor) -> Tensor {
    let size = inverse.size();
    let weight = (likeness - UNSURE).clamp_min(0.).square();
    let (mut sum, mut weights) = ((inverse * &weight).unsqueeze(0), weight.unsqueeze(0));
    let (mut total, mut total_weights, mut factor) = (sum.copy(), weights.copy(), 1.);
    for _ in 0..SPREADS {
        let pool = |t: &Tensor| t.avg_pool2d(5, 1, 2, false, true, None);
        (sum, weights) = (pool(&pool(&sum)), pool(&pool(&weights)));
        factor *= SPREAD_WEIGHT;
        total += &sum * factor;
        total_weights += &weights * factor;
    }
    // And where none is known far and wide, what is so in the middle.
    let (least, median) = (1e-9, inverse.median().double_value(&[]));
    ((total + least * median) / (total_weights + least)).view(size.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;

    /// A wavy picture on a plane at depth 4, seen by three cameras in a row.
    #[test]
    fn a_plane_is_found_where_it_is() {
        let (side, depth) = (64u32, 4.);
        let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 32. };
        let options = (Kind::Float, Device::Cpu);
        let view = |at: f64| {
            let pixel = |offset: f64| (Tensor::arange(64, options) + 0.5 - 32.) / 60. * depth + offset;
            let x = pixel(at).view([1, 64]);
            let y = pixel(0.).view([64, 1]);
            let wave = ((&x * 5.).sin() * (&y * 4.).cos() + (&x * 11. + &y * 7.).sin()) * 0.25 + 0.5;
            let c2w = DMat4::from_translation(DVec3::new(at, 0., 0.));
            let camera = Camera { intrinsics, c2w, width: side, height: side };
            View { name: String::new(), image: wave.expand([3, 64, 64], false).contiguous(), camera }
        };
        let views = [view(-0.5), view(0.), view(0.5)];
        for swept in sweep(&views, &[], Device::Cpu, |_| true) {
            let off = (swept.depth / depth - 1.).abs().median().double_value(&[]);
            assert!(off < 0.02, "{off}");
        }
        // Where points tell that the scene begins at 3, planes lie closer together.
        let point = |i: i32| Point { position: DVec3::new(0.01 * f64::from(i), 0., 3.), colour: [0.; 3] };
        let points: Vec<Point> = (0..40).map(point).collect();
        let photos: Vec<Small> =
            views.iter().map(|view| Small::of(view, LONGEST_SIDE, Device::Cpu)).collect();
        assert!((SceneDepth::of(1, &photos, &points).nearest.unwrap() - 1.3 / 3.).abs() < 1e-9);
        assert!(SceneDepth::of(1, &photos, &points[..20]).nearest.is_none());
        // One photo by itself tells nothing, and that is no NaN.
        let alone = sweep(&views[..1], &[], Device::Cpu, |_| true);
        assert!(alone[0].depth.isfinite().all().int64_value(&[]) == 1);
    }
}
