//! Parameters of the Gaussians before activation.

use crate::scene::{Gaussians, RawGaussians};
use tch::{Kind, Tensor};

/// Opacity logit of Gaussians that wait for their relocation.
const DEAD_LOGIT: f64 = -30.;

/// Names of the parameters, as in gsplat where it has one: means, logarithms of scales, quaternions of any length, logits of opacities, and
/// spherical harmonics of degree 0 and of higher degrees, which have a smaller learning rate.
pub(super) const NAMES: [&str; 6] = ["means", "log_scales", "quaternions", "opacity_logits", "sh0", "shN"];

/// Returns the shapes of the parameters of `count` Gaussians with spherical harmonics up to `degree`, in the order of [`NAMES`].
pub(super) fn shapes(count: i64, degree: i64) -> [Vec<i64>; 6] {
    let rest = (degree + 1).pow(2) - 1;
    [vec![3], vec![3], vec![4], vec![], vec![1, 3], vec![rest, 3]]
        .map(|of_one| [vec![1, count], of_one].concat())
}

/// Gaussians of one scene before activation, [1, N, …] each, in the order of [`NAMES`].
#[derive(Debug)]
pub(super) struct GaussianParams(pub(super) [Tensor; 6]);

impl GaussianParams {
    /// Copies `raw` into float32 leaf tensors that require gradients. Coefficients up to `degree`, at least the degree of `raw`, are added
    /// as zeros.
    pub(super) fn from_raw(raw: &RawGaussians, degree: i64) -> Self {
        let RawGaussians { means, log_scales, quaternions, opacity_logits, sh } = raw;
        let (sh0, known) = (sh.narrow(2, 0, 1), sh.narrow(2, 1, sh.size()[2] - 1));
        let missing = (degree + 1).pow(2) - sh.size()[2];
        let sh_rest = known.constant_pad_nd([0, 0, 0, missing]);
        GaussianParams([means, log_scales, quaternions, opacity_logits, &sh0, &sh_rest].map(leaf))
    }

    /// Returns the number of Gaussians.
    pub(super) fn count(&self) -> i64 {
        self.0[0].size()[1]
    }

    /// Returns the parameters with their names.
    pub(super) fn named(&self) -> [(&'static str, &Tensor); 6] {
        std::array::from_fn(|index| (NAMES[index], &self.0[index]))
    }

    /// Returns a copy that requires no gradients.
    pub(super) fn copy(&self) -> Self {
        GaussianParams(self.0.each_ref().map(|t| t.detach().copy()))
    }

    /// Returns these Gaussians followed by `count` copies of the first one with almost no opacity (sigmoid(−30)), which the next relocation
    /// moves. Requires at least one Gaussian.
    pub(super) fn append_dead(&self, count: i64) -> Self {
        GaussianParams(std::array::from_fn(|index| {
            let t = &self.0[index];
            let mut size = t.size();
            size[1] = count;
            let more = match NAMES[index] {
                "opacity_logits" => Tensor::full(&size, DEAD_LOGIT, (Kind::Float, t.device())),
                _ => t.narrow(1, 0, 1).expand(&size, false),
            };
            Tensor::cat(&[t, &more], 1).detach().set_requires_grad(true)
        }))
    }

    /// Returns the activated Gaussians, with spherical harmonics up to `degree`; differentiable. `degree` is at most the stored one.
    pub(super) fn activate(&self, degree: i64) -> Gaussians {
        let [means, log_scales, quaternions, opacity_logits, sh0, sh_rest] =
            self.0.each_ref().map(Tensor::shallow_clone);
        let used_count = (degree + 1).pow(2) - 1;
        let sh = match used_count {
            0 => sh0,
            // The gradient of a part takes another pass over memory.
            _ if used_count == sh_rest.size()[2] => Tensor::cat(&[sh0, sh_rest], 2),
            _ => Tensor::cat(&[sh0, sh_rest.narrow(2, 0, used_count)], 2),
        };
        RawGaussians { means, log_scales, quaternions, opacity_logits, sh }.activate()
    }
}

/// Returns a float32 copy of a tensor that requires gradients.
pub(super) fn leaf(t: &Tensor) -> Tensor {
    t.detach().to_kind(Kind::Float).copy().set_requires_grad(true)
}
