//! Fit of a reconstruction's colors to its photos (spec 9.9). Renders are linear in the spherical harmonics, so that the best ones for
//! given shapes and opacities solve a least-squares problem.

use crate::data::ViewBatch;
use crate::error::Result;
use crate::render::{default_eps2d, image_contributions, render};
use crate::scene::Gaussians;
use std::f64::consts::PI;
use tch::{Kind, Tensor, with_grad};

/// Contribution in pixels that is added to that of every Gaussian, so that colors which the photos don't show hardly change.
const UNSEEN: f64 = 1e-3;

/// Returns `gaussians`, one scene in the normalized world, with spherical harmonics fitted to the images of `views`: reduces the sum of
/// squared errors over the pixels that count by `steps` steps of gradient descent with Nesterov's momentum, whose sizes are small enough
/// to converge.
pub(crate) fn fit_colors(gaussians: &Gaussians, views: &ViewBatch, steps: usize) -> Result<Gaussians> {
    let cameras = views.cameras();
    let gradient = |sh: &Tensor| -> Result<Tensor> {
        let sh = sh.detach().set_requires_grad(true);
        let colored = Gaussians { sh: sh.shallow_clone(), ..gaussians.map(Tensor::detach) };
        let half_sum = with_grad(|| -> Result<Tensor> {
            let rendered = render(&colored, &cameras, default_eps2d(gaussians))?.rgb;
            let errors = (rendered - &views.images).square();
            let errors = views.masks.as_ref().map_or(errors.shallow_clone(), |masks| &errors * masks);
            Ok(errors.sum(None::<Kind>) * 0.5)
        })?;
        Ok(Tensor::run_backward(&[half_sum], &[sh], false, false).remove(0))
    };

    let sizes = step_sizes(&gaussians.sh, &image_contributions(gaussians, &cameras)?);
    let mut sh = gaussians.sh.detach();
    let mut ahead = sh.shallow_clone();
    for step in 1..=steps {
        let next = &ahead - gradient(&ahead)? * &sizes;
        let momentum = (step as f64 - 1.) / (step as f64 + 2.);
        ahead = &next + (&next - &sh) * momentum;
        sh = next;
    }
    Ok(Gaussians { sh, ..gaussians.map(Tensor::shallow_clone) })
}

/// Returns the step sizes for `sh` [1, N, n, 3] of Gaussians with these `contributions` [1, N] in pixels, [1, N, n, 1].
///
/// A pixel is a sum of the coefficients with factors a_j = w Y(d), a Gaussian's weight w times a basis function Y of degree l. The matrix
/// with D_j = Σ |a_j| Σ_k |a_k|, summed over the pixels, on its diagonal is at least the Hessian, so that steps of 1/D_j converge. The
/// weights of a pixel add up to at most 1; |Y| is at most √((2l + 1)/4π), and Σ |Y| over all n basis functions at most n/√4π.
fn step_sizes(sh: &Tensor, contributions: &Tensor) -> Tensor {
    let bases = sh.size()[2];
    let bound = |basis: i64| {
        let degree = (basis as f64).sqrt().floor();
        bases as f64 * (2. * degree + 1.).sqrt() / (4. * PI)
    };
    let bounds = Tensor::from_slice(&(0..bases).map(bound).collect::<Vec<_>>()).view([1, 1, -1, 1]);
    let bounds = bounds.to_kind(sh.kind()).to_device(sh.device());
    (contributions.unsqueeze(-1).unsqueeze(-1) * bounds + UNSEEN).reciprocal()
}
