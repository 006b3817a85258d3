//! Scores of rendered images against photos, view by view.

use super::metrics::{SSIM_WINDOW, masked_psnr, masked_ssim, mean_weight};
use super::photo_source::LazyPhotos;
use crate::data::{Pixels, View};
use crate::error::{Error, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use tch::Tensor;

/// Scores of one view.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ViewScore {
    /// Name of the photo in the capture.
    pub image: String,
    /// PSNR in dB.
    pub psnr: f64,
    /// Structural similarity, computed as in scikit-image.
    pub ssim: f64,
    /// LPIPS with VGG-16; `None` if the network's weights are missing or the view is too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// LPIPS with AlexNet; `None` if the network's weights are missing or the view is too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Fraction of the pixels that were scored, by the weights of the photo's mask; `None` if all were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixel_fraction: Option<f64>,
}

/// Scores of a capture: means over its views, and the scores of each view.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CaptureScores {
    /// Name of the capture.
    pub scene: String,
    /// Mean PSNR over the views, in dB.
    pub psnr: f64,
    /// Mean structural similarity over the views.
    pub ssim: f64,
    /// Mean LPIPS with VGG-16 over the views; `None` if a view lacks it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// Mean LPIPS with AlexNet over the views; `None` if a view lacks it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Mean fraction of the pixels of a view that were scored; `None` if all were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixel_fraction: Option<f64>,
    /// Number of Gaussians; `None` if no splat was scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<i64>,
    /// Scores of each view.
    pub views: Vec<ViewScore>,
}

/// Scores images `[3, H, W]` against views of the same sizes, without LPIPS, which [`super::Perceptual`] adds.
///
/// # Errors
/// Fails if an image differs in size from its view or is too small for SSIM.
pub fn score(
    scene: &str,
    images: &[Tensor],
    ground_truth: &[View],
    gaussians: Option<i64>,
) -> Result<CaptureScores> {
    let scores = images.iter().zip(ground_truth).map(|(image, view)| score_view(image, view));
    Ok(CaptureScores::from_views(scene, scores.collect::<Result<_>>()?, gaussians))
}

/// Scores an image `[3, H, W]` against the pixels of a view of the same size that count, without LPIPS.
///
/// # Errors
/// Fails if the image differs in size from the view or is too small for SSIM, or if no pixel of the view counts.
pub(super) fn score_view(image: &Tensor, view: &View) -> Result<ViewScore> {
    let (found, expected) = (image.size(), view.image.size());
    if found != expected {
        let why = format!("the image for {} has shape {found:?}, expected {expected:?}", view.name);
        return Err(Error::request(why));
    }
    if found[1].min(found[2]) < SSIM_WINDOW {
        let (height, width) = (found[1], found[2]);
        return Err(Error::request(format!(
            "the image for {} is {width}×{height} pixels, expected sides of {SSIM_WINDOW} or more, as SSIM needs",
            view.name
        )));
    }
    let mask = view.mask.as_ref().map(Pixels::to_float);
    let pixel_fraction = mask.as_ref().map(mean_weight);
    if pixel_fraction == Some(0.) {
        let why = format!("{} is masked out as a whole, expected pixels that can be scored", view.name);
        return Err(Error::request(why));
    }
    let photo = view.image.to_float();
    let psnr = masked_psnr(image, &photo, mask.as_ref());
    let ssim = masked_ssim(image, &photo, mask.as_ref());
    let image = view.name.clone();
    Ok(ViewScore { image, psnr, ssim, lpips_vgg: None, lpips_alex: None, pixel_fraction })
}

impl CaptureScores {
    /// Computes the means over `views`, at least one.
    pub(super) fn from_views(scene: &str, views: Vec<ViewScore>, gaussians: Option<i64>) -> Self {
        let mean = |value: fn(&ViewScore) -> Option<f64>| {
            let values: Option<Vec<f64>> = views.iter().map(value).collect();
            values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
        };
        let has_masks = views.iter().any(|view| view.pixel_fraction.is_some());
        CaptureScores {
            scene: scene.to_string(),
            psnr: mean(|view| Some(view.psnr)).unwrap_or(f64::NAN),
            ssim: mean(|view| Some(view.ssim)).unwrap_or(f64::NAN),
            lpips_vgg: mean(|view| view.lpips_vgg),
            lpips_alex: mean(|view| view.lpips_alex),
            pixel_fraction: mean(|view| Some(view.pixel_fraction.unwrap_or(1.))).filter(|_| has_masks),
            gaussians,
            views,
        }
    }
}

/// Scores of two baselines that only copy context photos, for the target views of a scene.
#[derive(Debug, Clone)]
pub struct Baselines {
    /// Scores of the nearest context photo.
    pub nearest_photo: CaptureScores,
    /// Scores of the mean of all context photos.
    pub mean_photo: CaptureScores,
}

impl Baselines {
    /// Scores the baselines on the targets of a scene. All photos have the same size, and there is at least one context photo.
    ///
    /// # Errors
    /// Fails if photos differ in size or can't be read.
    pub fn compute(scene: &str, context: &LazyPhotos, target: &LazyPhotos) -> Result<Self> {
        let mut sum = context.load(0)?.image.to_float().copy();
        for i in 1..context.len() {
            sum += context.load(i)?.image.to_float();
        }
        let mean = sum / context.len() as f64;
        let mut means = vec![];
        for i in 0..target.len() {
            let view = target.load(i)?;
            if !view.is_masked_out() {
                means.push(score_view(&mean, &view)?);
            }
        }
        Ok(Baselines {
            nearest_photo: nearest_context_baseline(scene, context, target)?,
            mean_photo: CaptureScores::from_views(scene, means, None),
        })
    }
}

/// Scores, for every target view, the context photo whose camera centre is nearest.
pub(super) fn nearest_context_baseline(
    scene: &str,
    context: &LazyPhotos,
    target: &LazyPhotos,
) -> Result<CaptureScores> {
    let centres = |photos: &LazyPhotos| -> Vec<DVec3> {
        photos.poses().iter().map(|pose| pose.w_axis.truncate()).collect()
    };
    let shown = centres(context);
    let mut scores = vec![];
    for (i, centre) in centres(target).into_iter().enumerate() {
        let distance = |&photo: &usize| shown[photo].distance(centre);
        let nearest = (0..shown.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let nearest = context.load(nearest.expect("a context view"))?;
        let view = target.load(i)?;
        if !view.is_masked_out() {
            scores.push(score_view(&nearest.image.to_float(), &view)?);
        }
    }
    Ok(CaptureScores::from_views(scene, scores, None))
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
            image: Tensor::full([3, 16, 16], grey, (Kind::Float, Device::Cpu)).into(),
            mask: None,
            camera: Camera { intrinsics, c2w: DMat4::from_translation(DVec3::X * at), width: 8, height: 8 },
        };
        let photos = LazyPhotos::Loaded;
        let (context, target) = (photos(vec![view(0., 0.2), view(1., 0.6)]), photos(vec![view(0.7, 0.7)]));
        let baselines = Baselines::compute("", &context, &target).unwrap();
        assert!((baselines.nearest_photo.psnr - 20.).abs() < 1e-4, "0.1 apart");
        assert!((baselines.mean_photo.psnr - 20. * (1f64 / 0.3).log10()).abs() < 1e-4, "0.3 apart");
    }
}
