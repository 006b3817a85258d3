//! Splats fitted to the format of a file, and the precision of their positions in it.

use crate::error::{Error, Result};
use crate::render::{compensate_mean_color, fit_harmonics, shrink_harmonics};
use crate::scene::{Camera, Gaussians, RawGaussians, splat_frame};
use glam::DVec3;
use globalsplat_splat_file::{ShLimits, Splat, output_format};
use std::path::Path;
use tch::Tensor;

/// Maximum ratio of the spacing of float32 positions to the scene's typical distance whose effect on rendered images is invisible.
const MAX_SPACING_RATIO: f64 = 1e-4;

/// Returns `splat` with spherical harmonics within `limits` and those of the format of `path`, which look the same from `cameras`. For a
/// format with a palette of coefficients they are made small first, rounded as the file's will be, and the mean colors are corrected.
///
/// # Errors
/// Returns an error for an unknown extension.
pub fn fit_splat(path: &Path, splat: &Splat, limits: &ShLimits, cameras: &[Camera]) -> Result<Splat> {
    let format = output_format(path)?;
    let limits = limits.intersect(&(format.limits)());
    let round_sh = format.round_sh.filter(|_| !cameras.is_empty());
    let gaussians = Gaussians::from_splat(splat);
    let frame = gaussians.local_frame(splat.origin);
    let cameras = frame.cameras_to_local(cameras);
    let local = gaussians.to_local(&frame, splat.origin);
    let smallest = if round_sh.is_some() { shrink_harmonics(&local, &cameras) } else { local };
    let fitted = fit_harmonics(&smallest, &cameras, &limits);
    // Logits of opacities that stay are kept to the bit.
    let logits = RawGaussians::from_gaussians(&fitted).opacity_logits;
    let kept = Tensor::from_slice(&splat.opacity_logits).view_as(&logits);
    let logits = logits.where_self(&fitted.opacities.not_equal_tensor(&gaussians.opacities), &kept);
    let with_sh = |fitted: &Gaussians| -> Result<Splat> {
        Ok(Splat {
            opacity_logits: Vec::try_from(logits.flatten(0, -1)).map_err(Error::external)?,
            sh: Vec::<f32>::try_from(fitted.sh.flatten(0, -1))
                .map_err(Error::external)?
                .as_chunks()
                .0
                .to_vec(),
            sh_degree: fitted.sh.size()[2].isqrt() as usize - 1,
            warnings: vec![],
            ..splat.clone()
        })
    };
    let within_limits = with_sh(&fitted)?;
    let Some(round_sh) = round_sh else { return Ok(within_limits) };
    let rounded = Gaussians {
        sh: Gaussians::from_splat(&round_sh(&within_limits)).sh,
        ..fitted.map(Tensor::shallow_clone)
    };
    let compensated = compensate_mean_color(&fitted, &rounded, &cameras);
    with_sh(&fit_harmonics(&compensated, &[], &limits))
}

/// Returns a message about the rounding of positions to float32 when `splat` is written in world coordinates, if it is visible in rendered
/// images.
pub fn rounding_warning(splat: &Splat) -> Option<String> {
    if splat.origin == DVec3::ZERO {
        return None;
    }
    let frame = splat_frame(splat);
    let farthest = frame.origin.abs().max_element();
    let spacing = f64::from((farthest as f32).next_up()) - f64::from(farthest as f32);
    let share = spacing / frame.typical_distance();
    (share > MAX_SPACING_RATIO).then(|| {
        format!(
            "positions are rounded: {farthest:.3e} units from the origin, float32 has one every {spacing} units, {:.2} % of the \
             scene's typical distance",
            100. * share
        )
    })
}
