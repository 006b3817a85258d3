//! Cameras for a splat without a capture, and the distance from a capture's cameras to the splat.

use anyhow::Result;
use glam::{DMat4, DVec3};
use globalsplat::render::SplatRenderer;
use globalsplat::scene::{Camera, Gaussians, ImageSize, Intrinsics, orbit_around_point};
use tch::Kind;

/// Returns the median rendered depth of the capture's middle camera, over the pixels with an alpha of at least 0.5; if there
/// are none, the splat's typical distance.
pub fn median_depth(renderer: &SplatRenderer, cameras: &[Camera]) -> Result<f64> {
    let rendered = renderer.render(&cameras[cameras.len() / 2..][..1])?.remove(0);
    let seen = rendered.depth.masked_select(&rendered.alpha.ge(0.5));
    Ok(if seen.numel() == 0 { renderer.frame().typical_distance() } else { seen.median().double_value(&[]) })
}

/// Returns cameras on an orbit around the opacity-weighted centre of the Gaussians `g` of one scene, far enough away to see most of them.
/// Their means are relative to `origin`.
pub fn orbit_around_gaussians(
    g: &Gaussians,
    origin: DVec3,
    ImageSize { width, height }: ImageSize,
    frames: usize,
) -> Vec<Camera> {
    let means = g.means.view([-1, 3]).to_kind(Kind::Double);
    let weights = g.opacities.view([-1, 1]).to_kind(Kind::Double);
    let total = weights.sum(Kind::Double).clamp_min(f64::MIN_POSITIVE);
    let centre = (&means * &weights).sum_dim_intlist([0i64].as_slice(), false, Kind::Double) / &total;
    let spread = ((&means - &centre).square().sum_dim_intlist([1i64].as_slice(), true, Kind::Double)
        * &weights)
        .sum(Kind::Double)
        .divide(&total)
        .sqrt()
        .double_value(&[]);
    let centre = origin + DVec3::from_array([0, 1, 2].map(|axis| centre.double_value(&[axis])));
    // Gaussians that all have the same mean: use their size instead of the spread.
    let radius = 3. * if spread > 0. { spread } else { g.local_frame(origin).typical_distance() };
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.min(h);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
    let reference = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    orbit_around_point(centre, radius, &reference, frames)
}
