//! Pictures against photos, view by view.

use super::metrics::{psnr, ssim};
use crate::data::View;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use tch::Tensor;

/// One view's scores.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ViewScore {
    /// As the capture names it.
    pub image: String,
    /// In dB.
    pub psnr: f64,
    /// As scikit-image's.
    pub ssim: f64,
    /// The distance by VGG-16's features, where its weights are at hand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// The distance by AlexNet's features, where its weights are at hand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
}

/// A capture's scores: means over its views, and each of them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CaptureScores {
    /// The capture's name.
    pub scene: String,
    /// In dB, mean over the views.
    pub psnr: f64,
    /// Mean over the views.
    pub ssim: f64,
    /// Mean over the views, where every one has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// Mean over the views, where every one has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Number of Gaussians, where a splat was scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<i64>,
    /// One by one.
    pub views: Vec<ViewScore>,
}

/// Scores pictures [3, H, W] against views of the same sizes, without LPIPS, which [`super::Perceptual`] adds.
///
/// # Errors
/// A picture of another size than its view.
pub fn score(
    scene: &str,
    pictures: &[Tensor],
    truth: &[View],
    gaussians: Option<i64>,
) -> Result<CaptureScores> {
    let mut views = vec![];
    for (picture, view) in pictures.iter().zip(truth) {
        if picture.size() != view.image.size() {
            let (found, expected) = (picture.size(), view.image.size());
            return Err(Error::Request(format!(
                "the picture for {} has shape {found:?}, expected {expected:?}",
                view.name
            )));
        }
        let (psnr, ssim) = (psnr(picture, &view.image), ssim(picture, &view.image));
        views.push(ViewScore { image: view.name.clone(), psnr, ssim, lpips_vgg: None, lpips_alex: None });
    }
    Ok(CaptureScores::of(scene, views, gaussians))
}

impl CaptureScores {
    /// Takes the means over `views`, one at least.
    pub(super) fn of(scene: &str, views: Vec<ViewScore>, gaussians: Option<i64>) -> Self {
        let mean = |value: fn(&ViewScore) -> Option<f64>| {
            let values: Option<Vec<f64>> = views.iter().map(value).collect();
            values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
        };
        CaptureScores {
            scene: scene.to_string(),
            psnr: mean(|view| Some(view.psnr)).unwrap_or(f64::NAN),
            ssim: mean(|view| Some(view.ssim)).unwrap_or(f64::NAN),
            lpips_vgg: mean(|view| view.lpips_vgg),
            lpips_alex: mean(|view| view.lpips_alex),
            gaussians,
            views,
        }
    }
}

/// What answering without looking would score for the target views of a scene.
#[derive(Debug, Clone)]
pub struct Baselines {
    /// With the context photo that was taken nearest.
    pub nearest_photo: CaptureScores,
    /// With the mean of all context photos.
    pub mean_photo: CaptureScores,
}

impl Baselines {
    /// Of a scene's views, all of one size, a context view at least.
    ///
    /// # Errors
    /// Views of different sizes.
    pub fn of(scene: &str, context: &[View], target: &[View]) -> Result<Self> {
        let images: Vec<&Tensor> = context.iter().map(|view| &view.image).collect();
        let mean = Tensor::stack(&images, 0).mean_dim(0, false, None);
        let means: Vec<Tensor> = target.iter().map(|_| mean.shallow_clone()).collect();
        Ok(Baselines {
            nearest_photo: nearest_context_baseline(scene, context, target)?,
            mean_photo: score(scene, &means, target, None)?,
        })
    }
}

/// What answering with the context photo taken nearest (by camera centre) would score for the target views.
pub(super) fn nearest_context_baseline(
    scene: &str,
    context: &[View],
    target: &[View],
) -> Result<CaptureScores> {
    let centre = |view: &View| view.camera.c2w.w_axis.truncate();
    let nearest = |target: &View| {
        let distance = |view: &&View| centre(view).distance(centre(target));
        let view = context.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("a context view");
        view.image.shallow_clone()
    };
    score(scene, &target.iter().map(nearest).collect::<Vec<_>>(), target, None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, Intrinsics};
    use glam::{DMat4, DVec3};
    use tch::{Device, Kind};

    #[test]
    fn baselines_are_the_nearest_photo_and_the_mean() {
        let intrinsics = Intrinsics { fx: 16., fy: 16., cx: 8., cy: 8. };
        let view = |at: f64, grey: f64| View {
            name: String::new(),
            image: Tensor::full([3, 16, 16], grey, (Kind::Float, Device::Cpu)),
            camera: Camera { intrinsics, c2w: DMat4::from_translation(DVec3::X * at), width: 8, height: 8 },
        };
        let baselines = Baselines::of("", &[view(0., 0.2), view(1., 0.6)], &[view(0.7, 0.7)]).unwrap();
        assert!((baselines.nearest_photo.psnr - 20.).abs() < 1e-4, "0.1 apart");
        assert!((baselines.mean_photo.psnr - 20. * (1f64 / 0.3).log10()).abs() < 1e-4, "0.3 apart");
    }
}
