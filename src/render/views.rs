//! One splat from cameras of any sizes, one by one: pictures to look at and to judge.

use super::{Cameras, DEFAULT_EPS2D, render};
use crate::error::Result;
use crate::scene::{Camera, Gaussians};
use tch::Tensor;

/// What a camera saw of a splat.
#[derive(Debug)]
pub struct Rendered {
    /// [3, H, W].
    pub rgb: Tensor,
    /// [H, W].
    pub alpha: Tensor,
    /// [H, W].
    pub depth: Tensor,
}

/// Renders a splat from each camera, which may differ in size.
///
/// # Errors
/// Those of [`render`].
pub fn render_views(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<Rendered>> {
    cameras
        .iter()
        .map(|camera| {
            let pictures = tch::no_grad(|| render(gaussians, &Cameras::single(camera), DEFAULT_EPS2D))?;
            let first = |t: Tensor| t.select(0, 0).select(0, 0);
            Ok(Rendered {
                rgb: first(pictures.rgb),
                alpha: first(pictures.alpha),
                depth: first(pictures.depth),
            })
        })
        .collect()
}
