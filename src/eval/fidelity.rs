//! Loss of quality when a splat is converted to another format: both versions are rendered from the same cameras.

use super::metrics::squared_error;
use crate::error::Result;
use crate::io::Splat;
use crate::loss::psnr_of_mse;
use crate::render::SplatRenderer;
use crate::scene::{Camera, Gaussians};

/// Returns the PSNR in dB between the renders of `copy` and of `original` from `cameras`, from the mean squared error over all pixels.
/// Returns `None` if the renders are identical.
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
        let seen = |splat: &SplatRenderer| -> Result<_> {
            Ok(splat.render(std::slice::from_ref(camera))?.remove(0).rgb)
        };
        let original = seen(&original)?;
        sum += squared_error(&original, &seen(&copy)?, None);
        numbers += original.numel();
    }
    Ok((sum != 0.).then(|| psnr_of_mse(sum / numbers as f64)))
}
