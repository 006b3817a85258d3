//! Reader and writer of `cameras.json` folders: {"image_shape": [H, W], "views": [{"image", "intrinsic" 3×3 in pixels, "c2w" 4×4}]}
//! (spec 10.2). `c2w` is the camera-to-world matrix, row by row, of a camera with OpenCV axes: x right, y down, z forward.

use super::{CaptureOpener, file_in, folder_name, read_json};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose};
use crate::geometry::{Camera, Intrinsics, pose_to_rows};
use crate::photos::{find_photos, portable};
use glam::DMat4;
use globalsplat_files::{Error, Result, parent_of, write_json};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// File name that identifies a capture of this format.
const FILE_NAME: &str = "cameras.json";

/// Maximum skew of an intrinsic matrix, relative to its larger focal length. Less than that moves no pixel as far as usual errors of poses
/// do, and is ignored.
const MAX_SKEW: f64 = 1e-3;
/// Maximum rounding error in the last row of an intrinsic matrix.
const MAX_ROUNDING: f64 = 1e-6;

#[derive(Serialize, Deserialize)]
struct CamerasFile {
    image_shape: [u32; 2],
    views: Vec<ViewEntry>,
}

#[derive(Serialize, Deserialize)]
struct ViewEntry {
    /// Path of the photo, relative to the file's folder. It may be absent in a camera path, which needs no photos.
    #[serde(default)]
    image: String,
    intrinsic: Vec<Vec<NullableNumber>>,
    c2w: Vec<Vec<NullableNumber>>,
}

/// A number or null. Python writes NaN and Infinity, which JSON lacks: they are read as null, and the checks on cameras report
/// them.
type NullableNumber = Option<f64>;

/// Recognizes a folder that contains a `cameras.json`, or that file itself.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let is_cameras_file = path.is_file() && path.file_name().is_some_and(|name| name == FILE_NAME);
    let file = if is_cameras_file { path.to_owned() } else { file_in(path, FILE_NAME)? };
    Some(Box::new(move |purpose| read(&file, purpose)))
}

/// Reads the capture that `file` describes. Views keep the order of the file. For [`Purpose::Photos`], views whose photo is missing
/// are left out and reported as a warning; for [`Purpose::Cameras`], photos need not exist.
pub(crate) fn read(file: &Path, purpose: Purpose) -> Result<Capture> {
    let expected = "{\"image_shape\": [H, W], \"views\": [{\"image\", \"intrinsic\", \"c2w\"}]}";
    let parsed: CamerasFile = read_json(file, "not a description of cameras", expected)?;
    let root = parent_of(file);
    let cameras = to_cameras(file, &parsed)?;
    let names: Vec<&str> = parsed.views.iter().map(|view| view.image.as_str()).collect();
    let photos = find_photos(&[root.to_owned()], &names);
    let (mut frames, mut changes) = (vec![], Changes::default());
    for ((name, photo), camera) in names.into_iter().zip(photos).zip(cameras) {
        let Some(photo) = changes.photo(name, photo, purpose, root.join(name)) else { continue };
        let camera = Camera { c2w: changes.remove_scale(name, camera.c2w), ..camera };
        frames.push(Frame::pinhole(ImageLocation::File(photo), portable(name), camera));
    }
    Capture::new(folder_name(root), file.to_owned(), frames, changes, purpose)
}

/// Writes a `cameras.json` at `file`. `images` are the photos of `cameras`, as paths relative to the file's folder.
///
/// # Errors
/// Fails if the file can't be written.
///
/// # Panics
/// Panics if the numbers of images and cameras differ, or the cameras' image sizes do.
pub fn write_cameras_json(file: &Path, images: &[String], cameras: &[Camera]) -> Result<()> {
    assert_eq!(images.len(), cameras.len(), "each camera needs one image");
    let image_shape = cameras.first().map_or([0, 0], |camera| [camera.height, camera.width]);
    assert!(
        cameras.iter().all(|camera| [camera.height, camera.width] == image_shape),
        "all cameras must have the same image size"
    );
    let views = images.iter().zip(cameras).map(|(image, camera)| ViewEntry {
        image: image.clone(),
        intrinsic: rows(&camera.intrinsics.to_rows(), 3),
        c2w: rows(&pose_to_rows(&camera.c2w), 4),
    });
    let contents = CamerasFile { image_shape, views: views.collect() };
    write_json(file, &contents)
}

fn rows(values: &[f64], width: usize) -> Vec<Vec<NullableNumber>> {
    values.chunks(width).map(|row| row.iter().copied().map(Some).collect()).collect()
}

fn to_cameras(file: &Path, parsed: &CamerasFile) -> Result<Vec<Camera>> {
    let [height, width] = parsed.image_shape;
    if width == 0 || height == 0 {
        return Err(Error::input(
            file,
            "image_shape",
            format!("[{height}, {width}]"),
            "a height and a width above 0",
        ));
    }
    let matrix = |rows: &[Vec<NullableNumber>], size: usize, field: String| -> Result<Vec<f64>> {
        if rows.len() != size || rows.iter().any(|row| row.len() != size) {
            let found =
                format!("{} rows of {:?} numbers", rows.len(), rows.iter().map(Vec::len).collect::<Vec<_>>());
            return Err(Error::input(file, field, found, format!("a {size}×{size} matrix")));
        }
        Ok(rows.iter().flatten().map(|v| v.unwrap_or(f64::NAN)).collect())
    };
    parsed
        .views
        .iter()
        .enumerate()
        .map(|(i, view)| {
            let k = matrix(&view.intrinsic, 3, format!("intrinsic of view {i}"))?;
            let are_within = |values: &[f64], most: f64| values.iter().all(|value| value.abs() <= most);
            // NaN is within nothing.
            let has_skew = !are_within(&[k[1], k[3]], MAX_SKEW * k[0].abs().max(k[4].abs()));
            if has_skew || !are_within(&[k[6], k[7], k[8] - 1.], MAX_ROUNDING) {
                let found = format!("{:?}", k.chunks(3).collect::<Vec<_>>());
                let expected = "no skew and [0, 0, 1] as the last row";
                return Err(Error::input(file, format!("intrinsic of view {i}"), found, expected));
            }
            let c2w = matrix(&view.c2w, 4, format!("c2w of view {i}"))?;
            let intrinsics = Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
            Ok(Camera { intrinsics, c2w: DMat4::from_cols_slice(&c2w).transpose(), width, height })
        })
        .collect()
}
