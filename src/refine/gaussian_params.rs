//! Parameters of the Gaussians that are optimized.

use crate::error::{Error, Result};
use crate::scene::{Gaussians, RawGaussians};
use tch::{Device, Kind, Tensor};

/// Opacity logit of Gaussians that wait for their relocation.
const DEAD_LOGIT: f64 = -30.;

/// Gaussians of one scene before activation. Colours are separate from the higher spherical harmonics, which have a smaller learning rate.
#[derive(Debug)]
pub struct GaussianParams {
    /// Means, [1, N, 3].
    pub means: Tensor,
    /// Logarithms of scales, [1, N, 3].
    pub log_scales: Tensor,
    /// Quaternions, [1, N, 4].
    pub quaternions: Tensor,
    /// Logits of opacities, [1, N].
    pub opacity_logits: Tensor,
    /// Spherical harmonics of degree 0, [1, N, 1, 3].
    pub colours: Tensor,
    /// Spherical harmonics of higher degrees, [1, N, (degree + 1)² − 1, 3].
    pub harmonics: Tensor,
}

impl GaussianParams {
    /// Copies `raw` to new parameters, with spherical harmonics up to `degree`, which is at least that of `raw`.
    pub fn from_raw(raw: &RawGaussians, degree: i64) -> Self {
        let leaf = |t: Tensor| t.detach().to_kind(Kind::Float).copy().set_requires_grad(true);
        let size = raw.sh.size();
        let bases = (degree + 1).pow(2);
        let higher = Tensor::zeros([1, size[1], bases - 1, 3], (Kind::Float, raw.sh.device()));
        let known = size[2] - 1;
        higher.narrow(2, 0, known).copy_(&raw.sh.narrow(2, 1, known));
        GaussianParams {
            means: leaf(raw.means.shallow_clone()),
            log_scales: leaf(raw.log_scales.shallow_clone()),
            quaternions: leaf(raw.quaternions.shallow_clone()),
            opacity_logits: leaf(raw.opacity_logits.shallow_clone()),
            colours: leaf(raw.sh.narrow(2, 0, 1)),
            harmonics: leaf(higher),
        }
    }

    /// Creates parameters from the tensors that `of` returns for their names, which are copied to `device`.
    ///
    /// # Errors
    /// Returns the first error of `of`.
    pub fn from_named<'a>(of: impl Fn(&str) -> Result<&'a Tensor>, device: Device) -> Result<Self> {
        let leaf = |name: &str| {
            Ok::<_, Error>(of(name)?.to_device(device).to_kind(Kind::Float).copy().set_requires_grad(true))
        };
        Ok(GaussianParams {
            means: leaf("means")?,
            log_scales: leaf("log_scales")?,
            quaternions: leaf("quaternions")?,
            opacity_logits: leaf("opacity_logits")?,
            colours: leaf("colours")?,
            harmonics: leaf("harmonics")?,
        })
    }

    /// Returns these Gaussians and `count` more, which are copies of the first with hardly any opacity.
    pub fn with_dead(&self, count: i64) -> Self {
        let leaf = |t: &Tensor, more: &Tensor| Tensor::cat(&[t, more], 1).detach().set_requires_grad(true);
        let with_copies = |t: &Tensor| {
            let mut size = t.size();
            size[1] = count;
            leaf(t, &t.narrow(1, 0, 1).expand(&size, false))
        };
        let logits = &self.opacity_logits;
        GaussianParams {
            means: with_copies(&self.means),
            log_scales: with_copies(&self.log_scales),
            quaternions: with_copies(&self.quaternions),
            opacity_logits: leaf(
                logits,
                &Tensor::full([1, count], DEAD_LOGIT, (Kind::Float, logits.device())),
            ),
            colours: with_copies(&self.colours),
            harmonics: with_copies(&self.harmonics),
        }
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> i64 {
        self.means.size()[1]
    }

    /// Returns the parameters with their names, in this order.
    pub fn named_parameters(&self) -> [(&'static str, &Tensor); 6] {
        [
            ("means", &self.means),
            ("log_scales", &self.log_scales),
            ("quaternions", &self.quaternions),
            ("opacity_logits", &self.opacity_logits),
            ("colours", &self.colours),
            ("harmonics", &self.harmonics),
        ]
    }

    /// Returns the activated Gaussians, with spherical harmonics up to `degree`; differentiable.
    pub fn activate(&self, degree: i64) -> Gaussians {
        self.raw(degree).activate()
    }

    fn raw(&self, degree: i64) -> RawGaussians {
        let sh = match degree {
            0 => self.colours.shallow_clone(),
            _ => {
                let known = (degree + 1).pow(2) - 1;
                let harmonics = match self.harmonics.size()[2] == known {
                    true => self.harmonics.shallow_clone(),
                    false => self.harmonics.narrow(2, 0, known),
                };
                Tensor::cat(&[&self.colours, &harmonics], 2)
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
