//! View selection: determines which photos are compared with each other, and which are near duplicates. Like multi-view stereo, it uses
//! parallax and overlap at the depth of the scene (Yao et al. 2018, "MVSNet"). Parallax is the distance of two cameras in units of that
//! depth, in radians. The number of photos taken from one position makes no difference.

use crate::scene::Camera;
use glam::DVec3;
use std::f64::consts::PI;

/// Maximum number of photos that each one is compared with.
const MAX_NEIGHBOURS: usize = 4;
/// Best parallax for a comparison, in radians: depths can be distinguished, and both photos show the same part of the scene.
const BEST_PARALLAX: f64 = 2.5 * PI / 180.;
/// Minimum parallax of two photos that are compared, in radians. A smaller parallax gives less accurate depths.
const MIN_PARALLAX: f64 = PI / 180.;
/// Minimum fraction of a photo that another must show, at the depth of the scene.
const MIN_OVERLAP: f64 = 0.3;
/// Maximum number of times that the minimum parallax is halved, if cameras hardly move.
const MAX_HALVINGS: i32 = 16;
/// Cosine of the maximum angle between the axes of two cameras that are compared.
const MIN_COSINE: f64 = 0.3;
/// Maximum sum of parallax and rotation of near duplicates, in radians.
const NEAR_DUPLICATE: f64 = PI / 180.;
/// Number of points along a side of the grid that overlap is measured on.
const GRID: u32 = 5;

/// Returns the function that projects a point to `camera`: u and v in pixels and the depth along its axis, or `None` outside the image.
pub fn projection(camera: &Camera) -> impl Fn(DVec3) -> Option<[f64; 3]> + use<> {
    let (w2c, Camera { intrinsics: k, width, height, .. }) = (camera.c2w.inverse(), *camera);
    let inside = |pixel: f64, side: u32| pixel >= 0. && pixel < f64::from(side);
    move |point| {
        let p = w2c.transform_point3(point);
        let (u, v) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
        (p.z > 0. && inside(u, width) && inside(v, height)).then_some([u, v, p.z])
    }
}

/// Returns a function from a point to the index of its pixel in a map and its depth there; `None` for points that the map of `camera` doesn't show.
pub fn pixel_and_depth(camera: &Camera) -> impl Fn(DVec3) -> Option<(usize, f64)> + use<> {
    let (project, width) = (projection(camera), camera.width as usize);
    move |point| project(point).map(|[u, v, z]| (v as usize * width + u as usize, z))
}

/// Returns the maximum distance between the first camera and another. It is the unit of lengths before a depth is known.
pub fn extent(cameras: &[Camera]) -> f64 {
    cameras.iter().map(|camera| distance(camera, &cameras[0])).fold(0., f64::max)
}

/// Returns the measure of how far apart two cameras are: the sum of their distance in units of the extent of all `cameras`, and the angle
/// between their axes in radians.
fn separation(cameras: &[Camera]) -> impl Fn(&Camera, &Camera) -> f64 + use<> {
    let extent = extent(cameras);
    move |a, b| {
        let moved = if extent > 0. { distance(a, b) / extent } else { 0. };
        moved + turn(a, b)
    }
}

/// Returns the camera with the smallest [`separation`] from camera `index` above that of near duplicates; `None` if there is none.
pub fn nearest_to(index: usize, cameras: &[Camera]) -> Option<usize> {
    let apart = separation(cameras);
    let from = |other: &usize| apart(&cameras[*other], &cameras[index]);
    (0..cameras.len()).filter(|other| from(other) > NEAR_DUPLICATE).min_by(|a, b| from(a).total_cmp(&from(b)))
}

/// Returns the indices of the other cameras by [`separation`] from camera `index`, the nearest first.
pub fn nearest_first(index: usize, cameras: &[Camera]) -> Vec<usize> {
    let apart = separation(cameras);
    let mut others: Vec<usize> = (0..cameras.len()).filter(|other| *other != index).collect();
    others.sort_by(|&a, &b| {
        apart(&cameras[a], &cameras[index]).total_cmp(&apart(&cameras[b], &cameras[index]))
    });
    others
}

/// Returns up to `count` indices of `cameras` by farthest-point sampling with [`separation`]. The first index is 0.
pub fn farthest_first(cameras: &[Camera], count: usize) -> Vec<usize> {
    let apart = separation(cameras);
    let mut chosen = vec![];
    let mut nearest = vec![f64::INFINITY; cameras.len()];
    while chosen.len() < count.min(cameras.len()) {
        // Ties are resolved in favour of the first camera.
        let next = (0..cameras.len()).rev().max_by(|&a, &b| nearest[a].total_cmp(&nearest[b])).expect("one");
        chosen.push(next);
        for (camera, nearest) in cameras.iter().zip(&mut nearest) {
            *nearest = nearest.min(apart(camera, &cameras[next]));
        }
        nearest[next] = f64::NEG_INFINITY;
    }
    chosen
}

/// Returns, for each of `count` distances, the camera whose distance from camera `index` is nearest to it, the farthest first. The
/// distances are the extent of all cameras times powers of ½. A distance is skipped if all cameras are off by more than a factor of √2.
/// Only cameras that look in about the same direction are returned.
pub fn at_octaves(index: usize, cameras: &[Camera], count: i32) -> Vec<usize> {
    let (this, extent) = (&cameras[index], extent(cameras));
    let comparable = |other: &usize| axis(&cameras[*other]).dot(axis(this)) > MIN_COSINE;
    let at = |octave: i32| {
        let off =
            |other: usize| ((distance(&cameras[other], this) / extent).log2() + f64::from(octave)).abs();
        let others = (0..cameras.len()).filter(comparable).filter(|&other| off(other) <= 0.5);
        others.min_by(|&a, &b| off(a).total_cmp(&off(b)))
    };
    (0..count).filter_map(at).collect()
}

/// Returns `true` if two cameras show nearly the same image of a scene at `depth`, from nearly the same position in nearly the same
/// direction.
pub fn are_near_duplicates(a: &Camera, b: &Camera, depth: f64) -> bool {
    distance(a, b) / depth + turn(a, b) <= NEAR_DUPLICATE
}

/// Returns the indices of the cameras that are best for measuring depths in photo `index`, the nearest first: those with the best parallax
/// at `depth`, with at least the minimum parallax to the photo and to each other, and enough overlap. If all have less, the limits are
/// lowered. Cameras in the same position are useless: if all are, the result is empty.
pub fn neighbours(index: usize, cameras: &[Camera], depth: f64) -> Vec<usize> {
    let this = &cameras[index];
    let points = grid(this, depth);
    let mut others: Vec<Neighbour> = (0..cameras.len())
        .filter(|&other| axis(&cameras[other]).dot(axis(this)) > MIN_COSINE)
        .map(|other| Neighbour::of(other, &cameras[other], this, depth, &points))
        .filter(|other| other.distance > 0.)
        .collect();
    let off = |other: &Neighbour| (other.parallax / BEST_PARALLAX).ln().abs();
    others.sort_by(|a, b| off(a).total_cmp(&off(b)));
    for min_overlap in [MIN_OVERLAP, 0.] {
        // Two cameras are better than one, unless the minimum parallax has to be halved more than once.
        for count in [2, 1] {
            let halvings = if count == 2 { 1 } else { MAX_HALVINGS };
            for halving in 0..=halvings {
                let min_parallax = MIN_PARALLAX * 0.5f64.powi(halving);
                let chosen = spaced(&others, cameras, min_parallax * depth, min_overlap);
                if chosen.len() >= count {
                    return chosen;
                }
            }
        }
    }
    // The parallax is too small to be measured.
    others.first().map(|other| other.index).into_iter().collect()
}

struct Neighbour {
    index: usize,
    distance: f64,
    /// Distance divided by the depth of the scene, in radians.
    parallax: f64,
    /// Fraction of the grid points that it sees.
    overlap: f64,
}

impl Neighbour {
    fn of(index: usize, other: &Camera, this: &Camera, depth: f64, points: &[DVec3]) -> Self {
        let sees = projection(other);
        let seen = points.iter().filter(|&&point| sees(point).is_some()).count();
        let distance = distance(other, this);
        let overlap = seen as f64 / points.len() as f64;
        Neighbour { index, distance, parallax: distance / depth, overlap }
    }
}

/// Returns the indices of the first `MAX_NEIGHBOURS` of `others` that are far enough from the photo and from each other, the nearest first.
fn spaced(others: &[Neighbour], cameras: &[Camera], min_distance: f64, min_overlap: f64) -> Vec<usize> {
    let mut chosen: Vec<&Neighbour> = vec![];
    for other in others.iter().filter(|other| other.distance >= min_distance && other.overlap >= min_overlap)
    {
        let camera = &cameras[other.index];
        if chosen.iter().all(|one| distance(&cameras[one.index], camera) >= min_distance) {
            chosen.push(other);
        }
        if chosen.len() == MAX_NEIGHBOURS {
            break;
        }
    }
    chosen.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.index.cmp(&b.index)));
    chosen.into_iter().map(|other| other.index).collect()
}

/// Returns points at `depth` in front of a camera, spread over its image.
fn grid(camera: &Camera, depth: f64) -> Vec<DVec3> {
    let along = |side: u32| (0..GRID).map(move |i| (f64::from(i) + 0.5) / f64::from(GRID) * f64::from(side));
    along(camera.height)
        .flat_map(|v| along(camera.width).map(move |u| camera.unproject(u, v, depth)))
        .collect()
}

fn center(camera: &Camera) -> DVec3 {
    camera.c2w.w_axis.truncate()
}

fn axis(camera: &Camera) -> DVec3 {
    camera.c2w.z_axis.truncate()
}

/// Returns the distance between two cameras' positions.
pub fn distance(a: &Camera, b: &Camera) -> f64 {
    center(a).distance(center(b))
}

/// Returns the angle between two cameras' axes, in radians.
fn turn(a: &Camera, b: &Camera) -> f64 {
    axis(a).cross(axis(b)).length().atan2(axis(a).dot(axis(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::DMat4;

    fn camera(c2w: DMat4) -> Camera {
        let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 32. };
        Camera { intrinsics, c2w, width: 64, height: 64 }
    }

    fn along(positions: &[f64]) -> Vec<Camera> {
        positions.iter().map(|&x| camera(DMat4::from_translation(DVec3::X * x))).collect()
    }

    #[test]
    fn neighbours_have_parallax() {
        // At depth 4, parallax of 1° is a distance of 0.07, and 2.5° is 0.17.
        let even = along(&[0., 0.25, 0.5, 0.75, 1., 1.25]);
        assert_eq!(neighbours(2, &even, 4.), [1, 3, 0, 4]);
        // Photos from the same or nearly the same position count once, however near they are.
        let paused = along(&[0., 0.25, 0.2501, 0.5, 0.5 + 1e-7, 0.49999, 0.75, 1.00001, 1.]);
        assert_eq!(neighbours(3, &paused, 4.), [2, 6, 0, 8]);
        // Neighbours in a dense video are some frames apart.
        let dense = along(&(0..240).map(|i| f64::from(i) / 240.).collect::<Vec<_>>());
        let chosen = neighbours(120, &dense, 4.);
        assert_eq!(chosen.len(), 4);
        assert!(chosen.iter().all(|&other| (25..=70).contains(&other.abs_diff(120))), "{chosen:?}");
    }

    #[test]
    fn little_parallax_is_better_than_none() {
        let clustered = along(&[0., 1e-3, 2e-3, 4e-3]);
        assert_eq!(neighbours(0, &clustered, 4.), [3]);
        assert_eq!(neighbours(0, &along(&[0., 0., 0.]), 4.), [0; 0]);
        assert_eq!(neighbours(0, &along(&[0., 1e-9]), 4.), [1]);
        let far_apart = [camera(DMat4::IDENTITY), camera(DMat4::from_rotation_y(1.))];
        assert_eq!(neighbours(0, &far_apart, 4.), [0; 0]);
    }

    #[test]
    fn neighbours_see_the_same() {
        // The nearer cameras look away.
        let turned = |x: f64| camera(DMat4::from_translation(DVec3::X * x) * DMat4::from_rotation_y(1.1));
        let cameras = [along(&[0.]), vec![turned(0.2), turned(0.4)], along(&[0.6, 0.8])].concat();
        assert_eq!(neighbours(0, &cameras, 4.), [3, 4]);
    }

    #[test]
    fn views_far_from_all_others_come_first() {
        let rests = along(&[0., 0., 1e-3, 1., 0.5, 0.999]);
        assert_eq!(farthest_first(&rests, 3), [0, 3, 4]);
        assert_eq!(farthest_first(&rests, 9).len(), 6);
        let turns: Vec<Camera> = [0., 0., 0.3, 1.].map(|angle| camera(DMat4::from_rotation_y(angle))).into();
        assert_eq!(farthest_first(&turns, 3), [0, 3, 2]);
    }

    #[test]
    fn one_photo_at_each_distance_is_looked_at() {
        let many = along(&[0., 1., 0.98, 0.5, 0.51, 0.126, 1e-5, 0.]);
        assert_eq!(at_octaves(0, &many, 9), [1, 3, 5]);
        assert_eq!(at_octaves(0, &along(&[0., 0.]), 9), [0; 0]);
    }

    #[test]
    fn near_duplicates_differ_in_nothing_that_shows() {
        let [a, b, c] = [0., 0.05, 0.2].map(|x| camera(DMat4::from_translation(DVec3::X * x)));
        assert!(are_near_duplicates(&a, &b, 4.) && !are_near_duplicates(&a, &c, 4.));
        assert!(!are_near_duplicates(&a, &camera(DMat4::from_rotation_y(0.1)), 4.));
    }
}
