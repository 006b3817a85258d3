//! Comparison of rendered images with photos: PSNR, SSIM and LPIPS, means over views, contact sheets and comparison images.

mod contact_sheet;
mod lpips;
mod psnr_ssim;

pub use contact_sheet::{ContactSheet, comparison_image};
pub use lpips::{PeakMemory, Perceptual};
pub use psnr_ssim::{color_corrected_psnr, masked_psnr, masked_ssim, psnr};

use crate::data::{Pixels, View};
use crate::error::{Error, Result};
use crate::io::Splat;
use crate::loss::psnr_of_mse;
use crate::render::{SplatRenderer, render_views};
use crate::scene::{Camera, Gaussians};
use psnr_ssim::{SSIM_WINDOW, mean_weight, squared_error};
use serde::{Deserialize, Serialize};
use tch::Tensor;

/// Scores of an image, or means over images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// PSNR in dB.
    pub psnr: f64,
    /// PSNR in dB after the affine color map of each image that brings it closest to its photo, as `cc_psnr` of gsplat and nerfstudio.
    pub cc_psnr: f64,
    /// Structural similarity, computed as in scikit-image.
    pub ssim: f64,
    /// LPIPS with VGG-16; `None` if the network's weights are missing or an image is too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_vgg: Option<f64>,
    /// LPIPS with AlexNet; `None` if the network's weights are missing or an image is too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_alex: Option<f64>,
    /// Fraction of the pixels that were scored, by the weights of the photo's mask; `None` if all were.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel_fraction: Option<f64>,
    /// Mean over the pixels that count of |z − z*| / (z + z*), where z is the rendered depth and z* the exact one; `None` if none is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_error: Option<f64>,
}

impl Scores {
    /// Computes the means of `scores`. An LPIPS that any of them lacks has no mean. PSNR and SSIM of none are not a number.
    pub fn mean<'a>(scores: impl IntoIterator<Item = &'a Scores>) -> Self {
        let scores: Vec<&Scores> = scores.into_iter().collect();
        let mean = |value: fn(&Scores) -> Option<f64>| {
            let values: Option<Vec<f64>> = scores.iter().map(|scores| value(scores)).collect();
            values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
        };
        let has_masks = scores.iter().any(|scores| scores.pixel_fraction.is_some());
        Scores {
            psnr: mean(|s| Some(s.psnr)).unwrap_or(f64::NAN),
            cc_psnr: mean(|s| Some(s.cc_psnr)).unwrap_or(f64::NAN),
            ssim: mean(|s| Some(s.ssim)).unwrap_or(f64::NAN),
            lpips_vgg: mean(|s| s.lpips_vgg),
            lpips_alex: mean(|s| s.lpips_alex),
            pixel_fraction: mean(|s| Some(s.pixel_fraction.unwrap_or(1.))).filter(|_| has_masks),
            depth_error: mean(|s| s.depth_error),
        }
    }
}

/// Scores of one view.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ViewScore {
    /// Name of the photo in the capture.
    pub image: String,
    /// Scores of the image.
    #[serde(flatten)]
    pub scores: Scores,
}

/// Scores of a capture: means over its views, and the scores of each view.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CaptureScores {
    /// Name of the capture.
    pub scene: String,
    /// Means over the views.
    #[serde(flatten)]
    pub mean: Scores,
    /// Number of Gaussians; `None` if no splat was scored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaussians: Option<i64>,
    /// Scores of each view.
    pub views: Vec<ViewScore>,
}

impl CaptureScores {
    /// Computes the means over `views`, at least one.
    pub fn from_views(scene: &str, views: Vec<ViewScore>, gaussians: Option<i64>) -> Self {
        let mean = Scores::mean(views.iter().map(|view| &view.scores));
        CaptureScores { scene: scene.to_string(), mean, gaussians, views }
    }
}

/// Scores an image `[3, H, W]` against the pixels of a view of the same size that count, with LPIPS if `perceptual` is given.
///
/// # Errors
/// Fails if the image differs in size from the view or is too small for SSIM, if no pixel of the view counts, or if weights of LPIPS
/// are broken.
pub fn score_view(image: &Tensor, view: &View, perceptual: Option<&Perceptual>) -> Result<ViewScore> {
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
    let cc_psnr = color_corrected_psnr(image, &photo, mask.as_ref());
    let mut scores =
        Scores { psnr, cc_psnr, ssim, lpips_vgg: None, lpips_alex: None, pixel_fraction, depth_error: None };
    if let Some(perceptual) = perceptual {
        perceptual.add_to(&mut scores, image, view)?;
    }
    Ok(ViewScore { image: view.name.clone(), scores })
}

/// Scores a splat on `views`, one at a time, with LPIPS if `perceptual` is given. `should_continue` is called before each view with the
/// number of finished views. If it returns `false`, the means are over the finished views. Returns `None` if no view is finished.
///
/// # Errors
/// Fails if the rasterizer fails.
pub fn score_views(
    scene: &str,
    gaussians: &Gaussians,
    views: &[View],
    perceptual: Option<&Perceptual>,
    mut should_continue: impl FnMut(usize) -> bool,
) -> Result<Option<CaptureScores>> {
    let mut done = vec![];
    for view in views {
        if !should_continue(done.len()) {
            break;
        }
        let image = render_views(gaussians, &[view.camera])?.remove(0).rgb;
        done.push(score_view(&image, view, perceptual)?);
    }
    Ok((!done.is_empty()).then(|| CaptureScores::from_views(scene, done, Some(gaussians.count()))))
}

/// Returns the PSNR in dB between the renders of `copy` and of `original` from `cameras`, from the mean squared error over all pixels: the
/// loss of quality when a splat is converted to another format. Returns `None` if the renders are identical.
///
/// # Errors
/// Fails if rendering fails.
pub fn psnr_between(original: &Splat, copy: &Splat, cameras: &[Camera]) -> Result<Option<f64>> {
    let gaussians = Gaussians::from_splat(original);
    let frame = gaussians.local_frame(original.origin);
    let original = SplatRenderer::new(&gaussians, original.origin, frame);
    let copy = SplatRenderer::new(&Gaussians::from_splat(copy), copy.origin, frame);
    let (mut sum, mut numbers) = (0., 0);
    for camera in cameras {
        let render = |splat: &SplatRenderer| -> Result<_> {
            Ok(splat.render(std::slice::from_ref(camera))?.remove(0).rgb)
        };
        let original = render(&original)?;
        sum += squared_error(&original, &render(&copy)?, None);
        numbers += original.numel();
    }
    Ok((sum != 0.).then(|| psnr_of_mse(sum / numbers as f64)))
}
