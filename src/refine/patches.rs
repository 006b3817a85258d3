//! Scores on few pixels, for a look on the way that costs next to nothing.

use super::corrections::Corrections;
use crate::data::View;
use crate::error::Result;
use crate::loss::{psnr_of_mse, ssim};
use crate::render::render_views;
use crate::scene::{Camera, Gaussians};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

/// Views of which a patch is scored, at most.
const MAX_VIEWS: usize = 8;
/// Side of a patch, pixels.
const SIDE: u32 = 96;
/// Where patches lie, as multiples of the part of a picture that is free: all over it, from view to view (Roberts 2018, "R2").
const STEPS: [f64; 2] = [0.754_877_666, 0.569_840_291];

/// Patches of some views, each with the camera that shows it alone: its pixels are those of the whole picture.
#[derive(Debug)]
pub struct Patches {
    /// Which of all views they are of.
    indices: Vec<usize>,
    views: Vec<View>,
}

/// Means over patches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PatchScores {
    /// In dB.
    pub psnr: f64,
    /// As scikit-image's.
    pub ssim: f64,
}

impl Patches {
    /// Cuts a patch out of each of `views`, or of some spread over all.
    pub fn of(views: &[View]) -> Self {
        let every = views.len().div_ceil(MAX_VIEWS).max(1);
        let indices: Vec<usize> = (0..views.len()).step_by(every).collect();
        let place = |number: usize| STEPS.map(|step| (0.5 + step * number as f64).fract());
        let patches = indices.iter().enumerate().map(|(number, &index)| patch(&views[index], place(number)));
        Patches { views: patches.collect(), indices }
    }

    /// Returns the patches as the splat would have been photographed, by what was learned of the photos that they are of.
    pub(super) fn corrected(&self, corrections: &Corrections) -> Self {
        let views = self.indices.iter().zip(&self.views).map(|(&index, view)| corrections.apply(index, view));
        Patches { indices: self.indices.clone(), views: views.collect() }
    }

    /// Scores a splat; none where there are no views.
    ///
    /// # Errors
    /// What the rasterizer refuses.
    pub fn score(&self, gaussians: &Gaussians) -> Result<Option<PatchScores>> {
        let cameras: Vec<Camera> = self.views.iter().map(|view| view.camera).collect();
        let pictures = render_views(gaussians, &cameras)?;
        let exact = |t: &Tensor| t.to_device(Device::Cpu).to_kind(Kind::Double).clamp(0., 1.);
        let scores = pictures.iter().zip(&self.views).map(|(picture, view)| {
            let (picture, photo) = (exact(&picture.rgb), exact(&view.image));
            let mse = (&picture - &photo).square().mean(Kind::Double).double_value(&[]);
            [psnr_of_mse(mse), ssim(&picture, &photo).double_value(&[])]
        });
        let count = self.views.len() as f64;
        let sums = scores.reduce(|a, b| [a[0] + b[0], a[1] + b[1]]);
        Ok(sums.map(|[psnr, ssim]| PatchScores { psnr: psnr / count, ssim: ssim / count }))
    }
}

/// The patch that lies at `place`, from 0 to 1 along x and y.
fn patch(view: &View, place: [f64; 2]) -> View {
    let Camera { width, height, intrinsics, .. } = view.camera;
    let [wide, high] = [width, height].map(|side| side.min(SIDE));
    let [left, top] = [(width - wide, place[0]), (height - high, place[1])]
        .map(|(free, place)| (f64::from(free) * place).floor() as i64);
    let image = view.image.narrow(1, top, high.into()).narrow(2, left, wide.into()).contiguous();
    let intrinsics = intrinsics.cropped(left as f64, top as f64);
    let camera = Camera { intrinsics, width: wide, height: high, ..view.camera };
    View { name: view.name.clone(), image, camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::DMat4;

    /// A picture that is scored against itself, patch by patch, has no error: patches show the pixels that the whole shows.
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
        let view = View { name: String::new(), image, camera };
        let views: Vec<View> = (0..20).map(|_| view.shallow_clone()).collect();
        let patches = Patches::of(&views);
        assert_eq!(patches.views.len(), 7);
        assert!(patches.views.iter().all(|patch| patch.image.size() == [3, 96, 96]));
        let scores = patches.score(&gaussians).unwrap().unwrap();
        assert!(scores.psnr > 90. && scores.ssim > 0.9999, "{scores:?}");
        assert!(Patches::of(&[]).score(&gaussians).unwrap().is_none());
    }
}
