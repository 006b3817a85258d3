//! Edge-aware depth smoothness, which regularizes geometry if there are few photos (Godard et al. 2017, eq. 3).

use super::mask::mean_weight;
use crate::ffi::take_outputs;
use globalsplat_csrc::image_losses;
use tch::Tensor;

/// Computes `factor` times the mean of 2 |a − b| / (a + b) · exp(−10 |g − h|) over all pairs of horizontally or vertically neighbouring
/// pixels, where a and b are the depths and g and h the photo's grey values at the two pixels. Pairs with a depth of 0, where nothing is
/// visible, contribute 0. `depths` are [.., H, W], 0 or more; `photos` are [.., 3, H, W]. The result is a scalar, differentiable with
/// respect to the depths; float64 if the depths are, and float32 otherwise.
///
/// # Panics
/// Panics if the shapes don't fit.
pub fn depth_smoothness(depths: &Tensor, photos: &Tensor, factor: f64) -> Tensor {
    let (depths, photos) = (depths.as_ptr() as usize, photos.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, and on success the C++ side has stored a new tensor in `out`.
    let done = unsafe { take_outputs(|out| image_losses::depth_smoothness(depths, photos, factor, out)) };
    let [loss] = done.unwrap_or_else(|error| panic!("{error}"));
    loss
}

/// Minimum weight of a pixel whose depth is compared.
const MIN_WEIGHT: f64 = 0.5;

/// Computes [`depth_smoothness`] over the pairs of pixels that both count: those with a weight of ½ or more in `mask` [.., H, W] (spec 7.9).
/// The mean over all pairs is divided by the fraction of these pixels.
///
/// # Panics
/// Panics if the shapes don't fit.
pub fn masked_depth_smoothness(depths: &Tensor, photos: &Tensor, mask: &Tensor, factor: f64) -> Tensor {
    let counts = mask.ge(MIN_WEIGHT).to_kind(depths.kind());
    depth_smoothness(&(depths * &counts), photos, factor) / mean_weight(&counts)
}
