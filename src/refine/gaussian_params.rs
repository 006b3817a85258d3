//! Parameters of the Gaussians that are optimized.

use crate::error::{Error, Result};
use crate::scene::{Gaussians, RawGaussians};
use tch::{Device, Kind, Tensor};

/// Opacity logit of Gaussians that wait for their relocation.
const DEAD_LOGIT: f64 = -30.;

/// Gaussians of one scene before activation. Spherical harmonics of degree 0 are separate from the others, which have a smaller learning
/// rate.
#[derive(Debug)]
pub struct GaussianParams {
    /// Means, [1, N, 3].
    pub means: Tensor,
    /// Natural logarithms of the scales, [1, N, 3].
    pub log_scales: Tensor,
    /// Quaternions (w, x, y, z), not normalized, [1, N, 4].
    pub quaternions: Tensor,
    /// Logits of the opacities, [1, N].
    pub opacity_logits: Tensor,
    /// Spherical harmonics coefficients of degree 0, [1, N, 1, 3].
    pub sh0: Tensor,
    /// Spherical harmonics coefficients of degrees 1 and above, [1, N, (degree + 1)² − 1, 3].
    pub sh_rest: Tensor,
}

impl GaussianParams {
    /// Copies `raw` into float32 leaf tensors that require gradients. Coefficients up to `degree`, at least the degree of `raw`, are added
    /// as zeros.
    pub fn from_raw(raw: &RawGaussians, degree: i64) -> Self {
        let parameter = |t: Tensor| t.detach().to_kind(Kind::Float).copy().set_requires_grad(true);
        let size = raw.sh.size();
        let bases = (degree + 1).pow(2);
        let sh_rest = Tensor::zeros([1, size[1], bases - 1, 3], (Kind::Float, raw.sh.device()));
        let raw_count = size[2] - 1;
        sh_rest.narrow(2, 0, raw_count).copy_(&raw.sh.narrow(2, 1, raw_count));
        GaussianParams {
            means: parameter(raw.means.shallow_clone()),
            log_scales: parameter(raw.log_scales.shallow_clone()),
            quaternions: parameter(raw.quaternions.shallow_clone()),
            opacity_logits: parameter(raw.opacity_logits.shallow_clone()),
            sh0: parameter(raw.sh.narrow(2, 0, 1)),
            sh_rest: parameter(sh_rest),
        }
    }

    /// Creates parameters from the tensors that `tensor` returns for their names, which are copied to `device`.
    ///
    /// # Errors
    /// Returns the first error of `tensor`.
    pub fn from_named<'a>(tensor: impl Fn(&str) -> Result<&'a Tensor>, device: Device) -> Result<Self> {
        let parameter = |name: &str| {
            let t = tensor(name)?.to_device(device).to_kind(Kind::Float).copy();
            Ok::<_, Error>(t.set_requires_grad(true))
        };
        Ok(GaussianParams {
            means: parameter("means")?,
            log_scales: parameter("log_scales")?,
            quaternions: parameter("quaternions")?,
            opacity_logits: parameter("opacity_logits")?,
            sh0: parameter("sh0")?,
            sh_rest: parameter("shN")?,
        })
    }

    /// Returns a copy that requires no gradients.
    pub fn copy(&self) -> Self {
        self.map(|_, t| t.detach().copy())
    }

    /// Returns these Gaussians followed by `count` copies of the first one with almost no opacity (sigmoid(−30)), which the next relocation
    /// moves. Requires at least one Gaussian.
    pub fn append_dead(&self, count: i64) -> Self {
        self.map(|name, t| {
            let mut size = t.size();
            size[1] = count;
            let more = match name {
                "opacity_logits" => Tensor::full(&size, DEAD_LOGIT, (Kind::Float, t.device())),
                _ => t.narrow(1, 0, 1).expand(&size, false),
            };
            Tensor::cat(&[t, &more], 1).detach().set_requires_grad(true)
        })
    }

    fn map(&self, f: impl Fn(&str, &Tensor) -> Tensor) -> Self {
        let [means, log_scales, quaternions, opacity_logits, sh0, sh_rest] =
            self.named_parameters().map(|(name, t)| f(name, t));
        GaussianParams { means, log_scales, quaternions, opacity_logits, sh0, sh_rest }
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> i64 {
        self.means.size()[1]
    }

    /// Returns the parameters with their names in a state file, in the order of the fields, by which learning rates are set.
    pub fn named_parameters(&self) -> [(&'static str, &Tensor); 6] {
        [
            ("means", &self.means),
            ("log_scales", &self.log_scales),
            ("quaternions", &self.quaternions),
            ("opacity_logits", &self.opacity_logits),
            ("sh0", &self.sh0),
            ("shN", &self.sh_rest),
        ]
    }

    /// Returns the activated Gaussians, with spherical harmonics up to `degree`; differentiable. `degree` is at most the stored one.
    pub fn activate(&self, degree: i64) -> Gaussians {
        self.raw(degree).activate()
    }

    fn raw(&self, degree: i64) -> RawGaussians {
        let sh = match degree {
            0 => self.sh0.shallow_clone(),
            _ => {
                let used_count = (degree + 1).pow(2) - 1;
                // The gradient of a part takes another pass over memory.
                let is_part = used_count < self.sh_rest.size()[2];
                let used = if is_part { &self.sh_rest.narrow(2, 0, used_count) } else { &self.sh_rest };
                Tensor::cat(&[&self.sh0, used], 2)
            }
        };
        RawGaussians {
            means: self.means.shallow_clone(),
            log_scales: self.log_scales.shallow_clone(),
            quaternions: self.quaternions.shallow_clone(),
            opacity_logits: self.opacity_logits.shallow_clone(),
            sh,
        }
    }
}
