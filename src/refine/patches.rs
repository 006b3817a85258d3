//! Scores on a few pixels, cheap enough to compute during the optimization.

use super::corrections::Corrections;
use crate::data::{Pixels, View};
use crate::error::Result;
use crate::loss::{masked_mse, masked_photometric, psnr_of_mse, ssim};
use crate::render::render_views;
use crate::scene::{Camera, Gaussians};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

/// Maximum number of views with a scored patch.
const MAX_VIEWS: usize = 8;
/// Side of a patch in pixels.
const SIDE: u32 = 96;
/// Steps of the patch positions along x and y from view to view, as fractions of the free range, so that patches spread over the whole
/// image (Roberts 2018, "R2").
const STEPS: [f64; 2] = [0.754_877_666, 0.569_840_291];

/// Patches of some views, each with a camera that renders only the patch; the pixels are those of the whole image.
#[derive(Debug)]
pub struct Patches {
    /// Indices of the views that the patches are cut from.
    indices: Vec<usize>,
    views: Vec<View>,
}

/// Mean scores over patches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PatchScores {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM, as scikit-image computes it.
    pub ssim: f64,
}

impl Patches {
    /// Cuts a patch out of each of `views`, or, if there are more than `MAX_VIEWS`, of some that are spread over all.
    pub fn from_views(views: &[View]) -> Self {
        let every = views.len().div_ceil(MAX_VIEWS).max(1);
        let indices: Vec<usize> = (0..views.len()).step_by(every).collect();
        let place = |number: usize| STEPS.map(|step| (0.5 + step * number as f64).fract());
        let patches = indices.iter().enumerate().map(|(number, &index)| patch(&views[index], place(number)));
        Patches { views: patches.collect(), indices }
    }

    /// Returns the patches with the learned corrections of their photos applied.
    pub(super) fn corrected(&self, corrections: &Corrections) -> Self {
        let views = self.indices.iter().zip(&self.views).map(|(&index, view)| corrections.apply(index, view));
        Patches { indices: self.indices.clone(), views: views.collect() }
    }

    /// Scores a splat; returns `None` if there are no views.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score(&self, gaussians: &Gaussians) -> Result<Option<PatchScores>> {
        let cameras: Vec<Camera> = self.views.iter().map(|view| view.camera).collect();
        let pictures = render_views(gaussians, &cameras)?;
        let exact = |t: &Tensor| t.to_device(Device::Cpu).to_kind(Kind::Double).clamp(0., 1.);
        let scores = pictures.iter().zip(&self.views).map(|(picture, view)| {
            let (picture, photo) = (exact(&picture.rgb), exact(&view.image.to_float()));
            let (mse, ssim) = match &view.mask {
                Some(mask) => {
                    let mask = exact(&mask.to_float());
                    (masked_mse(&picture, &photo, &mask), masked_photometric(&picture, &photo, &mask, 0., 1.))
                }
                None => ((&picture - &photo).square().mean(Kind::Double), ssim(&picture, &photo)),
            };
            [psnr_of_mse(mse.double_value(&[])), ssim.double_value(&[])]
        });
        let count = self.views.len() as f64;
        let sums = scores.reduce(|a, b| [a[0] + b[0], a[1] + b[1]]);
        Ok(sums.map(|[psnr, ssim]| PatchScores { psnr: psnr / count, ssim: ssim / count }))
    }
}

/// Cuts out the patch at the relative position `place`, from 0 to 1 along x and y. If the view has a mask, its middle is the pixel at
/// `place[1]` of the list of those that count, or as near to it as the image allows.
fn patch(view: &View, place: [f64; 2]) -> View {
    let Camera { width, height, intrinsics, .. } = view.camera;
    let [wide, high] = [width, height].map(|side| side.min(SIDE));
    let free = [width - wide, height - high];
    let counted = view.mask.as_ref().map(|mask| mask.to_float().select(0, 0).gt(0.).nonzero());
    let [left, top] = match counted.filter(|counted| counted.numel() > 0) {
        Some(counted) => {
            let pixel = counted.get((counted.size()[0] as f64 * place[1]).floor() as i64);
            let corner = |axis: i64, side: u32| pixel.int64_value(&[axis]) - i64::from(side / 2);
            [corner(1, wide).clamp(0, free[0].into()), corner(0, high).clamp(0, free[1].into())]
        }
        None => [0, 1].map(|axis| (f64::from(free[axis]) * place[axis]).floor() as i64),
    };
    let cut = |pixels: &Pixels| {
        pixels.map(|image| image.narrow(1, top, high.into()).narrow(2, left, wide.into()).contiguous())
    };
    let intrinsics = intrinsics.cropped(left as f64, top as f64);
    let camera = Camera { intrinsics, width: wide, height: high, ..view.camera };
    View { name: view.name.clone(), image: cut(&view.image), mask: view.mask.as_ref().map(cut), camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::DMat4;

    /// An image that is scored against itself, patch by patch, has no error: patches have the same pixels as the whole image.
    #[test]
    fn patches_are_parts_of_the_picture() {
        let options = (Kind::Float, Device::Cpu);
        let wave = |n: i64| (Tensor::arange(n, options) * 7.3).sin();
        let gaussians = Gaussians {
            means: Tensor::stack(&[wave(200), wave(200).flip([0]), wave(200).roll([7], [0]) * 0.5 + 3.], 1)
                .unsqueeze(0),
            scales: Tensor::full([1, 200, 3], 0.05, options),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).repeat([1, 200, 1]),
            opacities: Tensor::full([1, 200], 0.7, options),
            sh: wave(600).view([1, 200, 1, 3]),
        };
        let intrinsics = Intrinsics { fx: 200., fy: 190., cx: 100., cy: 80. };
        let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width: 210, height: 170 };
        let image = render_views(&gaussians, &[camera]).unwrap().remove(0).rgb;
        let view = View { name: String::new(), image: image.into(), mask: None, camera };
        let views: Vec<View> = (0..20).map(|_| view.shallow_clone()).collect();
        let patches = Patches::from_views(&views);
        assert_eq!(patches.views.len(), 7);
        assert!(patches.views.iter().all(|patch| patch.image.size() == [3, 96, 96]));
        let scores = patches.score(&gaussians).unwrap().unwrap();
        assert!(scores.psnr > 90. && scores.ssim > 0.9999, "{scores:?}");
        assert!(Patches::from_views(&[]).score(&gaussians).unwrap().is_none());
    }
}
