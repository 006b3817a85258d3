//! Conversions between Gaussians, which are tensors, and splats, which are plain arrays as files hold them.

use super::{Gaussians, LocalFrame, RawGaussians};
use crate::error::{Error, Result};
use glam::DVec3;
use globalsplat_splat_file::Splat;
use tch::{Device, Kind, Tensor};

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
    Ok(Vec::<f32>::try_from(tensor.flatten(0, -1))?.as_chunks().0.to_vec())
}

/// Returns the local frame in which a splat is rendered (spec 2.5).
pub fn splat_frame(splat: &Splat) -> LocalFrame {
    Gaussians::from_splat(splat).local_frame(splat.origin)
}
