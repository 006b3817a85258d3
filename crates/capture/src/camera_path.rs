//! Camera paths to render: the cameras of any capture, without its photos, or a `camera_path.json` of nerfstudio's viewer.
//!
//! A `camera_path.json` (spec 10.17) is an object with these keys:
//!
//! - `camera_path`: a list of cameras, each with `camera_to_world`, 16 numbers in row-major order with OpenGL axes, and `fov`, the vertical
//!   field of view in degrees;
//! - `render_height` and `render_width`, in pixels;
//! - optionally `camera_type`, which must be `"perspective"`, and `fps` or `seconds`.

use crate::capture::{Purpose, check_cameras};
use crate::formats::transforms_json::{describe_value, from_opengl};
use crate::formats::{cameras_json, read_json, transforms_json};
use crate::geometry::{Camera, ImageSize, Intrinsics, nearest_rigid_of_scaled};
use crate::open::{is_capture, open_for};
use globalsplat_files::{Error, InputFiles, Result};
use serde_json::Value;
use std::path::Path;

/// A sequence of cameras to render from.
#[derive(Debug)]
pub struct CameraPath {
    /// Cameras in the order of the path, at least one.
    pub cameras: Vec<Camera>,
    /// Frame rate, if the file specifies one.
    pub frames_per_second: Option<u32>,
    /// Warnings of the capture, see [`Capture::warnings`](crate::Capture::warnings).
    pub warnings: Vec<String>,
    /// Files from which the cameras were read, and the existing photos of the capture.
    pub inputs: InputFiles,
}

/// Reads the cameras of a capture of any format that [`open_capture`](crate::open_capture) supports, or of a JSON file with any name.
///
/// The keys of a JSON file determine its format: with `camera_path` it is a path of nerfstudio's viewer, with `frames` a
/// `transforms.json`, and otherwise a `cameras.json`. Photos may be missing. `size` is the size of a missing photo if the capture doesn't
/// specify it.
///
/// # Errors
/// Fails like [`open_capture`](crate::open_capture).
pub fn read_camera_path(path: &Path, size: Option<ImageSize>) -> Result<CameraPath> {
    let purpose = Purpose::Cameras(size);
    let is_json =
        path.is_file() && path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
    // Invalid JSON is reported later, by the reader of the format.
    let json: Option<Value> = is_json.then(|| read_json(path, "", "").unwrap_or(Value::Null));
    let has_key = |key: &str| json.as_ref().is_some_and(|json| json.get(key).is_some());
    let capture = match (&json, is_capture(path)) {
        (Some(json), _) if has_key("camera_path") => return read_nerfstudio_path(path, json),
        (Some(_), false) if has_key("frames") => transforms_json::read(path, purpose)?,
        (Some(_), false) => cameras_json::read(path, purpose)?,
        _ => open_for(path, purpose)?,
    };
    let warnings = capture.warnings().to_vec();
    let mut inputs = InputFiles::default();
    capture.add_input_files(&mut inputs);
    Ok(CameraPath { cameras: capture.cameras(), frames_per_second: None, warnings, inputs })
}

/// Converts `json`, the contents of a `camera_path.json` at `file`.
fn read_nerfstudio_path(file: &Path, json: &Value) -> Result<CameraPath> {
    let invalid = |field: &str, found: Option<&Value>, expected: &str| {
        Error::input(file, field, describe_value(found), expected)
    };
    // Returns the number at `key` of `object`, which must be above `min` and below `max`.
    let number = |object: &Value, key: &str, field: &str, expected: &str, min: f64, max: f64| {
        let value = object.get(key);
        let number = value.and_then(Value::as_f64).filter(|number| *number > min && *number < max);
        number.ok_or_else(|| invalid(field, value, expected))
    };
    if let Some(kind) = json.get("camera_type").filter(|kind| *kind != "perspective") {
        return Err(invalid("camera_type", Some(kind), "\"perspective\""));
    }
    let side = |key: &str| {
        let side = json.get(key).and_then(Value::as_f64).filter(|side| side.fract() == 0. && *side >= 1.);
        let side = side.filter(|side| *side <= 16384.).map(|side| side as u32);
        side.ok_or_else(|| invalid(key, json.get(key), "a number of pixels, 1 to 16384"))
    };
    let (height, width) = (side("render_height")?, side("render_width")?);
    let entries = json.get("camera_path").and_then(Value::as_array).filter(|entries| !entries.is_empty());
    let entries =
        entries.ok_or_else(|| invalid("camera_path", json.get("camera_path"), "a list of cameras"))?;
    let camera = |(i, entry): (usize, &Value)| {
        let field = |key: &str| format!("{key} of camera {i}");
        let pose = entry.get("camera_to_world");
        let numbers = pose.and_then(Value::as_array).into_iter().flatten();
        let numbers: Vec<f64> = numbers.filter_map(Value::as_f64).collect();
        let invalid_pose = || invalid(&field("camera_to_world"), pose, "16 numbers");
        let c2w = from_opengl(numbers.as_slice().try_into().map_err(|_| invalid_pose())?);
        let (c2w, _) = nearest_rigid_of_scaled(&c2w)
            .map_err(|(found, expected)| Error::input(file, field("camera_to_world"), found, expected))?;
        let fov = number(entry, "fov", &field("fov"), "degrees between 0 and 180", 0., 180.)?;
        let (w, h) = (f64::from(width), f64::from(height));
        let focal = h / 2. / (fov.to_radians() / 2.).tan();
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2., cy: h / 2. };
        Ok(Camera { intrinsics, c2w, width, height })
    };
    let cameras = entries.iter().enumerate().map(camera).collect::<Result<Vec<_>>>()?;
    check_cameras(file, cameras.iter())?;
    let rate = match (json.get("fps"), json.get("seconds")) {
        (Some(_), _) => Some(number(json, "fps", "fps", "frames per second, 1 to 120", 0.5, 120.5)?),
        (None, Some(_)) => {
            let seconds = number(json, "seconds", "seconds", "a number above 0", 0., f64::INFINITY)?;
            Some((cameras.len() as f64 / seconds).clamp(1., 120.))
        }
        (None, None) => None,
    };
    let mut inputs = InputFiles::default();
    inputs.add(file);
    let frames_per_second = rate.map(|rate| rate.round() as u32);
    Ok(CameraPath { cameras, frames_per_second, warnings: vec![], inputs })
}
