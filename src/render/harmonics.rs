//! Fits spherical harmonics to limits on their values or degree, so that a capture's cameras see the same colors as before (spec 10.15).
//!
//! File formats that store a coefficient in one byte can't hold values beyond a bound. Clamping the values changes colors in every
//! direction. But cameras see a Gaussian from few directions, and other coefficients within the bound show the same colors in those
//! directions.
//!
//! A format that stores a palette of coefficients holds small coefficients best. What a palette changes in the mean color that the cameras
//! see is compensated by the coefficient of degree 0.

use crate::scene::{Camera, Gaussians, SH_C0};
use glam::{DMat4, DVec3};
use globalsplat_splat_file::{ShLimits, sh_basis};
use rayon::prelude::*;
use tch::Tensor;

/// Number of spherical harmonics of a color channel, up to degree 3.
const BASES: usize = 16;
/// Weight of a change in all directions, relative to the cameras' total weight of 1.
const OTHER_DIRECTIONS_WEIGHT: f64 = 1e-5;
/// Number of rounds of coordinate descent over the coefficients. They hardly change after half as many.
const ROUNDS: usize = 40;
/// Factor by which a Gaussian may be too dark before its opacity is raised.
const MAX_DARKENING: f64 = 1.05;
/// Maximum opacity that a Gaussian is raised to.
const MAX_OPACITY: f64 = 0.98;
/// Radius of a Gaussian, in standard deviations, that decides whether it reaches into an image.
const VISIBLE_SIGMAS: f64 = 2.;
/// Weight factor of an image that a Gaussian doesn't reach, relative to one that it reaches.
const OUTSIDE_WEIGHT: f64 = 1e-6;
/// Camera depth in local units at or below which nothing is drawn (spec 6.2).
const NEAR: f64 = 0.01;

/// Returns the Gaussians with coefficients within `limits`. `gaussians` are [1, N, ..], float32 on the host, in the cameras' local frame
/// (spec 2.5). Coefficients within the limits stay. Others are clamped, or, if any of `cameras` sees the Gaussian, fitted so that the
/// cameras see its colors as closely as possible. The opacity of a Gaussian that would be too dark is raised.
pub fn fit_harmonics(gaussians: &Gaussians, cameras: &[Camera], limits: &ShLimits) -> Gaussians {
    let colors = Colors::new(gaussians, cameras);
    let fitted: Vec<_> = (0..colors.opacities.len())
        .into_par_iter()
        .map(|index| {
            let (coefficients, opacity) = (colors.coefficients(index), f64::from(colors.opacities[index]));
            match clamp(&coefficients, limits) == coefficients {
                true => (coefficients, opacity),
                false => Fit::new(coefficients, colors.seen(index), limits).best(opacity),
            }
        })
        .collect();
    let kept = colors.bases.min((limits.degree + 1).pow(2));
    let sh: Vec<f32> = fitted
        .iter()
        .flat_map(|(coefficients, _)| coefficients[..kept].as_flattened().iter().map(|&c| c as f32))
        .collect();
    let opacities: Vec<f32> = fitted.iter().map(|&(_, opacity)| opacity as f32).collect();
    Gaussians {
        sh: Tensor::from_slice(&sh).view([1, -1, kept as i64, 3]),
        opacities: Tensor::from_slice(&opacities).view([1, -1]),
        ..gaussians.map(Tensor::shallow_clone)
    }
}

/// Returns the Gaussians with the smallest coefficients above degree 0 that show the same colors to `cameras`, for formats that hold small coefficients
/// best. `gaussians` are as in [`fit_harmonics`]. Gaussians that no camera sees stay.
pub fn shrink_harmonics(gaussians: &Gaussians, cameras: &[Camera]) -> Gaussians {
    let colors = Colors::new(gaussians, cameras);
    let limits = ShLimits::up_to(gaussians.sh.size()[2].isqrt() as usize - 1);
    let shrunk = (0..colors.opacities.len()).into_par_iter().flat_map_iter(|index| {
        let (coefficients, seen) = (colors.coefficients(index), colors.seen(index));
        let shrunk = match seen.is_empty() {
            true => coefficients,
            false => Fit::new(coefficients, seen, &limits).solve_smallest(),
        };
        shrunk.into_iter().take(colors.bases).flatten().map(|coefficient| coefficient as f32)
    });
    with_sh(gaussians, &shrunk.collect::<Vec<_>>())
}

/// Returns `rounded`, whose coefficients above degree 0 differ from those of `gaussians`, with coefficients of degree 0 for which `cameras`
/// see the same mean color as of `gaussians`.
pub fn compensate_mean_color(gaussians: &Gaussians, rounded: &Gaussians, cameras: &[Camera]) -> Gaussians {
    let (before, after) = (Colors::new(gaussians, cameras), Colors::new(rounded, &[]));
    let compensated = (0..before.opacities.len()).into_par_iter().flat_map_iter(|index| {
        let (original, mut rounded) = (before.coefficients(index), after.coefficients(index));
        let seen = before.seen(index);
        for channel in 0..3 {
            let difference = |basis: &[f64; BASES]| -> f64 {
                (0..BASES).map(|k| basis[k] * (original[k][channel] - rounded[k][channel])).sum()
            };
            let mean: f64 = seen.iter().map(|(basis, weight)| weight * difference(basis)).sum();
            rounded[0][channel] += mean / SH_C0;
        }
        rounded.into_iter().take(after.bases).flatten().map(|coefficient| coefficient as f32)
    });
    with_sh(rounded, &compensated.collect::<Vec<_>>())
}

/// Returns the Gaussians with other coefficients.
fn with_sh(gaussians: &Gaussians, sh: &[f32]) -> Gaussians {
    Gaussians { sh: Tensor::from_slice(sh).view_as(&gaussians.sh), ..gaussians.map(Tensor::shallow_clone) }
}

type Coefficients = [[f64; 3]; BASES];

/// Values of the basis functions towards each camera that sees a Gaussian, and the camera's weight; weights add up to 1.
type Seen = Vec<([f64; BASES], f64)>;

/// Numbers of Gaussians, and the cameras that see them.
struct Colors {
    means: Vec<f32>,
    scales: Vec<f32>,
    opacities: Vec<f32>,
    sh: Vec<f32>,
    bases: usize,
    /// Cameras, and the inverses of their poses.
    cameras: Vec<(Camera, DMat4)>,
}

impl Colors {
    fn new(gaussians: &Gaussians, cameras: &[Camera]) -> Self {
        let numbers =
            |tensor: &Tensor| Vec::<f32>::try_from(tensor.flatten(0, -1)).expect("float32 on the host");
        Colors {
            means: numbers(&gaussians.means),
            scales: numbers(&gaussians.scales),
            opacities: numbers(&gaussians.opacities),
            sh: numbers(&gaussians.sh),
            bases: gaussians.sh.size()[2] as usize,
            cameras: cameras.iter().map(|&camera| (camera, camera.c2w.inverse())).collect(),
        }
    }

    /// Returns the coefficients of Gaussian `index`; those of higher degrees are 0.
    fn coefficients(&self, index: usize) -> Coefficients {
        let mut coefficients = [[0.; 3]; BASES];
        let own = &self.sh[3 * self.bases * index..][..3 * self.bases];
        for (coefficient, color) in coefficients.iter_mut().zip(own.as_chunks().0) {
            *coefficient = color.map(f64::from);
        }
        coefficients
    }

    fn seen(&self, index: usize) -> Seen {
        let mean = DVec3::from_array([0, 1, 2].map(|axis| f64::from(self.means[3 * index + axis])));
        let largest = self.scales[3 * index..][..3].iter().fold(0f32, |largest, &scale| largest.max(scale));
        let radius = VISIBLE_SIGMAS * f64::from(largest);
        let mut seen: Seen = self
            .cameras
            .iter()
            .filter_map(|(camera, w2c)| {
                Some((basis_towards(camera, mean), weight(camera, w2c, mean, radius)?))
            })
            .collect();
        let total: f64 = seen.iter().map(|(_, weight)| weight).sum();
        seen.iter_mut().for_each(|(_, weight)| *weight /= total);
        seen
    }
}

/// Clamps coefficients to `limits`.
fn clamp(coefficients: &Coefficients, limits: &ShLimits) -> Coefficients {
    std::array::from_fn(|basis| {
        let (low, high) = limits.range_of(basis);
        coefficients[basis].map(|coefficient| coefficient.clamp(low, high))
    })
}

/// Least-squares problem for the coefficients of one Gaussian.
struct Fit<'a> {
    original: Coefficients,
    seen: Seen,
    /// Quadratic cost of a change of the coefficients: Σ weight·Y·Yᵀ over cameras, plus a small multiple of the identity.
    cost: [[f64; BASES]; BASES],
    limits: &'a ShLimits,
}

impl<'a> Fit<'a> {
    fn new(original: Coefficients, seen: Seen, limits: &'a ShLimits) -> Self {
        let mut cost = [[0.; BASES]; BASES];
        for (row, costs) in cost.iter_mut().enumerate() {
            costs[row] = OTHER_DIRECTIONS_WEIGHT;
            for (basis, weight) in &seen {
                costs.iter_mut().zip(basis).for_each(|(cost, other)| *cost += weight * basis[row] * other);
            }
        }
        Fit { original, seen, cost, limits }
    }

    /// Returns the fitted coefficients and the opacity.
    fn best(mut self, opacity: f64) -> (Coefficients, f64) {
        if self.seen.is_empty() {
            return (clamp(&self.original, self.limits), opacity);
        }
        let fitted = self.solve();
        let dark = self.darkness(&fitted);
        if dark <= MAX_DARKENING || opacity >= MAX_OPACITY {
            return (fitted, opacity);
        }
        // The product of color and opacity stays the same. The color includes the offset of ½.
        let raised = (opacity * dark).min(MAX_OPACITY);
        let factor = opacity / raised;
        self.original.iter_mut().flatten().for_each(|coefficient| *coefficient *= factor);
        self.original[0].iter_mut().for_each(|constant| *constant += (factor - 1.) * 0.5 / SH_C0);
        (self.solve(), raised)
    }

    /// Returns the coefficients that minimize the squared error of the seen colors, plus a small multiple ε of the squares of all
    /// coefficients above degree 0.
    ///
    /// With A = Σ weight·Y·Yᵀ, they are c = (A + ε·diag(0, 1, 1, …))⁻¹ A c₀. The matrix is positive definite, so Gauss–Jordan elimination
    /// needs no pivots.
    fn solve_smallest(&self) -> Coefficients {
        let bases = (self.limits.degree + 1).pow(2);
        let mut rows = self.cost;
        rows[0][0] -= OTHER_DIRECTIONS_WEIGHT;
        let mut solution: Coefficients = std::array::from_fn(|row| {
            [0, 1, 2].map(|channel| {
                let product = |k: usize| self.cost[row][k] * self.original[k][channel];
                let sum: f64 = (0..BASES).map(product).sum();
                sum - OTHER_DIRECTIONS_WEIGHT * self.original[row][channel]
            })
        });
        for pivot in 0..bases {
            let (line, right) = (rows[pivot], solution[pivot]);
            for row in (0..bases).filter(|&row| row != pivot) {
                let factor = rows[row][pivot] / line[pivot];
                (pivot..bases).for_each(|k| rows[row][k] -= factor * line[k]);
                (0..3).for_each(|channel| solution[row][channel] -= factor * right[channel]);
            }
        }
        std::array::from_fn(|row| {
            if row < bases { solution[row].map(|value| value / rows[row][row]) } else { [0.; 3] }
        })
    }

    fn solve(&self) -> Coefficients {
        let mut solution = clamp(&self.original, self.limits);
        (0..3).for_each(|channel| self.solve_channel(channel, &mut solution));
        solution
    }

    /// Minimizes Δᵀ·cost·Δ within the limits, where Δ is the change of the coefficients, by cyclic coordinate descent.
    fn solve_channel(&self, channel: usize, solution: &mut Coefficients) {
        let mut slope: [f64; BASES] = std::array::from_fn(|row| {
            let change = |basis: usize| solution[basis][channel] - self.original[basis][channel];
            (0..BASES).map(|basis| self.cost[row][basis] * change(basis)).sum()
        });
        for _ in 0..ROUNDS {
            for (basis, costs) in self.cost.iter().enumerate() {
                let (low, high) = self.limits.range_of(basis);
                let before = solution[basis][channel];
                let after = (before - slope[basis] / costs[basis]).clamp(low, high);
                solution[basis][channel] = after;
                slope.iter_mut().zip(costs).for_each(|(slope, cost)| *slope += cost * (after - before));
            }
        }
    }

    /// Returns the factor that brings the colors of `fitted` nearest to those of the original coefficients, in the least-squares sense.
    fn darkness(&self, fitted: &Coefficients) -> f64 {
        let color = |coefficients: &Coefficients, basis: &[f64; BASES], channel: usize| {
            let sum: f64 = basis.iter().zip(coefficients).map(|(y, of_basis)| y * of_basis[channel]).sum();
            (sum + 0.5).max(0.)
        };
        let (mut product, mut square) = (0., 0.);
        for (basis, weight) in &self.seen {
            for channel in 0..3 {
                let (was, is) = (color(&self.original, basis, channel), color(fitted, basis, channel));
                product += weight * was * is;
                square += weight * is * is;
            }
        }
        if square > 0. { product / square } else { 1. }
    }
}

/// Returns the values of the basis functions in the direction in which `camera` sees `mean`.
fn basis_towards(camera: &Camera, mean: DVec3) -> [f64; BASES] {
    sh_basis((mean - camera.c2w.w_axis.truncate()).normalize_or_zero())
}

/// Returns the weight of `camera` for a Gaussian: proportional to the number of pixels that it covers, and reduced by `OUTSIDE_WEIGHT` if
/// its `radius` doesn't reach into the image. Returns `None` if its mean is nearer than `NEAR` or behind the camera.
fn weight(camera: &Camera, w2c: &DMat4, mean: DVec3, radius: f64) -> Option<f64> {
    let seen = w2c.transform_point3(mean);
    let (k, width, height) = (camera.intrinsics, f64::from(camera.width), f64::from(camera.height));
    let (x, y) = (k.fx * seen.x / seen.z + k.cx, k.fy * seen.y / seen.z + k.cy);
    let (wide, high) = (k.fx * radius / seen.z, k.fy * radius / seen.z);
    let inside = (-wide..=width + wide).contains(&x) && (-high..=height + high).contains(&y);
    let factor = if inside { 1. } else { OUTSIDE_WEIGHT };
    (seen.z > NEAR).then(|| factor * k.fx * k.fy / (seen.z * seen.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::render_views;
    use crate::scene::Intrinsics;
    use tch::{Device, Kind};

    fn cameras(count: i32) -> Vec<Camera> {
        let intrinsics = Intrinsics { fx: 40., fy: 40., cx: 16., cy: 16. };
        let c2w = |i: i32| DMat4::from_translation(DVec3::new(0.15 * f64::from(i - count / 2), 0., 0.));
        (0..count).map(|i| Camera { intrinsics, c2w: c2w(i), width: 32, height: 32 }).collect()
    }

    /// Returns a Gaussian in front of the cameras, one behind them, and one whose coefficients need no change.
    fn gaussians(coefficient: f64) -> Gaussians {
        let options = (Kind::Float, Device::Cpu);
        let sh = Tensor::zeros([1, 3, 16, 3], options);
        let _ = sh.narrow(1, 0, 2).narrow(2, 2, 1).fill_(coefficient); // z
        let _ = sh.narrow(1, 0, 2).narrow(2, 12, 1).fill_(-coefficient); // z, of degree 3
        let _ = sh.narrow(1, 2, 1).fill_(0.25);
        Gaussians {
            means: Tensor::from_slice(&[0f32, 0., 4., 0., 0., -4., 0.5, 0.5, 5.]).view([1, 3, 3]),
            scales: Tensor::full([1, 3, 3], 0.3, options),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).repeat([1, 3, 1]),
            opacities: Tensor::full([1, 3], 0.1, options),
            sh,
            antialiased: false,
        }
    }

    fn loss(a: &Gaussians, b: &Gaussians, cameras: &[Camera]) -> f64 {
        let seen = |g| render_views(g, cameras).unwrap();
        let errors = seen(a).into_iter().zip(seen(b)).map(|(a, b)| (a.rgb - b.rgb).abs().max());
        errors.map(|error| error.double_value(&[])).fold(0., f64::max)
    }

    #[test]
    fn cameras_see_the_same_with_smaller_coefficients() {
        let limits = ShLimits { degree: 3, dc: -3. ..=3., rest: -1. ..=1. };
        let original = gaussians(3.);
        let fitted = fit_harmonics(&original, &cameras(5), &limits);
        let clamped = fit_harmonics(&original, &[], &limits);
        assert!(
            fitted.sh.abs().max().double_value(&[]) <= 3. && clamped.sh.abs().max().double_value(&[]) <= 1.
        );
        // The images must also match from camera positions outside the range that was fitted.
        let (fit, clamp) = (loss(&original, &fitted, &cameras(9)), loss(&original, &clamped, &cameras(9)));
        assert!(fit < 0.003 && clamp > 0.02, "{fit} fitted, {clamp} clamped");
        assert!(fitted.sh.narrow(1, 1, 1).equal(&clamped.sh.narrow(1, 1, 1)), "seen by nobody");
        assert!(fitted.sh.narrow(1, 2, 1).equal(&original.sh.narrow(1, 2, 1)), "within the limits");
    }

    /// The smallest coefficients look the same from the cameras, and rounded ones have the same mean color.
    #[test]
    fn coefficients_shrink_and_rounding_is_compensated() {
        let (original, cameras) = (gaussians(3.), cameras(5));
        let shrunk = shrink_harmonics(&original, &cameras);
        let largest = |g: &Gaussians, index: i64| g.sh.narrow(1, index, 1).abs().max().double_value(&[]);
        assert!(largest(&shrunk, 0) < 2.5 && largest(&shrunk, 1) == 3., "{}", largest(&shrunk, 0));
        // Colors that don't depend on the direction stay as they are.
        let mut constant = original.map(Tensor::shallow_clone);
        constant.sh = original.sh.copy();
        let _ = constant.sh.narrow(2, 1, 15).fill_(0.);
        let _ = constant.sh.narrow(2, 0, 1).fill_(1.5);
        let difference = (shrink_harmonics(&constant, &cameras).sh - &constant.sh).abs().max();
        assert!(difference.double_value(&[]) < 1e-5, "{difference}");
        let flat =
            Gaussians { sh: original.sh.narrow(2, 0, 4).copy(), ..original.map(Tensor::shallow_clone) };
        let difference = loss(&flat, &shrink_harmonics(&flat, &cameras), &cameras);
        assert!(difference < 0.003, "degree 1: {difference}");
        let difference = loss(&original, &shrunk, &cameras);
        assert!(difference > 0. && difference < 0.003, "{difference}");
        let mut rounded = shrunk.map(Tensor::shallow_clone);
        rounded.sh = &shrunk.sh + 0.2;
        rounded.sh.narrow(2, 0, 1).copy_(&shrunk.sh.narrow(2, 0, 1));
        let compensated = compensate_mean_color(&original, &rounded, &cameras);
        let (before, after) = (loss(&original, &rounded, &cameras), loss(&original, &compensated, &cameras));
        assert!(after < 0.15 * before, "{before} rounded, {after} compensated");
        assert!(compensated.sh.narrow(2, 1, 15).equal(&rounded.sh.narrow(2, 1, 15)));
    }

    #[test]
    fn opacity_rises_if_limits_darken_the_color() {
        let limits = ShLimits { degree: 0, dc: -1.77..=1.77, rest: 0. ..=0. };
        let mut original = gaussians(0.);
        original.sh = Tensor::zeros_like(&original.sh);
        let _ = original.sh.narrow(2, 0, 1).fill_(3.5 / SH_C0); // 4 times the maximum that a screen shows
        let fitted = fit_harmonics(&original, &cameras(5), &limits);
        assert_eq!(fitted.sh.size(), [1, 3, 1, 3]);
        let opacities = Vec::<f32>::try_from(fitted.opacities.flatten(0, 1)).unwrap();
        assert!((opacities[0] - 0.4).abs() < 0.01 && opacities[1] == 0.1, "{opacities:?}");
    }
}
