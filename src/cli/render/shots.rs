//! From where pictures are taken.

use anyhow::Result;
use glam::{DMat4, DVec3};
use globalsplat::data::{CameraPath, Capture, read_camera_path};
use globalsplat::io::{Inputs, Splat};
use globalsplat::render::render_views;
use globalsplat::scene::{
    Camera, ImageSize, Intrinsics, orbit_around_cameras, orbit_around_point, smooth_path,
};
use std::path::Path;
use tch::Kind;

const FRAMES_PER_SECOND: u32 = 20;
/// Of an orbit.
const DEFAULT_FRAMES: usize = 60;
/// Of a picture when no capture tells one.
const DEFAULT_SIZE: u32 = 512;

/// Cameras, one after the other.
pub struct Shots {
    /// What their pictures are called.
    pub names: Vec<String>,
    pub cameras: Vec<Camera>,
    pub frames_per_second: u32,
    /// What a path was read from.
    pub inputs: Inputs,
}

impl Shots {
    /// From the capture's cameras, or so many on a smooth path through them.
    pub fn of(
        capture: &Capture,
        size: Option<ImageSize>,
        frames: Option<usize>,
        splat: &Splat,
    ) -> Result<Self> {
        let cameras = resized(capture.cameras(), size);
        Ok(match frames {
            Some(frames) => Shots::numbered(smoothed(&cameras, frames, splat)?),
            None => Shots { names: capture.picture_names(), ..Shots::numbered(cameras) },
        })
    }

    /// On an orbit amid the capture's cameras.
    pub fn amid(
        capture: &Capture,
        size: Option<ImageSize>,
        frames: Option<usize>,
        splat: &Splat,
    ) -> Result<Self> {
        let cameras = resized(capture.cameras(), size);
        let distance = median_depth(splat, &cameras)?;
        let orbit = orbit_around_cameras(&cameras, distance, frames.unwrap_or(DEFAULT_FRAMES))?;
        Ok(Shots::numbered(orbit))
    }

    /// On an orbit around the splat.
    pub fn around(splat: &Splat, size: Option<ImageSize>, frames: Option<usize>) -> Self {
        let size = size.unwrap_or(ImageSize { width: DEFAULT_SIZE, height: DEFAULT_SIZE });
        Shots::numbered(orbit_around_splat(splat, size, frames.unwrap_or(DEFAULT_FRAMES)))
    }

    /// From the cameras at `path`, or so many on a smooth path through them.
    pub fn along(path: &Path, size: Option<ImageSize>, frames: Option<usize>, splat: &Splat) -> Result<Self> {
        let CameraPath { cameras, frames_per_second, inputs } = read_camera_path(path, size)?;
        let cameras = resized(cameras, size);
        let shots = Shots::numbered(match frames {
            Some(frames) => smoothed(&cameras, frames, splat)?,
            None => cameras,
        });
        let frames_per_second = frames_per_second.unwrap_or(FRAMES_PER_SECOND);
        Ok(Shots { frames_per_second, inputs, ..shots })
    }

    fn numbered(cameras: Vec<Camera>) -> Self {
        let digits = (cameras.len().max(2) - 1).to_string().len().max(3);
        let names = (0..cameras.len()).map(|i| format!("{i:0digits$}")).collect();
        Shots { names, cameras, frames_per_second: FRAMES_PER_SECOND, inputs: Inputs::default() }
    }
}

fn resized(cameras: Vec<Camera>, size: Option<ImageSize>) -> Vec<Camera> {
    match size {
        Some(size) => cameras.iter().map(|camera| camera.with_size(size)).collect(),
        None => cameras,
    }
}

fn smoothed(cameras: &[Camera], frames: usize, splat: &Splat) -> Result<Vec<Camera>> {
    Ok(smooth_path(cameras, median_depth(splat, cameras)?, frames)?)
}

/// What a camera in the middle of the capture sees at its centre, half of the pixels being nearer.
pub fn median_depth(splat: &Splat, cameras: &[Camera]) -> Result<f64> {
    let rendered = render_views(&splat.gaussians, &cameras[cameras.len() / 2..][..1])?.remove(0);
    let seen = rendered.depth.masked_select(&rendered.alpha.ge(0.5));
    Ok(if seen.numel() == 0 { 1. } else { seen.median().double_value(&[]) })
}

/// Around the middle of the splat's opaque part, far enough to see most of it.
pub fn orbit_around_splat(
    splat: &Splat,
    ImageSize { width, height }: ImageSize,
    frames: usize,
) -> Vec<Camera> {
    let g = &splat.gaussians;
    let means = g.means.view([-1, 3]).to_kind(Kind::Double);
    let weights = g.opacities.view([-1, 1]).to_kind(Kind::Double);
    let total = weights.sum(Kind::Double).clamp_min(1e-12);
    let centre = (&means * &weights).sum_dim_intlist([0i64].as_slice(), false, Kind::Double) / &total;
    let spread = ((&means - &centre).square().sum_dim_intlist([1i64].as_slice(), true, Kind::Double)
        * &weights)
        .sum(Kind::Double)
        .divide(&total)
        .sqrt()
        .double_value(&[]);
    let centre = DVec3::new(centre.double_value(&[0]), centre.double_value(&[1]), centre.double_value(&[2]));
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w.min(h);
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
    let reference = Camera { intrinsics, c2w: DMat4::IDENTITY, width, height };
    orbit_around_point(centre, 3. * spread.max(1e-6), &reference, frames)
}
