//! How uneven depths are where a photo is even: what holds geometry together where photos are few (Godard et al. 2017, eq. 3).

use crate::render::handed_over;
use globalsplat_csrc::fit;
use tch::Tensor;

/// `factor` times the mean over all pairs of neighbouring pixels, side by side or one above the other, with depths a and b and greys
/// g and h of the photo there, of 2 |a − b| / (a + b) · exp(−10 |g − h|). Pairs of which one depth is 0, where nothing is seen, count
/// for nothing. A scalar, differentiable with respect to the depths, [.., H, W], 0 or more; photos are [.., 3, H, W]. Float64 where
/// the depths are, else float32.
///
/// # Panics
/// Shapes that don't fit.
pub fn depth_smoothness(depths: &Tensor, photos: &Tensor, factor: f64) -> Tensor {
    let (depths, photos) = (depths.as_ptr() as usize, photos.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, and on success the C++ side has put a new one there.
    let done = unsafe { handed_over(|out| fit::depth_smoothness(depths, photos, factor, out)) };
    let [loss] = done.unwrap_or_else(|error| panic!("{error}"));
    loss
}
