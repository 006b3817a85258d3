//! Reader and writer of `cameras.json` folders: {"image_shape": [H, W], "views": [{"image", "intrinsic" 3×3 in pixels, "c2w" 4×4}]}
//! (spec 10.2).

use super::json::replace_nan_with_null;
use super::photos::{find_photos, portable};
use super::{CaptureOpener, file_in, folder_name};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose};
use crate::geometry::{Camera, Intrinsics, pose_to_rows};
use crate::lens::LensModel;
use glam::DMat4;
use globalsplat_files::{Error, Result, read_text, write_json};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// File name that identifies a capture of this format.
const FILE_NAME: &str = "cameras.json";

#[derive(Serialize, Deserialize)]
struct File {
    image_shape: [u32; 2],
    views: Vec<ViewEntry>,
}

#[derive(Serialize, Deserialize)]
struct ViewEntry {
    #[serde(default)]
    image: String,
    intrinsic: Vec<Vec<Number>>,
    c2w: Vec<Vec<Number>>,
}

/// A number or null. Python writes NaN and Infinity, which JSON lacks: they are read as null, and the checks on cameras report
/// them.
type Number = Option<f64>;

/// Recognizes a folder that contains a `cameras.json`, or that file itself.
pub(super) fn find(path: &Path) -> Option<CaptureOpener> {
    let itself = path.is_file() && path.file_name().is_some_and(|name| name == FILE_NAME);
    let file = if itself { path.to_owned() } else { file_in(path, FILE_NAME)? };
    Some(Box::new(move |purpose| read(&file, purpose)))
}

/// Reads the capture that `file` describes. Views keep the order of the file, whatever their names. Views with a missing photo are
/// left out.
pub(super) fn read(file: &Path, purpose: Purpose) -> Result<Capture> {
    let parsed = parse(file)?;
    let root = file.parent().unwrap_or(Path::new("."));
    let cameras = cameras(file, &parsed)?;
    let names: Vec<&str> = parsed.views.iter().map(|view| view.image.as_str()).collect();
    let photos = find_photos(&[root.to_owned()], &names);
    let (mut frames, mut changes) = (vec![], Changes::default());
    for ((name, photo), camera) in names.into_iter().zip(photos).zip(cameras) {
        let photo = match (photo, purpose) {
            (Some(photo), _) => photo,
            (None, Purpose::Cameras(_)) => root.join(name),
            (None, Purpose::Photos) => {
                changes.missing.push(name.to_string());
                continue;
            }
        };
        let camera = Camera { c2w: changes.remove_scale(name, camera.c2w), ..camera };
        let name = portable(name);
        frames.push(Frame {
            image: ImageLocation::File(photo),
            name,
            camera,
            mask: None,
            lens: LensModel::default(),
        });
    }
    Capture::new(folder_name(root), file.to_owned(), frames, changes, purpose)
}

/// Writes a `cameras.json` at `file`. `images` are paths relative to its folder. All cameras must have the same size.
///
/// # Errors
/// Fails if the file can't be written.
pub fn write_cameras_json(file: &Path, images: &[String], cameras: &[Camera]) -> Result<()> {
    let views = images.iter().zip(cameras).map(|(image, camera)| ViewEntry {
        image: image.clone(),
        intrinsic: rows(&camera.intrinsics.to_rows(), 3),
        c2w: rows(&pose_to_rows(&camera.c2w), 4),
    });
    let image_shape = cameras.first().map_or([0, 0], |camera| [camera.height, camera.width]);
    let contents = File { image_shape, views: views.collect() };
    write_json(file, &contents)
}

fn rows(values: &[f64], width: usize) -> Vec<Vec<Number>> {
    values.chunks(width).map(|row| row.iter().copied().map(Some).collect()).collect()
}

fn parse(file: &Path) -> Result<File> {
    let text = read_text(file)?;
    serde_json::from_str(&replace_nan_with_null(&text)).map_err(|e| {
        let expected = "{\"image_shape\": [H, W], \"views\": [{\"image\", \"intrinsic\", \"c2w\"}]}";
        Error::input(file, "the file", format!("not a description of cameras ({e})"), expected)
    })
}

fn cameras(file: &Path, parsed: &File) -> Result<Vec<Camera>> {
    let [height, width] = parsed.image_shape;
    if width == 0 || height == 0 {
        return Err(Error::input(
            file,
            "image_shape",
            format!("[{height}, {width}]"),
            "a height and a width",
        ));
    }
    let matrix = |rows: &[Vec<Number>], size: usize, field: String| -> Result<Vec<f64>> {
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
            let c2w = matrix(&view.c2w, 4, format!("c2w of view {i}"))?;
            Ok(Camera {
                intrinsics: Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] },
                c2w: DMat4::from_cols_slice(&c2w).transpose(),
                width,
                height,
            })
        })
        .collect()
}
