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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::view_matrices;
    use crate::scene::{Camera, Intrinsics};
    use glam::{DMat4, DVec3};
    use tch::Device;

    /// Returns 60 Gaussians in front of the cameras and one behind them, with SH of degree 1.
    fn gaussians() -> Gaussians {
        tch::manual_seed(0);
        let options = (Kind::Float, Device::Cpu);
        let means = Tensor::rand([1, 61, 3], options) * 2. - 1. + Tensor::from_slice(&[0f32, 0., 3.]);
        let _ = means.get(0).get(60).get(2).fill_(-3.);
        Gaussians {
            means,
            scales: Tensor::rand([1, 61, 3], options) * 0.2 + 0.1,
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).repeat([1, 61, 1]),
            opacities: Tensor::full([1, 61], 0.9, options),
            sh: Tensor::rand([1, 61, 4, 3], options) * 0.4 - 0.2,
            antialiased: false,
        }
    }

    /// Returns views whose images are renders of `gaussians` from three cameras.
    fn views(gaussians: &Gaussians) -> ViewBatch {
        let intrinsics = Intrinsics { fx: 24., fy: 24., cx: 12., cy: 12. };
        let cameras = [-0.4, 0., 0.4].map(|x| Camera {
            intrinsics,
            c2w: DMat4::from_translation(DVec3::new(x, 0.1, 0.)),
            width: 24,
            height: 24,
        });
        let [c2w, w2c, intrinsics] = view_matrices(&cameras, Device::Cpu);
        let images = Tensor::zeros([1, 3, 3, 24, 24], (Kind::Float, Device::Cpu));
        let mut views = ViewBatch { images, masks: None, depths: None, c2w, w2c, intrinsics };
        views.images = render(gaussians, &views.cameras(), default_eps2d(gaussians)).unwrap().rgb;
        views
    }

    fn error(gaussians: &Gaussians, views: &ViewBatch) -> f64 {
        let rendered = render(gaussians, &views.cameras(), default_eps2d(gaussians)).unwrap().rgb;
        (rendered - &views.images).square().mean(Kind::Double).double_value(&[])
    }

    #[test]
    fn colors_are_recovered_from_renders() {
        let truth = gaussians();
        let views = views(&truth);
        let grey = Gaussians { sh: truth.sh.zeros_like(), ..truth.map(Tensor::shallow_clone) };
        let fitted = |steps| tch::no_grad(|| fit_colors(&grey, &views, steps)).unwrap();
        let errors = [0, 5, 20, 100].map(|steps| error(&fitted(steps), &views));
        assert_eq!(errors[0], error(&grey, &views));
        for (error, bound) in errors[1..].iter().zip([0.1, 0.01, 0.001]) {
            assert!(*error < bound * errors[0], "{errors:?}");
        }
        let result = fitted(100);
        assert!(result.means.equal(&truth.means) && result.opacities.equal(&truth.opacities));
        assert_eq!(result.sh.get(0).get(60).abs().max().double_value(&[]), 0., "nothing shows it");
    }
}
