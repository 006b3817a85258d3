//! How far a picture is from a photo: absolute differences, and structural similarity (Wang et al. 2004), as scikit-image's
//! `structural_similarity` with Gaussian weights computes it. (Spec 9.4.)

use crate::render::handed_over;
use globalsplat_csrc::fit;
use tch::Tensor;

/// `absolute` times the mean absolute difference plus `similar` times the mean SSIM, both over pictures and channels, and over
/// pixels, or pixels whose window of 11×11 is inside. A scalar, differentiable with respect to the picture, in one pass over
/// either on the CPU. Pictures [.., H, W] in [0, 1] of one shape, H and W at least 11; float64 where the picture is, else float32.
///
/// # Panics
/// Shapes that differ, or smaller pictures.
pub fn photometric(picture: &Tensor, truth: &Tensor, absolute: f64, similar: f64) -> Tensor {
    let (picture, truth) = (picture.as_ptr() as usize, truth.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, and on success the C++ side has put a new one there.
    let done = unsafe { handed_over(|out| fit::photometric(picture, truth, absolute, similar, out)) };
    let [loss] = done.unwrap_or_else(|error| panic!("{error}"));
    loss
}

/// The mean SSIM, with sample covariances; 1 for equal pictures. As [`photometric`].
///
/// # Panics
/// As [`photometric`].
pub fn ssim(picture: &Tensor, truth: &Tensor) -> Tensor {
    photometric(picture, truth, 0., 1.)
}
