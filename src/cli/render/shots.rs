//! Cameras of `render`.

use super::Render;
use crate::cli::{parse_size, warn};
use crate::data::{Capture, read_camera_path};
use crate::io::InputFiles;
use crate::render::{SplatRenderer, orbit_around_gaussians};
use crate::scene::{Camera, Gaussians, ImageSize, orbit_around_cameras, smooth_path};
use anyhow::Result;
use glam::DVec3;

const FRAMES_PER_SECOND: u32 = 20;
/// Default number of frames of an orbit.
const DEFAULT_FRAMES: usize = 60;
/// Default size of an image, without a capture.
const DEFAULT_SIZE: ImageSize = ImageSize { width: 512, height: 512 };

/// Sequence of cameras to render.
pub struct Shots {
    /// Names of the images, which stay unique with the suffixes of their parts.
    pub names: Vec<String>,
    pub cameras: Vec<Camera>,
    pub frames_per_second: u32,
    /// Files that a path was read from.
    pub inputs: InputFiles,
}

impl Shots {
    /// Returns the cameras that `options` select: those of a path or of the capture, on a smooth path through these with `--frames`; or an
    /// orbit around the mean of the capture's cameras, all looking at the point that the mean camera looks at, or around the Gaussians, whose
    /// means are relative to `origin`.
    pub fn new(
        options: &Render,
        capture: Option<&Capture>,
        (gaussians, origin): (&Gaussians, DVec3),
        renderer: &SplatRenderer,
    ) -> Result<Self> {
        let size = options.size.as_deref().map(parse_size).transpose()?;
        let frames = options.frames.map(|frames| frames as usize);
        let (mut path_rate, mut inputs) = (None, InputFiles::default());
        let mut cameras = capture.map(Capture::cameras).unwrap_or_default();
        if let Some(path) = &options.path {
            let path = read_camera_path(path, size)?;
            warn(&path.warnings);
            (cameras, path_rate, inputs) = (path.cameras, path.frames_per_second, path.inputs);
        }
        if let Some(size) = size {
            cameras.iter_mut().for_each(|camera| *camera = camera.with_size(size));
        }
        let of_orbit = frames.unwrap_or(DEFAULT_FRAMES);
        let shown = match frames {
            _ if options.orbit && capture.is_none() => {
                orbit_around_gaussians(gaussians, origin, size.unwrap_or(DEFAULT_SIZE), of_orbit)
            }
            _ if options.orbit => orbit_around_cameras(&cameras, renderer.median_depth(&cameras)?, of_orbit)?,
            Some(frames) => smooth_path(&cameras, renderer.median_depth(&cameras)?, frames)?,
            None => cameras,
        };
        let names = match capture {
            Some(capture) if !options.orbit && frames.is_none() => {
                capture.render_names_with(&options.suffixes())
            }
            _ => {
                let digits = (shown.len().max(2) - 1).to_string().len().max(3);
                (0..shown.len()).map(|i| format!("{i:0digits$}")).collect()
            }
        };
        let frames_per_second = options.fps.or(path_rate).unwrap_or(FRAMES_PER_SECOND);
        Ok(Shots { names, cameras: shown, frames_per_second, inputs })
    }
}
