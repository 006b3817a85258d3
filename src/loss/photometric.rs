//! Photometric loss: absolute differences and structural similarity (SSIM, Wang et al. 2004), computed as by scikit-image's
//! `structural_similarity` with Gaussian weights. (Spec 9.4.)

use super::mask::{fill_masked, mean_weight};
use crate::ffi::take_outputs;
use globalsplat_csrc::image_losses;
use tch::Tensor;

/// Computes `l1_weight` times the mean absolute difference plus `ssim_weight` times the mean SSIM. Both are means over images and channels;
/// the first is over all pixels, the second over pixels whose 11×11 window lies inside the image. The result is a scalar, differentiable
/// with respect to `image`; on the CPU, forward and backward take one pass each. Images are [.., H, W] in [0, 1] and of the same shape, H
/// and W at least 11; float64 if `image` is, and float32 otherwise.
///
/// # Panics
/// Panics if the shapes differ or the images are smaller.
pub fn photometric(image: &Tensor, ground_truth: &Tensor, l1_weight: f64, ssim_weight: f64) -> Tensor {
    let (image, ground_truth) = (image.as_ptr() as usize, ground_truth.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, and on success the C++ side has stored a new tensor in `out`.
    let done = unsafe {
        take_outputs(|out| image_losses::photometric(image, ground_truth, l1_weight, ssim_weight, out))
    };
    let [loss] = done.unwrap_or_else(|error| panic!("{error}"));
    loss
}

/// Computes [`photometric`] over the pixels that count (spec 7.9): `l1_weight` times the mean absolute difference weighted by `mask`, plus
/// `ssim_weight` times 1 − (1 − SSIM) / mean weight, where SSIM compares images that are equal where they are masked out. Images are [.., C, H, W]; masks are
/// [.., 1, H, W].
///
/// # Panics
/// Panics like [`photometric`].
pub fn masked_photometric(
    image: &Tensor,
    ground_truth: &Tensor,
    mask: &Tensor,
    l1_weight: f64,
    ssim_weight: f64,
) -> Tensor {
    let filled = fill_masked(image, ground_truth, mask);
    (photometric(&filled, ground_truth, l1_weight, ssim_weight) - ssim_weight) / mean_weight(mask)
        + ssim_weight
}

/// Computes the mean SSIM, with sample covariances; 1 for equal images. The requirements on the images are those of [`photometric`].
///
/// # Panics
/// Panics if the shapes differ or the images are smaller than 11×11.
pub fn ssim(image: &Tensor, ground_truth: &Tensor) -> Tensor {
    photometric(image, ground_truth, 0., 1.)
}
