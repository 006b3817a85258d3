//! Renders one splat from cameras of any sizes, one by one, for display and evaluation; and cameras around a splat that has no capture.

use super::{Cameras, default_eps2d, render};
use crate::error::Result;
use crate::scene::{Camera, Gaussians, ImageSize, Intrinsics, LocalFrame, orbit_around_point};
use glam::{DMat4, DVec3};
use globalsplat_splat_file::Splat;
use tch::{Device, Kind, Tensor};

/// Rendered image of one camera.
#[derive(Debug)]
pub struct RenderedView {
    /// Color, [3, H, W].
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
///
/// ```no_run
/// use globalsplat::data::open_capture;
/// use globalsplat::io::{read_splat, write_png};
/// use globalsplat::render::render_views;
/// use globalsplat::scene::{Gaussians, LocalFrame};
///
/// # fn main() -> globalsplat::Result<()> {
/// let splat = read_splat("room.ply".as_ref())?;
/// let cameras = open_capture("captures/room".as_ref())?.cameras();
/// // The local frame of the cameras has a suitable unit.
/// let frame = LocalFrame::from_cameras(&cameras);
/// let gaussians = Gaussians::from_splat(&splat).to_local(&frame, splat.origin);
/// let rendered = render_views(&gaussians, &[frame.camera_to_local(&cameras[0])])?;
/// write_png("room.png".as_ref(), &rendered[0].rgb)?;
/// # Ok(())
/// # }
/// ```
pub fn render_views(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<RenderedView>> {
    cameras
        .iter()
        .map(|camera| {
            let rendered =
                tch::no_grad(|| render(gaussians, &Cameras::single(camera), default_eps2d(gaussians)))?;
            let first = |t: Tensor| t.select(0, 0).select(0, 0);
            Ok(RenderedView {
                rgb: first(rendered.rgb),
                alpha: first(rendered.alpha),
                depth: first(rendered.depth),
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

    /// Returns the median rendered depth of the middle one of `cameras`, over the pixels with an alpha of at least 0.5; if there are none,
    /// the splat's typical distance.
    ///
    /// # Errors
    /// Fails like [`render`].
    ///
    /// # Panics
    /// Panics if there are no cameras.
    pub fn median_depth(&self, cameras: &[Camera]) -> Result<f64> {
        let rendered = self.render(&cameras[cameras.len() / 2..][..1])?.remove(0);
        let seen = rendered.depth.masked_select(&rendered.alpha.ge(0.5));
        Ok(if seen.numel() == 0 { self.frame.typical_distance() } else { seen.median().double_value(&[]) })
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

/// Number and size of the views of [`orbit_around_splat`].
const VIEWS: usize = 8;
const SIZE: ImageSize = ImageSize { width: 512, height: 512 };

/// Returns eight cameras of 512×512 pixels on an orbit around a splat, in world coordinates.
pub fn orbit_around_splat(splat: &Splat) -> Vec<Camera> {
    orbit_around_gaussians(&Gaussians::from_splat(splat), splat.origin, SIZE, VIEWS)
}

/// Returns `frames` cameras on an orbit around the opacity-weighted center of the Gaussians of one scene, whose means are relative to
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
    let center = (&means * &weights).sum_dim_intlist([0i64].as_slice(), false, Kind::Double) / &total;
    let spread = ((&means - &center).square().sum_dim_intlist([1i64].as_slice(), true, Kind::Double)
        * &weights)
        .sum(Kind::Double)
        .divide(&total)
        .sqrt()
        .double_value(&[]);
    let center = origin + DVec3::from_array([0, 1, 2].map(|axis| center.double_value(&[axis])));
    // Gaussians that all have the same mean: use their size instead of the spread.
    let radius = 3. * if spread > 0. { spread } else { gaussians.local_frame(origin).typical_distance() };
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.min(h);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
    let reference = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    orbit_around_point(center, radius, &reference, frames)
}
