//! 3D Gaussians as the model outputs them and the rasterizer renders them, and their unconstrained parameters.

use globalsplat_splat_file::{MIN_SCALE, OPACITY_MARGIN};
use tch::{Device, Kind, Tensor};

/// 3D Gaussians of B scenes with N Gaussians each.
#[derive(Debug)]
pub struct Gaussians {
    /// Centres, `[B, N, 3]`.
    pub means: Tensor,
    /// Standard deviations along the Gaussians' own axes, linear, `[B, N, 3]`.
    pub scales: Tensor,
    /// Rotations as quaternions (w, x, y, z), `[B, N, 4]`.
    pub quaternions: Tensor,
    /// Opacities in [0, 1], `[B, N]`.
    pub opacities: Tensor,
    /// Spherical harmonics coefficients, `[B, N, (degree + 1)², 3]`.
    pub sh: Tensor,
    /// `true` if the renderer has to reduce opacities by what its low-pass filter adds to the area of the projected Gaussians, as
    /// [`Splat::antialiased`](globalsplat_splat_file::Splat::antialiased) says.
    pub antialiased: bool,
}

impl Gaussians {
    /// Returns N, the number of Gaussians per scene.
    pub fn count(&self) -> i64 {
        self.means.size()[1]
    }

    /// Applies `f` to every tensor.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Gaussians {
            means: f(&self.means),
            scales: f(&self.scales),
            quaternions: f(&self.quaternions),
            opacities: f(&self.opacities),
            sh: f(&self.sh),
            antialiased: self.antialiased,
        }
    }

    /// Returns a copy on `device`, or shallow clones of tensors that are already there.
    pub fn to_device(&self, device: Device) -> Self {
        self.map(|t| t.to_device(device))
    }
}

/// Gaussians before activation, as 3DGS stores and optimizes them: every real value is valid.
#[derive(Debug)]
pub struct RawGaussians {
    /// Centres, like [`Gaussians::means`].
    pub means: Tensor,
    /// Natural logarithms of the scales, `[B, N, 3]`.
    pub log_scales: Tensor,
    /// Quaternions of any length, like [`Gaussians::quaternions`].
    pub quaternions: Tensor,
    /// Logits of the opacities, `[B, N]`.
    pub opacity_logits: Tensor,
    /// Spherical harmonics coefficients, like [`Gaussians::sh`].
    pub sh: Tensor,
}

impl RawGaussians {
    /// Returns the parameters that activate to `gaussians`: opacities up to 1e-6, everything else up to rounding.
    pub fn from_gaussians(gaussians: &Gaussians) -> Self {
        let Gaussians { means, scales, quaternions, opacities, sh, .. } = gaussians;
        RawGaussians {
            means: means.shallow_clone(),
            log_scales: scales.clamp_min(MIN_SCALE).log(),
            quaternions: quaternions.shallow_clone(),
            opacity_logits: opacities.to_kind(Kind::Double).logit(OPACITY_MARGIN).to_kind(opacities.kind()),
            sh: sh.shallow_clone(),
        }
    }

    /// Returns the activated Gaussians, whose opacities are rendered unreduced. Differentiable.
    pub fn activate(&self) -> Gaussians {
        Gaussians {
            means: self.means.shallow_clone(),
            scales: self.log_scales.exp(),
            quaternions: self.quaternions.shallow_clone(),
            opacities: sigmoid(&self.opacity_logits),
            sh: self.sh.shallow_clone(),
            antialiased: false,
        }
    }

    /// Applies `f` to every tensor.
    fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        RawGaussians {
            means: f(&self.means),
            log_scales: f(&self.log_scales),
            quaternions: f(&self.quaternions),
            opacity_logits: f(&self.opacity_logits),
            sh: f(&self.sh),
        }
    }

    /// Returns shallow clones of all tensors.
    pub fn shallow_clone(&self) -> Self {
        self.map(Tensor::shallow_clone)
    }

    /// Returns a copy on `device`, or shallow clones of tensors that are already there.
    pub fn to_device(&self, device: Device) -> Self {
        self.map(|t| t.to_device(device))
    }

    /// Returns the Gaussians `indices` of every scene.
    pub fn select(&self, indices: &[i64]) -> Self {
        let indices = Tensor::from_slice(indices).to_device(self.means.device());
        self.map(|t| t.index_select(1, &indices))
    }

    /// Concatenates these Gaussians and `others` of the same scenes. The result has the higher of both degrees of spherical
    /// harmonics.
    pub fn concat(&self, others: &RawGaussians) -> Self {
        let joined = |a: &Tensor, b: &Tensor| Tensor::cat(&[a, b], 1);
        let bases = self.sh.size()[2].max(others.sh.size()[2]);
        let padded = |sh: &Tensor| sh.constant_pad_nd([0, 0, 0, bases - sh.size()[2]]);
        RawGaussians {
            means: joined(&self.means, &others.means),
            log_scales: joined(&self.log_scales, &others.log_scales),
            quaternions: joined(&self.quaternions, &others.quaternions),
            opacity_logits: joined(&self.opacity_logits, &others.opacity_logits),
            sh: joined(&padded(&self.sh), &padded(&others.sh)),
        }
    }

    /// Returns every tensor with its name, as optimizers take them.
    pub fn named_parameters(&self) -> [(&'static str, &Tensor); 5] {
        [
            ("means", &self.means),
            ("log_scales", &self.log_scales),
            ("quaternions", &self.quaternions),
            ("opacity_logits", &self.opacity_logits),
            ("sh", &self.sh),
        ]
    }
}

/// Returns the sigmoid of every element, bit-identical for any number of threads. Differentiable. Libtorch computes the last
/// elements of each thread's share by a different formula, so this function calls it on parts that are too small to be divided
/// among threads.
pub(crate) fn sigmoid(logits: &Tensor) -> Tensor {
    const AT_ONCE: i64 = 1 << 14;
    if logits.device() != Device::Cpu || logits.numel() <= AT_ONCE as usize {
        return logits.sigmoid();
    }
    let parts: Vec<Tensor> = logits.reshape([-1]).split(AT_ONCE, 0).iter().map(Tensor::sigmoid).collect();
    Tensor::cat(&parts, 0).view_as(logits)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::num_threads;

    #[test]
    fn activation_inverts_from_gaussians() {
        let gaussians = Gaussians {
            means: Tensor::from_slice(&[1f32, -2., 3., 0., 0., 5.]).view([1, 2, 3]),
            scales: Tensor::from_slice(&[1e-4f32, 0.5, 20., 1., 1., 0.]).view([1, 2, 3]),
            quaternions: Tensor::from_slice(&[2f32, 0., 0., 0., 0., 0.6, 0.8, 0.]).view([1, 2, 4]),
            opacities: Tensor::from_slice(&[0f32, 0.99]).view([1, 2]),
            sh: Tensor::from_slice(&[0.5f32, -3., 0., 1., 2., 3.]).view([1, 2, 1, 3]),
            antialiased: false,
        };
        let raw = RawGaussians::from_gaussians(&gaussians);
        assert!(raw.named_parameters().iter().all(|(_, t)| t.isfinite().all().int64_value(&[]) == 1));
        let again = raw.activate();
        let off = |a: &Tensor, b: &Tensor| (a - b).abs().max().double_value(&[]);
        assert!(again.means.equal(&gaussians.means) && again.sh.equal(&gaussians.sh));
        assert!(again.quaternions.equal(&gaussians.quaternions));
        assert!(
            off(&again.scales, &gaussians.scales) < 1e-5
                && off(&again.opacities, &gaussians.opacities) < 2e-6
        );
    }

    #[test]
    fn sigmoid_has_the_same_bits_for_any_number_of_threads() {
        let _guard = num_threads::change();
        let logits = Tensor::arange(3 * 33_331, (Kind::Float, Device::Cpu)).sin().view([3, -1]) * 9.;
        let expected = sigmoid(&logits);
        let threads = tch::get_num_threads();
        for count in [1, 2, 3, 7] {
            tch::set_num_threads(count);
            assert!(sigmoid(&logits).equal(&expected), "{count} threads");
        }
        tch::set_num_threads(threads);
        assert!((expected - logits.to_kind(Kind::Double).sigmoid()).abs().max().double_value(&[]) < 1e-6);
    }
}
