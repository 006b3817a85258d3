//! Cameras of `render`.

use crate::cli::warn;
use crate::data::{CameraPath, Capture, read_camera_path};
use crate::io::InputFiles;
use crate::render::{SplatRenderer, orbit_around_gaussians};
use crate::scene::{Camera, Gaussians, ImageSize, orbit_around_cameras, smooth_path};
use anyhow::Result;
use glam::DVec3;
use std::path::Path;

const FRAMES_PER_SECOND: u32 = 20;
/// Default number of frames of an orbit.
const DEFAULT_FRAMES: usize = 60;
/// Default width and height of an image, without a capture.
const DEFAULT_SIZE: u32 = 512;

/// Sequence of cameras to render.
pub struct Shots {
    /// Names of the images.
    pub names: Vec<String>,
    pub cameras: Vec<Camera>,
    pub frames_per_second: u32,
    /// Files that a path was read from.
    pub inputs: InputFiles,
}

impl Shots {
    /// Returns the capture's cameras, or `frames` of them on a smooth path through these. Names of images stay unique with
    /// `suffixes`.
    pub fn from_capture(
        capture: &Capture,
        size: Option<ImageSize>,
        frames: Option<usize>,
        renderer: &SplatRenderer,
        suffixes: &[&str],
    ) -> Result<Self> {
        let cameras = resized(capture.cameras(), size);
        Ok(match frames {
            Some(frames) => Shots::numbered(smoothed(&cameras, frames, renderer)?),
            None => Shots { names: capture.render_names_with(suffixes), ..Shots::numbered(cameras) },
        })
    }

    /// Returns cameras on an orbit around the mean of the capture's cameras, all looking at the point that the mean camera
    /// looks at.
    pub fn orbit_capture(
        capture: &Capture,
        size: Option<ImageSize>,
        frames: Option<usize>,
        renderer: &SplatRenderer,
    ) -> Result<Self> {
        let cameras = resized(capture.cameras(), size);
        let distance = renderer.median_depth(&cameras)?;
        let orbit = orbit_around_cameras(&cameras, distance, frames.unwrap_or(DEFAULT_FRAMES))?;
        Ok(Shots::numbered(orbit))
    }

    /// Returns cameras on an orbit around `gaussians`, whose means are relative to `origin`.
    pub fn orbit_splat(
        gaussians: &Gaussians,
        origin: DVec3,
        size: Option<ImageSize>,
        frames: Option<usize>,
    ) -> Self {
        let size = size.unwrap_or(ImageSize { width: DEFAULT_SIZE, height: DEFAULT_SIZE });
        Shots::numbered(orbit_around_gaussians(gaussians, origin, size, frames.unwrap_or(DEFAULT_FRAMES)))
    }

    /// Returns the cameras at `path`, or `frames` of them on a smooth path through these.
    pub fn from_path(
        path: &Path,
        size: Option<ImageSize>,
        frames: Option<usize>,
        renderer: &SplatRenderer,
    ) -> Result<Self> {
        let CameraPath { cameras, frames_per_second, warnings, inputs } = read_camera_path(path, size)?;
        warn(&warnings);
        let cameras = resized(cameras, size);
        let shots = Shots::numbered(match frames {
            Some(frames) => smoothed(&cameras, frames, renderer)?,
            None => cameras,
        });
        let frames_per_second = frames_per_second.unwrap_or(FRAMES_PER_SECOND);
        Ok(Shots { frames_per_second, inputs, ..shots })
    }

    fn numbered(cameras: Vec<Camera>) -> Self {
        let digits = (cameras.len().max(2) - 1).to_string().len().max(3);
        let names = (0..cameras.len()).map(|i| format!("{i:0digits$}")).collect();
        Shots { names, cameras, frames_per_second: FRAMES_PER_SECOND, inputs: InputFiles::default() }
    }
}

fn resized(cameras: Vec<Camera>, size: Option<ImageSize>) -> Vec<Camera> {
    match size {
        Some(size) => cameras.iter().map(|camera| camera.with_size(size)).collect(),
        None => cameras,
    }
}

fn smoothed(cameras: &[Camera], frames: usize, renderer: &SplatRenderer) -> Result<Vec<Camera>> {
    Ok(smooth_path(cameras, renderer.median_depth(cameras)?, frames)?)
}
