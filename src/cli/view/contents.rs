//! Data about the scene that is embedded in a page.

use crate::data::{Capture, load_views};
use crate::io::{encode_photo, rgb_from_tensor};
use crate::render::{SplatRenderer, default_eps2d, orbit_around_gaussians};
use crate::scene::{Camera, Gaussians, ImageSize, LocalFrame, smooth_path};
use anyhow::Result;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use serde::Serialize;

/// Maximum length of a photo's longer side, in pixels.
const LONGEST: u32 = 640;
/// Maximum number of photos, at about 100 KB each: a page with more would take long to load.
const MAX_PHOTOS: usize = 100;
/// Number and size of views on an orbit around a splat without a capture.
const ORBIT: usize = 24;
const SIZE: ImageSize = ImageSize { width: 640, height: 480 };
/// Number of frames per camera on the path through the capture's cameras. The page interpolates linearly between them.
const FRAMES_PER_CAMERA: usize = 12;
const MAX_FRAMES: usize = 1200;
/// Length of a camera's frustum, as a share of the distance to the scene.
const FRUSTUM: f64 = 0.06;

/// Contents of the page as JSON, read in web/src. Lengths and positions are in the splat's local frame (spec 2.5), which suits
/// a browser's float32 and its half-precision centers.
#[derive(Serialize)]
pub struct Contents {
    pub name: String,
    cameras: Vec<PageCamera>,
    /// Camera-to-world matrices of the path, [3, 4] in row-major order, like those of the cameras.
    path: Vec<[f64; 12]>,
    /// Up direction of the photos, a unit vector.
    up: [f64; 3],
    /// Median distance from the middle camera to the scene.
    distance: f64,
    frustum: f64,
    /// Value added to the diagonal of a Gaussian's projected covariance, in square pixels (spec 6.2).
    blur: f64,
    /// `true` if opacities are reduced by what the blur adds to the area of a Gaussian.
    antialiased: bool,
}

#[derive(Serialize)]
struct PageCamera {
    name: String,
    c2w: [f64; 12],
    lens: Lens,
    /// Photo, a JPEG as a data URL.
    #[serde(skip_serializing_if = "Option::is_none")]
    photo: Option<String>,
}

/// Intrinsics of a camera, in pixels.
#[derive(Serialize)]
struct Lens {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    width: u32,
    height: u32,
}

impl Contents {
    /// Creates the contents for `gaussians`, which are in the local frame `frame`, with the cameras of `capture` or, without one, on
    /// an orbit.
    ///
    /// # Errors
    /// Photos that can't be read.
    pub fn new(
        name: &str,
        gaussians: &Gaussians,
        capture: Option<&Capture>,
        frame: &LocalFrame,
    ) -> Result<Self> {
        let (cameras, all) = match capture {
            Some(capture) => (photographed(capture, frame)?, frame.cameras_to_local(&capture.cameras())),
            None => {
                let orbit = orbit_around_gaussians(gaussians, DVec3::ZERO, SIZE, ORBIT);
                let named =
                    (1_usize..).zip(&orbit).map(|(i, camera)| PageCamera::new(i.to_string(), camera, None));
                (named.collect(), orbit)
            }
        };
        let distance = SplatRenderer::from_gaussians(gaussians, DVec3::ZERO).median_depth(&all)?;
        let path = match capture {
            Some(_) => smooth_path(&all, distance, (FRAMES_PER_CAMERA * all.len()).min(MAX_FRAMES))?,
            None => [&all[..], &all[..1]].concat(),
        };
        let up = -all.iter().map(|camera| camera.c2w.y_axis.truncate()).sum::<DVec3>();
        Ok(Contents {
            name: name.into(),
            cameras,
            path: path.iter().map(rows).collect(),
            up: up.try_normalize().unwrap_or(DVec3::NEG_Y).into(),
            distance,
            frustum: FRUSTUM * distance,
            blur: default_eps2d(gaussians),
            antialiased: gaussians.antialiased,
        })
    }
}

impl PageCamera {
    fn new(name: String, camera: &Camera, photo: Option<String>) -> Self {
        let k = camera.intrinsics;
        let Camera { width, height, .. } = *camera;
        let lens = Lens { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width, height };
        PageCamera { name, c2w: rows(camera), lens, photo }
    }
}

/// Returns the first three rows of a camera-to-world matrix.
fn rows(camera: &Camera) -> [f64; 12] {
    std::array::from_fn(|i| camera.c2w.col(i % 4)[i / 4])
}

/// Returns cameras with their photos, at most [`MAX_PHOTOS`] evenly spaced over the capture.
fn photographed(capture: &Capture, frame: &LocalFrame) -> Result<Vec<PageCamera>> {
    let (count, cameras) = (capture.len().min(MAX_PHOTOS), capture.cameras());
    let indices = (0..count).map(|i| i * (capture.len() - 1) / (count - 1).max(1));
    let photographed = |index: usize| {
        let view = load_views(capture, &[index], shrunk(&cameras[index]))?.remove(0);
        let jpeg = encode_photo(&rgb_from_tensor(&view.image.to_float())?, true)?;
        let photo = format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg));
        Ok(PageCamera::new(view.name, &frame.camera_to_local(&view.camera), Some(photo)))
    };
    indices.map(photographed).collect()
}

/// Returns the size to which a photo is downscaled, or `None` if it is small enough.
fn shrunk(&Camera { width, height, .. }: &Camera) -> Option<ImageSize> {
    let longest = width.max(height);
    let side = |side: u32| (side * LONGEST).div_ceil(longest);
    (longest > LONGEST).then(|| ImageSize { width: side(width), height: side(height) })
}
