//! How much each Gaussian contributes to images.

use super::{Cameras, default_eps2d, render};
use crate::error::Result;
use crate::scene::{Camera, Gaussians, SH_C0};
use tch::{Tensor, with_grad};

/// Returns the contribution of each Gaussian to the images of `cameras`, in pixels: the sum over all pixels of its weight α·T, its opacity
/// there times the transmittance in front of it. `gaussians` are of one scene, in the cameras' local frame (spec 2.5).
///
/// The weight of a Gaussian in a pixel is the derivative of the pixel's color with respect to the Gaussian's color.
///
/// # Errors
/// Fails like [`render`].
pub fn contributions(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<f32>> {
    let mut total = gaussians.opacities.zeros_like();
    for camera in cameras {
        total += image_contributions(gaussians, &Cameras::single(camera))?;
    }
    Ok(Vec::try_from(total.view([-1]))?)
}

/// Returns the indices of the `count` Gaussians, or of all if there are fewer, with the largest `contributions`, the largest first.
pub(crate) fn largest_contributions(contributions: &[f32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..contributions.len()).collect();
    order.sort_by(|&a, &b| contributions[b].total_cmp(&contributions[a]));
    order.truncate(count);
    order
}

/// Returns the contribution of each Gaussian to the images of `cameras` together, [B, N], as [`contributions`] does.
///
/// # Errors
/// Fails like [`render`].
pub(crate) fn image_contributions(gaussians: &Gaussians, cameras: &Cameras) -> Result<Tensor> {
    let (b, n) = gaussians.opacities.size2()?;
    let colors = Tensor::zeros([b, n, 1, 3], (gaussians.means.kind(), gaussians.means.device()));
    let colors = colors.set_requires_grad(true);
    let grey = Gaussians { sh: colors.shallow_clone(), ..gaussians.map(Tensor::detach) };
    let red = with_grad(|| -> Result<Tensor> {
        let image = render(&grey, cameras, default_eps2d(gaussians))?;
        Ok(image.rgb.select(2, 0).sum(None))
    })?;
    Ok(Tensor::run_backward(&[red], &[colors], false, false)[0].select(3, 0).select(2, 0) / SH_C0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::DMat4;
    use tch::{Device, Kind};

    /// The contributions add up to the accumulated opacity, and a Gaussian behind an opaque one contributes little.
    #[test]
    fn contributions_add_up_to_alpha() {
        let options = (Kind::Float, Device::Cpu);
        let gaussians = Gaussians {
            means: Tensor::from_slice(&[0f32, 0., 2., 0., 0., 4., 0., 0., -2.]).view([1, 3, 3]),
            scales: Tensor::from_slice(&[0.3f32, 0.3, 0.3]).view([1, 3, 1]).repeat([1, 1, 3]),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).repeat([1, 3, 1]),
            opacities: Tensor::from_slice(&[0.99f32, 0.9, 0.9]).view([1, 3]),
            sh: Tensor::full([1, 3, 4, 3], -9., options), // black
            antialiased: false,
        };
        let intrinsics = Intrinsics { fx: 30., fy: 30., cx: 16., cy: 16. };
        let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width: 32, height: 32 };
        let found = contributions(&gaussians, &[camera, camera]).unwrap();
        let image = render(&gaussians, &Cameras::single(&camera), default_eps2d(&gaussians)).unwrap();
        let alpha = 2. * image.alpha.sum(Kind::Double).double_value(&[]);
        assert!((f64::from(found.iter().sum::<f32>()) - alpha).abs() < 1e-3 * alpha, "{found:?}, {alpha}");
        assert!(found[0] > 5. * found[1] && found[1] > 0. && found[2] == 0., "{found:?}");
    }
}
