//! 3D Gaussians as the model outputs them and the rasterizer renders them, their unconstrained parameters, and conversions: from and to
//! splats, which are plain arrays as files hold them, and between the world and local frames (spec 2.5).

use super::LocalFrame;
use crate::error::{Error, Result};
use glam::DVec3;
use globalsplat_splat_file::{MIN_SCALE, OPACITY_MARGIN, Splat};
use tch::{Device, Kind, Tensor};

/// 3D Gaussians of B scenes with N Gaussians each.
#[derive(Debug)]
pub struct Gaussians {
    /// Centers, `[B, N, 3]`.
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
    /// Centers, like [`Gaussians::means`].
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

impl RawGaussians {
    /// Returns the parameters of `splat` as tensors, [1, N, ..], float32 on the host, with means relative to the splat's origin.
    pub fn from_splat(splat: &Splat) -> Self {
        let (n, bases) = (splat.len() as i64, splat.bases() as i64);
        let tensor = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).view(shape);
        RawGaussians {
            means: tensor(splat.means.as_flattened(), &[1, n, 3]),
            log_scales: tensor(splat.log_scales.as_flattened(), &[1, n, 3]),
            quaternions: tensor(splat.quaternions.as_flattened(), &[1, n, 4]),
            opacity_logits: tensor(&splat.opacity_logits, &[1, n]),
            sh: tensor(splat.sh.as_flattened(), &[1, n, bases, 3]),
        }
    }
}

impl Gaussians {
    /// Returns the Gaussians of `splat`, [1, N, ..], float32 on the host, with means relative to the splat's origin.
    pub fn from_splat(splat: &Splat) -> Self {
        let active = RawGaussians::from_splat(splat).activate();
        let scales = match &splat.linear_scales {
            Some(scales) => Tensor::from_slice(scales.as_flattened()).view_as(&active.scales),
            None => active.scales,
        };
        Gaussians { scales, antialiased: splat.antialiased, ..active }
    }

    /// Returns the splat of one scene, whose means are relative to `origin`, without gradients. Gaussians whose quaternion has length 0
    /// are left out, and counted in [`Splat::warnings`].
    ///
    /// # Errors
    /// Returns an error if there isn't exactly one scene.
    pub fn to_splat(&self, origin: DVec3) -> Result<Splat> {
        let scenes = self.means.size()[0];
        if scenes != 1 {
            return Err(Error::request(format!("a splat holds one scene, found {scenes}")));
        }
        let on_host = self.map(|t| t.detach().to_device(Device::Cpu).to_kind(Kind::Float));
        let raw = RawGaussians::from_gaussians(&on_host);
        let splat = Splat::new(
            raw.sh.size()[2].isqrt() as usize - 1,
            rows(&raw.means)?,
            rows(&raw.log_scales)?,
            rows(&raw.quaternions)?,
            rows::<1>(&raw.opacity_logits)?.into_flattened(),
            rows(&raw.sh)?,
        )?;
        let linear_scales = Some(rows(&on_host.scales)?);
        Ok(Splat { origin, linear_scales, antialiased: self.antialiased, ..splat }
            .without_missing_rotations("the splat"))
    }
}

/// Returns the numbers of a tensor in rows of N.
fn rows<const N: usize>(tensor: &Tensor) -> Result<Vec<[f32; N]>> {
    Ok(Vec::<f32>::try_from(tensor.flatten(0, -1)).map_err(Error::external)?.as_chunks().0.to_vec())
}

/// Returns the local frame in which a splat is rendered (spec 2.5).
pub fn splat_frame(splat: &Splat) -> LocalFrame {
    Gaussians::from_splat(splat).local_frame(splat.origin)
}

impl Gaussians {
    /// Returns the local frame of one scene, whose means are relative to `origin`. The local origin is the median of the means along
    /// each axis. 16 local units are the median of a mean's distance from it plus the Gaussian's largest scale. If the Gaussians have
    /// no extent, or there are none, a local unit is a world unit.
    ///
    /// # Panics
    /// Panics if there is more than one scene.
    pub fn local_frame(&self, origin: DVec3) -> LocalFrame {
        let means: Vec<DVec3> = values(&self.means).chunks_exact(3).map(DVec3::from_slice).collect();
        let largest = values(&self.scales.amax([-1i64].as_slice(), false));
        let about_zero = LocalFrame::from_spheres(&means, &largest);
        LocalFrame { origin: origin + about_zero.origin, ..about_zero }
    }

    /// Converts the Gaussians to local coordinates, keeping the dtype. Their means are relative to `origin`, in world units. The
    /// conversion is computed in float64.
    pub fn to_local(&self, frame: &LocalFrame, origin: DVec3) -> Self {
        self.resized(origin - frame.origin, 1. / frame.scale)
    }

    /// Converts local Gaussians to world units, keeping the dtype. The resulting means are relative to the origin of `frame`.
    pub fn to_world_units(&self, frame: &LocalFrame) -> Self {
        self.resized(DVec3::ZERO, frame.scale)
    }

    /// Returns the Gaussians translated by `by` and then scaled about zero by `factor`.
    fn resized(&self, by: DVec3, factor: f64) -> Self {
        let double = |t: &Tensor| t.to_kind(Kind::Double);
        let by = Tensor::from_slice(&by.to_array()).to_device(self.means.device());
        let means = ((double(&self.means) + by) * factor).to_kind(self.means.kind());
        let scales = (double(&self.scales) * factor).to_kind(self.scales.kind());
        Gaussians { means, scales, ..self.map(Tensor::shallow_clone) }
    }
}

fn values(tensor: &Tensor) -> Vec<f64> {
    Vec::try_from(tensor.detach().to_kind(Kind::Double).flatten(0, -1)).expect("numbers of one scene")
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
        let _guard = num_threads::lock_exclusive();
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

    fn gaussians(factor: f32) -> Gaussians {
        let numbers = |n: i64, from: f64, to: f64| {
            Tensor::linspace(from, to, n, (Kind::Double, Device::Cpu)).sin().to_kind(Kind::Float)
        };
        Gaussians {
            means: numbers(60, 0., 17.).view([1, 20, 3]) * f64::from(factor),
            scales: (numbers(60, 1., 50.).view([1, 20, 3]) + 1.1) * f64::from(factor),
            quaternions: numbers(80, 0., 30.).view([1, 20, 4]),
            opacities: numbers(20, 0., 1.).view([1, 20]),
            sh: numbers(60, 0., 9.).view([1, 20, 1, 3]),
            antialiased: false,
        }
    }

    #[test]
    fn scaling_by_a_power_of_two_keeps_the_local_bits() {
        let splat = gaussians(1.);
        let frame = splat.local_frame(DVec3::ZERO);
        for exponent in [-40, -20, -3, 5, 20, 40] {
            let factor = f64::from(exponent).exp2();
            let scaled = gaussians(factor as f32);
            let other = scaled.local_frame(DVec3::ZERO);
            assert_eq!((other.origin, other.scale), (frame.origin * factor, frame.scale * factor));
            let (a, b) = (splat.to_local(&frame, DVec3::ZERO), scaled.to_local(&other, DVec3::ZERO));
            assert!(a.means.equal(&b.means) && a.scales.equal(&b.scales), "2^{exponent}");
        }
    }

    #[test]
    fn local_coordinates_far_from_the_origin_are_exact() {
        let (splat, offset) = (gaussians(1.), DVec3::new(5e6, 4e5, -1e8));
        let frame = splat.local_frame(offset);
        assert!(frame.origin.distance(offset) < 1.);
        let back = splat.to_local(&frame, offset).to_world_units(&frame);
        let moved = frame.origin - offset;
        let expected = &splat.means - Tensor::from_slice(&moved.to_array()).to_kind(Kind::Float);
        let off = |a: &Tensor, b: &Tensor| (a - b).abs().max().double_value(&[]);
        assert!(off(&back.means, &expected) < 1e-6 && off(&back.scales, &splat.scales) < 1e-6);
    }
}
