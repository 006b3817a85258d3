//! Renders one splat from cameras of any sizes, one by one, for display and evaluation.

use super::{Cameras, DEFAULT_EPS2D, render};
use crate::error::Result;
use crate::scene::{Camera, Gaussians, LocalFrame};
use glam::DVec3;
use globalsplat_splat_file::Splat;
use tch::{Device, Tensor};

/// Rendered image of one camera.
#[derive(Debug)]
pub struct RenderedView {
    /// Colour, [3, H, W].
    pub rgb: Tensor,
    /// Accumulated opacity, [H, W].
    pub alpha: Tensor,
    /// Expected depth, [H, W].
    pub depth: Tensor,
}

impl RenderedView {
    /// Returns the rendered image in host memory.
    pub fn to_host(&self) -> Self {
        let to_host = |t: &Tensor| t.to_device(Device::Cpu);
        RenderedView { rgb: to_host(&self.rgb), alpha: to_host(&self.alpha), depth: to_host(&self.depth) }
    }
}

/// Renders Gaussians from each camera; cameras may differ in size. Gaussians and cameras are in the unit of the near plane of spec 6.2.
/// [`SplatRenderer`] renders from cameras of any world.
///
/// # Errors
/// Fails like [`render`].
pub fn render_views(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<RenderedView>> {
    cameras
        .iter()
        .map(|camera| {
            let pictures = tch::no_grad(|| render(gaussians, &Cameras::single(camera), DEFAULT_EPS2D))?;
            let first = |t: Tensor| t.select(0, 0).select(0, 0);
            Ok(RenderedView {
                rgb: first(pictures.rgb),
                alpha: first(pictures.alpha),
                depth: first(pictures.depth),
            })
        })
        .collect()
}

/// Splat in a local frame (spec 2.5) that is rendered from cameras in world coordinates.
#[derive(Debug)]
pub struct SplatRenderer {
    gaussians: Gaussians,
    frame: LocalFrame,
}

impl SplatRenderer {
    /// Creates a renderer in `frame` for `gaussians` of one scene, whose means are relative to `origin`.
    pub fn new(gaussians: &Gaussians, origin: DVec3, frame: LocalFrame) -> Self {
        SplatRenderer { gaussians: gaussians.to_local(&frame, origin), frame }
    }

    /// Creates a renderer of `splat` in its own local frame.
    pub fn from_splat(splat: &Splat) -> Self {
        SplatRenderer::from_gaussians(&Gaussians::from_splat(splat), splat.origin)
    }

    /// Creates a renderer for `gaussians` of one scene, whose means are relative to `origin`, in their own local frame.
    pub fn from_gaussians(gaussians: &Gaussians, origin: DVec3) -> Self {
        SplatRenderer::new(gaussians, origin, gaussians.local_frame(origin))
    }

    /// Moves the splat to `device`, which then renders it.
    pub fn to_device(self, device: Device) -> Self {
        SplatRenderer { gaussians: self.gaussians.to_device(device), frame: self.frame }
    }

    /// Returns the frame that the splat is rendered in.
    pub fn frame(&self) -> LocalFrame {
        self.frame
    }

    /// Renders the splat from each camera; cameras may differ in size. The images are on the host, whatever the device. Depth is in world
    /// units.
    ///
    /// # Errors
    /// Fails like [`render`].
    pub fn render(&self, cameras: &[Camera]) -> Result<Vec<RenderedView>> {
        let rendered = render_views(&self.gaussians, &self.frame.cameras_to_local(cameras))?;
        let finish = |view: RenderedView| {
            let view = view.to_host();
            RenderedView { depth: view.depth * self.frame.scale, ..view }
        };
        Ok(rendered.into_iter().map(finish).collect())
    }
}
