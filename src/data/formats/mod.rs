//! Formats of captures on disk: a file a format, and a line in [`FORMATS`], by which captures are recognized.

mod camera_path;
mod cameras_json;
mod chunk;
mod colmap;
mod json;
mod natural;
mod transforms_json;

pub use camera_path::{CameraPath, read_camera_path};
pub use cameras_json::write_cameras_json;
pub use chunk::{Chunk, ChunkWriter, INDEX_FILE};
pub use colmap::{Point, points_of};

use super::capture::{Capture, Purpose};
use crate::error::{Error, Result};
use natural::natural_order;
use std::path::{Path, PathBuf};

/// Looks for a capture of one format at a path, a folder or the file that describes it.
type Format = fn(&Path) -> Option<Found>;

/// Reads the capture that was found.
type Found = Box<dyn FnOnce(Purpose) -> Result<Capture>>;

/// Of several in a folder, the first is taken.
const FORMATS: [Format; 4] = [chunk::find, cameras_json::find, transforms_json::find, colmap::find];

/// What is expected where nothing known is found.
const KNOWN: &str =
    "a cameras.json, a transforms.json or a COLMAP model (sparse/0) in it, or a CHUNK.torch#KEY";

fn recognize(path: &Path) -> Option<Found> {
    FORMATS.iter().find_map(|find| find(path))
}

/// The file `name` that describes a capture, where `path` is the capture's folder.
fn file_in(path: &Path, name: &str) -> Option<PathBuf> {
    Some(path.join(name)).filter(|file| file.is_file())
}

/// Opens whatever capture is at `path`; the format is recognized by what is on disk. In this order:
///
/// 1. `CHUNK.torch#KEY`, a scene of a RealEstate10K-style chunk; `CHUNK.torch` where it has one alone;
/// 2. a folder with a `cameras.json`, or that file;
/// 3. a folder with a nerfstudio or instant-ngp `transforms.json`, or that file, which may also be named
///    `transforms_train.json` and the like;
/// 4. a folder with a COLMAP model, binary or text, in `sparse/0`, `sparse`, `dense/0/sparse`, `dense/sparse` or the folder
///    itself, and the photos in `images` beside it.
///
/// Lens distortion is removed when the images are loaded, so every camera is a pinhole camera with OpenCV axes.
///
/// # Errors
/// Nothing that is known there, or a capture that breaks its format's rules.
pub fn open_capture(path: &Path) -> Result<Capture> {
    open_for(path, Purpose::Photos)
}

fn open_for(path: &Path, purpose: Purpose) -> Result<Capture> {
    match recognize(path) {
        Some(read) => read(purpose),
        None if !path.exists() => Err(Error::Request(format!("{}: no such capture", path.display()))),
        None => Err(Error::input(path, "the capture", "of no known format", KNOWN)),
    }
}

/// The name of the last folder in `path`, which may be empty for the working directory.
pub(in crate::data) fn folder_name(path: &Path) -> String {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let folder = path.canonicalize().unwrap_or(path.to_owned());
    folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// How many folders deep captures are looked for.
const DEPTH: usize = 2;

/// Every capture in `path`: itself, or those in the folders up to two levels below it, in the order of their paths, numbers in
/// them by value.
///
/// # Errors
/// A folder that can't be read or holds no capture.
pub fn find_captures(path: &Path) -> Result<Vec<Capture>> {
    capture_folders(path)?.iter().map(|folder| open_capture(folder)).collect()
}

/// Where [`find_captures`] finds them.
pub(in crate::data) fn capture_folders(path: &Path) -> Result<Vec<PathBuf>> {
    let mut folders = vec![];
    collect_folders(path, DEPTH, &mut folders)?;
    if folders.is_empty() {
        let expected = format!("{KNOWN} or in folders below it");
        return Err(Error::input(path, "the folder", "without captures", expected));
    }
    folders.sort_by(natural_order);
    Ok(folders)
}

fn collect_folders(path: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<()> {
    if recognize(path).is_some() {
        found.push(path.to_owned());
    } else if depth > 0 {
        for entry in std::fs::read_dir(path).map_err(Error::read(path))? {
            let below = entry.map_err(Error::read(path))?.path();
            if below.is_dir() {
                collect_folders(&below, depth - 1, found)?;
            }
        }
    }
    Ok(())
}
