//! Scores on a few views, cheap enough to compute during the optimization.

use super::corrections::Corrections;
use crate::data::View;
use crate::error::Result;
use crate::metrics::{CaptureScores, Scores, score_views};
use crate::scene::Gaussians;
use serde::Serialize;

/// Maximum number of views in a sample.
const MAX_VIEWS: usize = 8;
/// Minimum number of views in a small sample, if there are as many.
const MIN_VIEWS: usize = 2;
/// Maximum number of pixels of all views in a small sample, if there are more than [`MIN_VIEWS`].
const MAX_PIXELS: u64 = 1_200_000;

/// Evenly spread views of all. They are scored as a whole: a part of an image has other borders, near which large Gaussians are projected
/// differently.
#[derive(Debug)]
pub(super) struct ViewSample {
    /// Indices among all views.
    indices: Vec<usize>,
    views: Vec<View>,
}

/// Mean scores of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SampleScores {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM, as scikit-image computes it.
    pub ssim: f64,
}

impl ViewSample {
    /// Chooses up to eight of `views`, fewer if they are large, to be scored several times.
    pub fn small(views: &[View]) -> Self {
        let pixels = |view: &View| u64::from(view.camera.width) * u64::from(view.camera.height);
        let largest = views.iter().map(pixels).max().unwrap_or(1);
        ViewSample::spread(views, ((MAX_PIXELS / largest) as usize).clamp(MIN_VIEWS, MAX_VIEWS))
    }

    /// Chooses up to eight of `views`.
    pub fn large(views: &[View]) -> Self {
        ViewSample::spread(views, MAX_VIEWS)
    }

    fn spread(views: &[View], count: usize) -> Self {
        let every = views.len().div_ceil(count).max(1);
        let indices: Vec<usize> = (0..views.len()).step_by(every).collect();
        let views = indices.iter().map(|&index| views[index].shallow_clone());
        ViewSample { views: views.collect(), indices }
    }

    /// Returns the number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Returns the sample with the learned corrections of its photos applied.
    pub(super) fn corrected(&self, corrections: &Corrections) -> Self {
        let views = self.indices.iter().zip(&self.views).map(|(&index, view)| corrections.apply(index, view));
        ViewSample { indices: self.indices.clone(), views: views.collect() }
    }

    /// Scores a splat; returns `None` if there are no views.
    ///
    /// # Errors
    /// Fails if rendering fails.
    pub fn score(&self, gaussians: &Gaussians) -> Result<Option<SampleScores>> {
        let scores = score_views("sample", gaussians, &self.views, None, |_| true)?;
        Ok(scores.map(|scores| SampleScores { psnr: scores.mean.psnr, ssim: scores.mean.ssim }))
    }

    /// Returns the mean scores of the sample, given the `scores` of all views that it was chosen from.
    pub fn select_scores(&self, scores: &CaptureScores) -> SampleScores {
        let Scores { psnr, ssim, .. } =
            Scores::mean(self.indices.iter().map(|&index| &scores.views[index].scores));
        SampleScores { psnr, ssim }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::render_views;
    use crate::scene::{Camera, Intrinsics};
    use glam::DMat4;
    use tch::{Device, Kind, Tensor};

    #[test]
    fn a_sample_has_few_pixels_and_its_scores_are_those_of_the_views() {
        let gaussians = Gaussians {
            means: Tensor::from_slice(&[0f32, 0., 3.]).view([1, 1, 3]),
            scales: Tensor::full([1, 1, 3], 0.5, (Kind::Float, Device::Cpu)),
            quaternions: Tensor::from_slice(&[1f32, 0., 0., 0.]).view([1, 1, 4]),
            opacities: Tensor::full([1, 1], 0.7, (Kind::Float, Device::Cpu)),
            sh: Tensor::ones([1, 1, 1, 3], (Kind::Float, Device::Cpu)),
            antialiased: false,
        };
        let views = |width: u32, height: u32, count: usize| -> Vec<View> {
            let intrinsics = Intrinsics { fx: 200., fy: 190., cx: 100., cy: 80. };
            let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
            let image = render_views(&gaussians, &[camera]).unwrap().remove(0).rgb;
            let view = |index: usize| {
                let image = (&image + 0.01 + 0.001 * index as f64).into();
                View { name: String::new(), image, mask: None, camera }
            };
            (0..count).map(view).collect()
        };
        let all = views(210, 170, 20);
        let small = ViewSample::small(&all);
        assert_eq!(small.indices, [0, 3, 6, 9, 12, 15, 18]);
        let large = views(1000, 600, 9);
        assert_eq!(ViewSample::small(&large).indices, [0, 5]);
        assert_eq!(ViewSample::large(&large).indices, [0, 2, 4, 6, 8]);
        let scores = small.score(&gaussians).unwrap().unwrap();
        let of_all = score_views("", &gaussians, &all, None, |_| true).unwrap().unwrap();
        assert!(
            (of_all.views[0].scores.psnr - 40.).abs() < 0.01 && of_all.views[0].scores.ssim > 0.9,
            "{of_all:?}"
        );
        let selected = small.select_scores(&of_all);
        assert!((scores.psnr - selected.psnr).abs() < 1e-9 && (scores.ssim - selected.ssim).abs() < 1e-9);
        assert!((scores.psnr - of_all.mean.psnr).abs() > 0.01, "{scores:?} {}", of_all.mean.psnr);
        assert!(ViewSample::small(&[]).score(&gaussians).unwrap().is_none());
    }
}
