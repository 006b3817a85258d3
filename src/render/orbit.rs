//! Cameras around a splat that has no capture.

use crate::scene::{Camera, Gaussians, ImageSize, Intrinsics, orbit_around_point};
use glam::{DMat4, DVec3};
use globalsplat_splat_file::Splat;
use tch::Kind;

/// Number and size of the views of [`orbit_around_splat`].
const VIEWS: usize = 8;
const SIZE: ImageSize = ImageSize { width: 512, height: 512 };

/// Returns eight cameras of 512×512 pixels on an orbit around a splat, in world coordinates.
pub fn orbit_around_splat(splat: &Splat) -> Vec<Camera> {
    orbit_around_gaussians(&Gaussians::from_splat(splat), splat.origin, SIZE, VIEWS)
}

/// Returns `frames` cameras on an orbit around the opacity-weighted centre of the Gaussians of one scene, whose means are relative to
/// `origin`. The cameras are in world coordinates, and far enough away to see most of the splat.
pub fn orbit_around_gaussians(
    gaussians: &Gaussians,
    origin: DVec3,
    ImageSize { width, height }: ImageSize,
    frames: usize,
) -> Vec<Camera> {
    let means = gaussians.means.view([-1, 3]).to_kind(Kind::Double);
    let weights = gaussians.opacities.view([-1, 1]).to_kind(Kind::Double);
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
    let radius = 3. * if spread > 0. { spread } else { gaussians.local_frame(origin).typical_distance() };
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.min(h);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
    let reference = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    orbit_around_point(centre, radius, &reference, frames)
}
