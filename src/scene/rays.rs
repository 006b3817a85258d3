//! Plücker rays (spec 3.2), and the radial warp of a scene (spec 3.5): space is scaled along every direction from the mean camera so that
//! what the photos show lies at about the same distance. A model then sees all scenes at this distance, and its Gaussians are moved back
//! afterwards.

use super::gaussians::Gaussians;
use std::f64::consts::PI;
use tch::{Kind, Tensor, no_grad};

/// Returns one ray per pixel as [o × d ; d], moment first, where d is the unit direction in the world and o the camera center.
///
/// The inputs are `c2w` [B, V, 4, 4] and `intrinsics` [B, V, 3, 3] in pixels; the result is [B, V, H, W, 6], float32.
pub fn plucker_rays(c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
    let directions = pixel_directions(c2w, intrinsics, height, width);
    let origins = c2w.to_kind(Kind::Float).narrow(-2, 0, 3).select(-1, 3).unsqueeze(2).unsqueeze(2);
    plucker(&origins.expand_as(&directions), &directions)
}

/// Returns the rays [o × d ; d], [.., 6], from `origins` [.., 3] along `directions` [.., 3] of any length.
fn plucker(origins: &Tensor, directions: &Tensor) -> Tensor {
    let directions = directions / directions.norm_scalaropt_dim(2, [-1i64], true);
    Tensor::cat(&[origins.linalg_cross(&directions, -1), directions], -1)
}

/// Returns the world direction of each pixel, [B, V, H, W, 3], float32, with length 1 along the camera's axis.
fn pixel_directions(c2w: &Tensor, intrinsics: &Tensor, height: i64, width: i64) -> Tensor {
    let (c2w, intrinsics) = (c2w.to_kind(Kind::Float), intrinsics.to_kind(Kind::Float));
    let options = (Kind::Float, c2w.device());
    let entry =
        |row: i64, column: i64| intrinsics.select(-2, row).select(-1, column).unsqueeze(-1).unsqueeze(-1);
    // x = (j + ½ − cx) / fx along a row, y = (i + ½ − cy) / fy down a column, each [B, V, H, W].
    let j = (Tensor::arange(width, options) + 0.5).view([1, 1, 1, width]);
    let i = (Tensor::arange(height, options) + 0.5).view([1, 1, height, 1]);
    let x = ((j - entry(0, 2)) / entry(0, 0)).expand([-1, -1, height, -1], false);
    let y = ((i - entry(1, 2)) / entry(1, 1)).expand([-1, -1, -1, width], false);
    let camera = Tensor::stack(&[&x, &y, &x.ones_like()], -1);
    let rotation = c2w.narrow(-2, 0, 3).narrow(-1, 0, 3);
    let flat = camera.flatten(2, 3).matmul(&rotation.transpose(-1, -2));
    let (b, v) = (flat.size()[0], flat.size()[1]);
    flat.view([b, v, height, width, 3])
}

/// Distance from the origin to which the warp moves what the photos show.
const DISTANCE: f64 = 1.8;
/// Maximum distance of a pixel. What is farther hardly moves between photos.
const FARTHEST: f64 = 40.;
/// Minimum distance of what a pixel shows from the origin, in units of the largest distance between cameras. Cameras see closer points in
/// very different directions, which one distance per direction from the origin does not describe.
const NEAREST: f64 = 0.5;
/// Cells along each side of the map of directions.
const CELLS: i64 = 128;
/// Standard deviation, in cells, of the finest blur of the map. Each coarser one has twice that of the one before.
const BLUR: f64 = 1.;
/// Number of blurs. The coarsest fills the directions in which no pixel lies.
const BLURS: i32 = 4;
/// Weight of each blur relative to the next finer one.
const COARSER: f64 = 0.02;
/// Weight of the distance [`DISTANCE`] itself, which remains where nothing is known.
const PRIOR: f64 = 1e-6;

/// Warp of the normalized worlds of B scenes, and the depths of their V views from which it was computed.
#[derive(Debug)]
pub struct RadialWarp {
    /// Logarithm of the factor of distances by direction, [B, 1, cells, cells].
    log_factors: Tensor,
    /// Inverse depths of the pixels, [B, V, H, W].
    inverse_depths: Tensor,
    /// Factor of the cameras' distances from the origin, [B, 1, 1].
    camera_factors: Tensor,
}

impl RadialWarp {
    /// Computes the warp of the views with `c2w` [B, V, 4, 4] in the normalized world, `intrinsics` [B, V, 3, 3] in pixels and `depths`
    /// [B, V, 2, H, W]: the inverse depth of each pixel along the camera's axis, and how sure it is, from 0 to 1.
    pub fn new(c2w: &Tensor, intrinsics: &Tensor, depths: &Tensor) -> Self {
        no_grad(|| {
            let inverse_depths = depths.select(2, 0).clamp_min(1. / FARTHEST);
            let points = points(c2w, intrinsics, &inverse_depths).flatten(1, 3); // [B, V·H·W, 3]
            let weights = depths.select(2, 1).flatten(1, 3);
            let distances = points.norm_scalaropt_dim(2, [-1i64], false).clamp_min(NEAREST);
            let logs = (&distances / DISTANCE).log() * &weights;
            let sums = histogram(&map_position(&points), &Tensor::stack(&[&logs, &weights], 1));
            // View by view, since libtorch splits the sum of a single number among its threads, which changes the bits.
            let total = |values: &Tensor| {
                let by_view =
                    values.unflatten(1, [depths.size()[1], -1]).sum_dim_intlist(2i64, false, Kind::Float);
                by_view.sum_dim_intlist(1i64, false, Kind::Float)
            };
            let mean = total(&logs) / (total(&weights) + PRIOR);
            RadialWarp {
                log_factors: blurred_ratio(&sums),
                inverse_depths,
                camera_factors: (mean * -0.5).exp().view([-1, 1, 1]),
            }
        })
    }

    /// Returns the warp of `count` of the views, starting at `first`.
    pub fn views(&self, first: i64, count: i64) -> Self {
        RadialWarp {
            log_factors: self.log_factors.shallow_clone(),
            inverse_depths: self.inverse_depths.narrow(1, first, count),
            camera_factors: self.camera_factors.shallow_clone(),
        }
    }

    /// Returns the poses of the cameras of which the model is told, [B, V, 4, 4]: closer together where the scene is far away.
    pub fn cameras(&self, c2w: &Tensor) -> Tensor {
        let centers = c2w.narrow(-2, 0, 3).narrow(-1, 3, 1) * self.camera_factors.unsqueeze(-1);
        let rotations = c2w.narrow(-2, 0, 3).narrow(-1, 0, 3);
        let poses = Tensor::cat(&[rotations, centers], -1);
        Tensor::cat(&[poses, c2w.narrow(-2, 3, 1)], -2)
    }

    /// Returns one Plücker ray per pixel, [B, V, H, W, 6], from the camera of [`RadialWarp::cameras`] through the warped point that the
    /// pixel shows.
    pub fn rays(&self, c2w: &Tensor, intrinsics: &Tensor) -> Tensor {
        no_grad(|| {
            let points = points(c2w, intrinsics, &self.inverse_depths);
            let factors = self.log_factors_at(&points.flatten(1, 3)).neg().exp();
            let warped = points * factors.view_as(&self.inverse_depths).unsqueeze(-1);
            let origins = self.cameras(c2w).narrow(-2, 0, 3).select(-1, 3).unsqueeze(2).unsqueeze(2);
            plucker(&origins.expand_as(&warped), &(warped - origins))
        })
    }

    /// Moves `gaussians` of the warped world back to the normalized one. Differentiable.
    pub fn restore(&self, gaussians: &Gaussians) -> Gaussians {
        let factors = self.log_factors_at(&gaussians.means).exp().unsqueeze(-1);
        Gaussians {
            means: &gaussians.means * &factors,
            scales: &gaussians.scales * &factors,
            quaternions: gaussians.quaternions.shallow_clone(),
            opacities: gaussians.opacities.shallow_clone(),
            sh: gaussians.sh.shallow_clone(),
            antialiased: gaussians.antialiased,
        }
    }

    /// Returns the logarithm of the factor by which distances from the origin shrink in the directions of `points` [B, N, 3], [B, N].
    fn log_factors_at(&self, points: &Tensor) -> Tensor {
        let places = map_position(points).unsqueeze(2);
        const BILINEAR: i64 = 0;
        const BORDER: i64 = 1;
        self.log_factors.grid_sampler_2d(&places, BILINEAR, BORDER, false).select(1, 0).select(-1, 0)
    }
}

/// Returns the points that pixels with these inverse depths [B, V, H, W] show, [B, V, H, W, 3].
fn points(c2w: &Tensor, intrinsics: &Tensor, inverse_depths: &Tensor) -> Tensor {
    let size = inverse_depths.size();
    let directions = pixel_directions(c2w, intrinsics, size[2], size[3]);
    let origins = c2w.narrow(-2, 0, 3).select(-1, 3).unsqueeze(2).unsqueeze(2);
    directions / inverse_depths.unsqueeze(-1) + origins
}

/// Returns the places on the map of the directions of `points` [.., 3], [.., 2]: the azimuthal equidistant projection about the mean
/// camera's axis, from −1 to 1.
fn map_position(points: &Tensor) -> Tensor {
    let across = points.narrow(-1, 0, 2);
    let radius = (across.square().sum_dim_intlist(-1i64, true, Kind::Float) + 1e-12).sqrt();
    let angle = radius.atan2(&points.narrow(-1, 2, 1));
    across / radius * (angle / PI)
}

/// Adds up `values` [B, 2, N] at `places` [B, N, 2] on the map, each shared among the four cells around it, [B, 2, cells, cells].
fn histogram(places: &Tensor, values: &Tensor) -> Tensor {
    let last = CELLS as f64 - 1.;
    // The center of the first cell is at 0.
    let places = ((places + 1.) * (CELLS as f64 / 2.) - 0.5).clamp(0., last);
    let corner = places.floor().clamp_max(last - 1.);
    let share = places - &corner;
    let corner = corner.to_kind(Kind::Int64);
    let (x, y) = (corner.select(-1, 0), corner.select(-1, 1));
    let (right, down) = (share.select(-1, 0).unsqueeze(1), share.select(-1, 1).unsqueeze(1));
    let (left, up) = (1. - &right, 1. - &down);
    let size = values.size();
    let mut sums = Tensor::zeros([size[0], size[1], CELLS * CELLS], (values.kind(), values.device()));
    for (dx, dy, share) in
        [(0, 0, &left * &up), (1, 0, &right * &up), (0, 1, &left * &down), (1, 1, &right * &down)]
    {
        let cell = ((&y + dy) * CELLS + (&x + dx)).unsqueeze(1).expand_as(values);
        sums = sums.scatter_add(2, &cell, &(values * share));
    }
    sums.view([size[0], size[1], CELLS, CELLS])
}

/// Divides the first channel of `sums` [B, 2, cells, cells] by the second, each blurred. Where a fine blur reaches no pixel, coarser ones
/// decide.
fn blurred_ratio(sums: &Tensor) -> Tensor {
    let mut total = sums.zeros_like();
    for level in 0..BLURS {
        total += blur(sums, BLUR * f64::from(1 << level)) * COARSER.powi(level);
    }
    total.narrow(1, 0, 1) / (total.narrow(1, 1, 1) + PRIOR)
}

/// Blurs both channels of a map by a Gaussian with a standard deviation of `sigma` cells.
fn blur(map: &Tensor, sigma: f64) -> Tensor {
    let reach = (3. * sigma).ceil() as i64;
    let offsets = Tensor::arange_start(-reach, reach + 1, (Kind::Float, map.device()));
    let kernel = (offsets.square() * (-0.5 / (sigma * sigma))).exp();
    let kernel = (&kernel / kernel.sum(Kind::Float)).view([1, 1, 1, -1]).repeat([2, 1, 1, 1]);
    let columns = map.conv2d_padding(&kernel, None::<&Tensor>, [1, 1], "same", [1, 1], 2);
    columns.conv2d_padding(&kernel.transpose(-1, -2), None::<&Tensor>, [1, 1], "same", [1, 1], 2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::num_threads;
    use tch::Device;

    const OPTIONS: (Kind, Device) = (Kind::Float, Device::Cpu);

    /// Returns poses, intrinsics and the given depths of two views, 0.4 apart, of 16×16 pixels.
    fn views(inverse_depth: f64, sure: f64) -> [Tensor; 3] {
        let c2w = Tensor::eye(4, OPTIONS).repeat([1, 2, 1, 1]);
        let _ = c2w.select(1, 0).select(-1, 3).select(-1, 0).fill_(-0.2);
        let _ = c2w.select(1, 1).select(-1, 3).select(-1, 0).fill_(0.2);
        let intrinsics = Tensor::from_slice(&[16f32, 0., 8., 0., 16., 8., 0., 0., 1.]).view([1, 1, 3, 3]);
        let depths =
            Tensor::stack(&[inverse_depth, sure].map(|value| Tensor::full([16, 16], value, OPTIONS)), 0);
        [c2w, intrinsics.repeat([1, 2, 1, 1]), depths.repeat([1, 2, 1, 1, 1])]
    }

    fn gaussians(means: &Tensor) -> Gaussians {
        let count = means.size()[1];
        Gaussians {
            means: means.shallow_clone(),
            scales: Tensor::full([1, count, 3], 0.1, OPTIONS),
            quaternions: Tensor::ones([1, count, 4], OPTIONS),
            opacities: Tensor::ones([1, count], OPTIONS),
            sh: Tensor::zeros([1, count, 1, 3], OPTIONS),
            antialiased: false,
        }
    }

    /// Where no depth is sure, nothing changes: weights that were trained without depths mean what they meant.
    #[test]
    fn unsure_depths_change_nothing() {
        let [c2w, intrinsics, depths] = views(0.1, 0.);
        let warp = RadialWarp::new(&c2w, &intrinsics, &depths);
        let plain = plucker_rays(&c2w, &intrinsics, 16, 16);
        assert!(warp.rays(&c2w, &intrinsics).allclose(&plain, 1e-5, 1e-6, false));
        assert!(warp.cameras(&c2w).equal(&c2w));
        let means = Tensor::randn([1, 9, 3], OPTIONS);
        assert!(warp.restore(&gaussians(&means)).means.equal(&means));
    }

    /// The warp has the same bits for any number of threads.
    #[test]
    fn threads_do_not_change_the_warp() {
        let _guard = num_threads::lock_exclusive();
        let before = tch::get_num_threads();
        for count in 9..21 {
            let irregular = Tensor::arange(count * 2 * 96 * 96, (Kind::Double, Device::Cpu)).square().sin();
            let depths = (irregular.abs() + 0.01).to_kind(Kind::Float).view([1, count, 2, 96, 96]);
            let [c2w, intrinsics, _] = views(1., 1.);
            let [c2w, intrinsics] = [c2w, intrinsics].map(|t| t.narrow(1, 0, 1).repeat([1, count, 1, 1]));
            let warps = [1, 2, 3].map(|threads| {
                tch::set_num_threads(threads);
                RadialWarp::new(&c2w, &intrinsics, &depths)
            });
            tch::set_num_threads(before);
            for warp in &warps[1..] {
                assert!(warp.camera_factors.equal(&warps[0].camera_factors), "{count} views");
                assert!(warp.log_factors.equal(&warps[0].log_factors), "{count} views");
            }
        }
    }

    /// Gaussians at the warped place of a wall are moved back to the wall.
    #[test]
    fn a_warped_wall_is_restored() {
        let depth = 7.2;
        let [c2w, intrinsics, depths] = views(1. / depth, 1.);
        let warp = RadialWarp::new(&c2w, &intrinsics, &depths);
        let point = Tensor::from_slice(&[0.3f32, -0.2, depth as f32]).view([1, 1, 3]);
        let factor = warp.log_factors_at(&point).exp();
        assert!((4. ..4.3).contains(&factor.double_value(&[0, 0])), "{factor}");
        let back = warp.restore(&gaussians(&(&point / &factor)));
        assert!(back.means.allclose(&point, 1e-4, 1e-4, false));
        assert!((back.scales / 0.1).allclose(&factor, 1e-4, 1e-4, false));
    }
}
