//! Opening captures, whose format the files on disk tell, and finding them in folders.

use crate::capture::{Capture, Purpose};
#[cfg(feature = "chunks")]
use crate::formats::chunk;
use crate::formats::{CaptureOpener, cameras_json, colmap, llff, polycam, transforms_json};
use crate::photos::natural_order;
use globalsplat_files::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Function that looks for a capture of one format at a path: a folder, or the file that describes the capture.
type Format = fn(&Path) -> Option<CaptureOpener>;

/// All formats in order of preference. If several match a folder, the first that can be read is used.
const FORMATS: &[Format] = &[
    #[cfg(feature = "chunks")]
    chunk::find,
    cameras_json::find,
    transforms_json::find,
    colmap::find,
    polycam::find,
    llff::find,
];

/// Description of the supported formats for error messages.
const SUPPORTED_FORMATS: &str = "a cameras.json, a transforms.json or a transforms_train.json in it, a COLMAP model (cameras and images, both \
                     .bin or both .txt) in it or in its sparse, sparse/0, colmap/sparse/0, dense/sparse or dense/0/sparse, \
                     Polycam's keyframes/cameras, LLFF's poses_bounds.npy, or a CHUNK.torch#KEY";

/// Number of bytes in which the text of [`OTHER_POSES`] is looked for.
const OTHER_POSES_BYTES: u64 = 4096;

/// Files of poses that aren't read, though the programs that write them may export the poses for COLMAP: extension, text near the beginning
/// in lower case, without white space and with `,` for `;`, program, and its export.
const OTHER_POSES: [(&str, &str, &str, &str); 7] = [
    ("xml", "<chunk", "Metashape", "its COLMAP export (File > Export > Export Cameras, Colmap)"),
    ("xml", "<blocksexchange", "ContextCapture", "the COLMAP export of the program that wrote it"),
    ("csv", "name,x,y,alt", "RealityCapture", "its COLMAP export (Alignment > Export > Registration)"),
    ("xmp", "xcr:", "RealityCapture", "its COLMAP export (Alignment > Export > Registration)"),
    ("json", "[{\"cameras\":{", "OpenSfM", "its COLMAP export (opensfm export_colmap)"),
    ("out", "#bundlefile", "Bundler", "the COLMAP export of the program that wrote it"),
    ("nvm", "nvm_v3", "VisualSFM", "the COLMAP export of the program that wrote it"),
];

/// Returns `true` if a capture is at `path`, judging by file names alone.
pub fn is_capture(path: &Path) -> bool {
    FORMATS.iter().any(|find| find(path).is_some())
}

/// Opens the capture at `path`. The format is recognized by the files on disk, in this order:
///
/// 1. `CHUNK.torch#KEY`, a scene of a RealEstate10K-style chunk, or `CHUNK.torch` if it holds a single scene;
/// 2. a folder with a `cameras.json`, or that file;
/// 3. a folder with a nerfstudio or instant-ngp `transforms.json`, or that file, which may also be named `transforms_train.json` or
///    similar; or a folder with NeRF's `transforms_train.json` and `transforms_test.json`, whose views [`Capture::split`] holds
///    out;
/// 4. a folder with a COLMAP model, binary or text, in `sparse/0`, `sparse`, `colmap/sparse/0`, `dense/0/sparse`, `dense/sparse` or
///    the folder itself, and the photos in `images` next to it, or in the folder itself. If there are several models, the one with
///    the most photos;
/// 5. a folder with Polycam's raw data, `keyframes`, or this folder;
/// 6. a folder with LLFF's `poses_bounds.npy` and `images`, or `images_N` of reduced photos, or that file.
///
/// If several formats match, the first that can be read is used. Missing photos are left out, and cameras are scaled to photos
/// whose size differs from the declared one. [`Capture::warnings`] lists everything that is left out or changed.
///
/// Lens distortion is removed when the images are loaded, so every camera is a pinhole camera with OpenCV axes. A photo of a fisheye
/// or of 360 degrees may become several views.
///
/// ```no_run
/// use globalsplat_capture::open_capture;
/// use std::path::Path;
///
/// # fn main() -> globalsplat_capture::Result<()> {
/// let capture = open_capture(Path::new("captures/room"))?;
/// for (name, camera) in capture.names().zip(capture.cameras()) {
///     println!("{name}: {}×{} pixels at {}", camera.width, camera.height, camera.c2w.w_axis);
/// }
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Fails if nothing of a known format is at `path`, or if a capture violates its format.
pub fn open_capture(path: &Path) -> Result<Capture> {
    open_for(path, Purpose::Photos)
}

pub(crate) fn open_for(path: &Path, purpose: Purpose) -> Result<Capture> {
    let mut refusals = vec![];
    for read in FORMATS.iter().filter_map(|find| find(path)) {
        match read(purpose) {
            Ok(capture) => {
                let taken = capture.file().display().to_string();
                let lines = refusals.iter().map(|why| format!("{why}; {taken} is read instead"));
                return Ok(capture.with_warnings(lines.collect()));
            }
            Err(why) if why.is_invalid_request() => refusals.push(why),
            Err(why) => return Err(why),
        }
    }
    let poses = other_poses(path);
    let refusal = match (refusals.len(), &poses) {
        (0, _) if !path.exists() => Error::request(format!("{}: no such capture", path.display())),
        (0, None) => Error::input(path, "the capture", "of no known format", SUPPORTED_FORMATS),
        (0, Some(_)) => Error::request(format!("{}: the capture is of no known format", path.display())),
        (1, _) => refusals.remove(0),
        _ => {
            let reasons = refusals.iter().map(Error::to_string).collect::<Vec<_>>().join("; ");
            Error::request(format!("{}: none of its formats can be read: {reasons}", path.display()))
        }
    };
    let Some((file, program, export)) = poses else { return Err(refusal) };
    let advice = format!("expected {export}, or photos alone for `globalsplat capture`");
    Err(Error::request(format!("{refusal}, and {} has poses of {program}, {advice}", file.display())))
}

/// Returns the file of another program's poses that is at `path`, in this folder, or one level below, with the program and its export.
fn other_poses(path: &Path) -> Option<(PathBuf, &'static str, &'static str)> {
    let entries = |folder: &PathBuf| {
        std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
    };
    let path = path.to_owned();
    let top: Vec<PathBuf> = entries(&path).chain([path.clone()]).collect();
    let mut files: Vec<PathBuf> = top.iter().flat_map(entries).chain(top.clone()).collect();
    files.retain(|file| file.is_file());
    files.sort_by(natural_order);
    files.into_iter().find_map(|file| {
        let extension = file.extension()?.to_ascii_lowercase();
        let mut known = OTHER_POSES.iter().filter(|(known, ..)| extension == *known).peekable();
        known.peek()?;
        let mut start = vec![];
        File::open(&file).ok()?.take(OTHER_POSES_BYTES).read_to_end(&mut start).ok()?;
        let start =
            String::from_utf8_lossy(&start).to_lowercase().replace(char::is_whitespace, "").replace(';', ",");
        let (.., program, export) = known.find(|(_, text, ..)| start.contains(text))?;
        Some((file, *program, *export))
    })
}

/// Maximum depth of folders that are searched for captures.
const DEPTH: usize = 2;

/// Captures found below a folder.
#[derive(Debug, Default)]
pub struct FoundCaptures {
    /// Paths to open, with numbers in paths compared by value.
    pub paths: Vec<PathBuf>,
    /// Warnings about folders that couldn't be read, one line each.
    pub warnings: Vec<String>,
}

/// Finds every capture in `path`: `path` itself, or those in folders up to two levels below it. Skips hidden folders, such as those
/// left by interrupted work, and folders that can't be read.
///
/// # Errors
/// Fails if `path` can't be read or holds no capture.
pub fn find_captures(path: &Path) -> Result<FoundCaptures> {
    let mut found = FoundCaptures::default();
    found.collect(path, DEPTH)?;
    if found.paths.is_empty() {
        let unread = found.warnings.first().map_or(String::new(), |line| format!(" ({line})"));
        let expected = format!("{SUPPORTED_FORMATS}; or folders with such, up to {DEPTH} levels below it");
        return Err(Error::input(path, "the folder", format!("without captures{unread}"), expected));
    }
    found.paths.sort_by(natural_order);
    Ok(found)
}

impl FoundCaptures {
    fn collect(&mut self, path: &Path, depth: usize) -> Result<()> {
        if is_capture(path) {
            self.paths.push(path.to_owned());
            return Ok(());
        }
        if depth == 0 {
            return Ok(());
        }
        for entry in std::fs::read_dir(path).map_err(Error::read(path))? {
            let entry = entry.map_err(Error::read(path))?;
            let is_hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
            if !is_hidden && entry.path().is_dir() {
                let below = self.collect(&entry.path(), depth - 1);
                self.warnings.extend(below.err().map(|why| format!("{why}, and is left out")));
            }
        }
        Ok(())
    }
}
