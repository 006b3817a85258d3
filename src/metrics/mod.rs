//! Comparison of rendered images with photos: PSNR, SSIM and LPIPS, means over views, contact sheets and comparison images.

mod contact_sheet;
mod lpips;
mod psnr_ssim;
mod scores;

pub use contact_sheet::{ContactSheet, comparison_image};
pub use lpips::Perceptual;
pub use psnr_ssim::{masked_psnr, masked_ssim, psnr, ssim};
pub use scores::{CaptureScores, ViewScore, psnr_between, score_view, score_views};

use serde::{Deserialize, Serialize};

/// Scores of an image, or means over images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// PSNR in dB.
    pub psnr: f64,
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
            ssim: mean(|s| Some(s.ssim)).unwrap_or(f64::NAN),
            lpips_vgg: mean(|s| s.lpips_vgg),
            lpips_alex: mean(|s| s.lpips_alex),
            pixel_fraction: mean(|s| Some(s.pixel_fraction.unwrap_or(1.))).filter(|_| has_masks),
        }
    }
}
