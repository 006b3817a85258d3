//! Pixel part of the rendering loss: ‖I − Î‖² per element (spec 7.2).

use super::mask::mean_weight;
use tch::{Kind, Tensor};

/// Computes the mean squared error over all elements; a scalar.
pub fn mse(rendered: &Tensor, ground_truth: &Tensor) -> Tensor {
    (rendered - ground_truth).square().mean(None::<Kind>)
}

/// Computes the mean squared error weighted by `mask` [.., 1, H, W], over all elements of images [.., C, H, W] (spec 7.9); a scalar.
pub fn masked_mse(rendered: &Tensor, ground_truth: &Tensor, mask: &Tensor) -> Tensor {
    ((rendered - ground_truth).square() * mask).mean(None::<Kind>) / mean_weight(mask)
}

/// Minimum error in [`psnr_of_mse`], so that equal images have a finite PSNR: 100 dB.
const MIN_MSE: f64 = 1e-10;

/// Computes the peak signal-to-noise ratio in dB of images in [0, 1] from their mean squared error. NaN gives NaN.
pub fn psnr_of_mse(mse: f64) -> f64 {
    // f64::max would replace NaN by the minimum.
    let mse = if mse < MIN_MSE { MIN_MSE } else { mse };
    -10. * mse.log10()
}
