//! Data about the scene that is embedded in a page.

use crate::data::{Capture, load_views};
use crate::io::jpeg_data_url;
use crate::render::{SplatRenderer, default_eps2d, orbit_around_gaussians};
use crate::scene::{Camera, Gaussians, ImageSize, Intrinsics, LocalFrame, smooth_path};
use anyhow::Result;
use glam::DVec3;
use serde_json::{Value, json};

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

/// Returns the contents of the page, which web/src reads, for `gaussians` in the local frame `frame`, with the cameras of `capture` or,
/// without one, on an orbit. Lengths and positions are in the local frame (spec 2.5), which suits a browser's float32 and its
/// half-precision centers.
///
/// # Errors
/// Photos that can't be read.
pub fn contents(gaussians: &Gaussians, capture: Option<&Capture>, frame: &LocalFrame) -> Result<Value> {
    let (cameras, all) = match capture {
        Some(capture) => (photographed(capture, frame)?, frame.cameras_to_local(&capture.cameras())),
        None => {
            let orbit = orbit_around_gaussians(gaussians, DVec3::ZERO, SIZE, ORBIT);
            let named = (1_usize..).zip(&orbit).map(|(i, camera)| page_camera(&i.to_string(), camera, None));
            (named.collect(), orbit)
        }
    };
    // Median distance from the middle camera to the scene.
    let distance = SplatRenderer::from_gaussians(gaussians, DVec3::ZERO).median_depth(&all)?;
    let path = match capture {
        Some(_) => smooth_path(&all, distance, (FRAMES_PER_CAMERA * all.len()).min(MAX_FRAMES))?,
        None => [&all[..], &all[..1]].concat(),
    };
    let up = -all.iter().map(|camera| camera.c2w.y_axis.truncate()).sum::<DVec3>();
    let is_metric = capture.and_then(Capture::upright).is_some_and(|upright| upright.is_metric);
    Ok(json!({
        "cameras": cameras,
        "path": path.iter().map(rows).collect::<Vec<_>>(),
        // Up direction of the photos.
        "up": up.try_normalize().unwrap_or(DVec3::NEG_Y).to_array(),
        "distance": distance,
        "frustum": FRUSTUM * distance,
        // World coordinates are origin + scale · local ones.
        "frame": {
            "origin": frame.origin.to_array(),
            "scale": frame.scale,
            "unit": if is_metric { "m" } else { "units" },
        },
        // What is added to the diagonal of a Gaussian's projected covariance, in square pixels (spec 6.2), and whether opacities are reduced
        // by what that adds to the area of a Gaussian.
        "blur": default_eps2d(gaussians),
        "antialiased": gaussians.antialiased,
    }))
}

/// Returns a camera with its intrinsics in pixels, and its photo, a JPEG as a data URL.
fn page_camera(name: &str, camera: &Camera, photo: Option<String>) -> Value {
    let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
    let lens =
        json!({ "fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": camera.width, "height": camera.height });
    json!({ "name": name, "c2w": rows(camera), "lens": lens, "photo": photo })
}

/// Returns the first three rows of a camera-to-world matrix.
fn rows(camera: &Camera) -> [f64; 12] {
    std::array::from_fn(|i| camera.c2w.col(i % 4)[i / 4])
}

/// Returns cameras with their photos, at most [`MAX_PHOTOS`] evenly spaced over the capture.
fn photographed(capture: &Capture, frame: &LocalFrame) -> Result<Vec<Value>> {
    let (count, cameras) = (capture.len().min(MAX_PHOTOS), capture.cameras());
    let indices = (0..count).map(|i| i * (capture.len() - 1) / (count - 1).max(1));
    let photographed = |index: usize| {
        let view = load_views(capture, &[index], shrunk(&cameras[index]))?.remove(0);
        let photo = jpeg_data_url(&view.image.to_float())?;
        Ok(page_camera(&view.name, &frame.camera_to_local(&view.camera), Some(photo)))
    };
    indices.map(photographed).collect()
}

/// Returns the size to which a photo is downscaled, or `None` if it is small enough.
fn shrunk(&Camera { width, height, .. }: &Camera) -> Option<ImageSize> {
    let longest = width.max(height);
    let side = |side: u32| (side * LONGEST).div_ceil(longest);
    (longest > LONGEST).then(|| ImageSize { width: side(width), height: side(height) })
}
