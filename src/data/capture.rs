//! A capture: what every format on disk is read into.

use super::chunk::{self, Chunk, EncodedPhoto};
use super::distortion::Distortion;
use super::planes::Planes;
use super::preprocess::{ImageSize, fit};
use super::{cameras_json, colmap, transforms_json};
use crate::error::{Error, Result};
use crate::io;
use crate::scene::{Camera, check_pose};
use image::RgbImage;
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// A view without its pixels.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    pub photo: Photo,
    /// As the capture names the image.
    pub name: String,
    /// At the size of the file; a pinhole camera, which the image is once `distortion` is removed.
    pub camera: Camera,
    /// Of the lens that took the image in the file.
    pub distortion: Distortion,
}

/// Where a view's encoded image is.
#[derive(Debug, Clone)]
pub(super) enum Photo {
    /// An image file.
    File(PathBuf),
    /// A part of a chunk, and how errors call it.
    Encoded(EncodedPhoto, PathBuf),
}

impl Photo {
    /// As errors call it.
    fn file(&self) -> &Path {
        match self {
            Photo::File(path) | Photo::Encoded(_, path) => path,
        }
    }

    fn read(&self) -> Result<Cow<'_, [u8]>> {
        match self {
            Photo::File(path) => Ok(std::fs::read(path).map_err(Error::read(path))?.into()),
            Photo::Encoded(photo, _) => Ok(photo.bytes().into()),
        }
    }
}

/// Posed photos of one scene. The images are read when they are asked for.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The folder's name, or the key in a chunk.
    pub name: String,
    file: PathBuf,
    frames: Vec<Frame>,
}

/// A photo and where it was taken from.
#[derive(Debug)]
pub struct View {
    /// As the capture names the image.
    pub name: String,
    /// [3, H, W] in [0, 1].
    pub image: Tensor,
    /// At the size of `image`.
    pub camera: Camera,
}

/// What is expected where nothing known is found.
const KNOWN: &str =
    "a cameras.json, a transforms.json or a COLMAP model (sparse/0) in it, or a CHUNK.torch#KEY";

/// What a capture is read from.
enum Source {
    CamerasJson(PathBuf),
    TransformsJson(PathBuf),
    Colmap(colmap::Model),
    /// A chunk, and which of its scenes.
    Chunk(PathBuf, Option<String>),
}

/// The capture at `path`, a folder or the file that describes it; of several in a folder, the first of
/// [`open_capture`]'s list.
fn recognize(path: &Path) -> Option<Source> {
    if let Some((file, key)) = path.to_str().and_then(|path| path.rsplit_once('#'))
        && is_chunk(Path::new(file))
    {
        return Some(Source::Chunk(file.into(), Some(key.into())));
    }
    if path.is_file() {
        let name = path.file_name()?.to_str()?;
        return match name {
            _ if is_chunk(path) => Some(Source::Chunk(path.to_owned(), None)),
            cameras_json::FILE_NAME => Some(Source::CamerasJson(path.to_owned())),
            _ if name.starts_with("transforms") && name.ends_with(".json") => {
                Some(Source::TransformsJson(path.to_owned()))
            }
            _ => None,
        };
    }
    let file = |name: &str| Some(path.join(name)).filter(|file| file.is_file());
    file(cameras_json::FILE_NAME)
        .map(Source::CamerasJson)
        .or_else(|| file(transforms_json::FILE_NAME).map(Source::TransformsJson))
        .or_else(|| colmap::Model::find(path).map(Source::Colmap))
}

/// Whether `path` is a file of scenes, by its name.
fn is_chunk(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == chunk::EXTENSION) && path.is_file()
}

/// Opens whatever capture is at `path`; the format is recognized by what is on disk. In this order:
///
/// 1. a folder with a `cameras.json`, or that file;
/// 2. a folder with a nerfstudio or instant-ngp `transforms.json`, or that file, which may also be named
///    `transforms_train.json` and the like;
/// 3. a folder with a COLMAP model, binary or text, in `sparse/0`, `sparse`, `dense/0/sparse`, `dense/sparse` or the folder
///    itself, and the photos in `images` beside it;
/// 4. `CHUNK.torch#KEY`, a scene of a RealEstate10K-style chunk; `CHUNK.torch` where it has one alone.
///
/// Lens distortion is removed when the images are loaded, so every camera is a pinhole camera with OpenCV axes.
///
/// # Errors
/// Nothing that is known there, or a capture that breaks its format's rules.
pub fn open_capture(path: &Path) -> Result<Capture> {
    let source = recognize(path);
    if source.is_none() && !path.exists() {
        return Err(Error::Request(format!("{}: no such capture", path.display())));
    }
    match source {
        Some(Source::CamerasJson(file)) => cameras_json::read(&file),
        Some(Source::TransformsJson(file)) => transforms_json::read(&file),
        Some(Source::Colmap(model)) => colmap::read(path, &model),
        Some(Source::Chunk(file, Some(key))) => Chunk::read(&file)?.capture(&key),
        Some(Source::Chunk(file, None)) => Chunk::read(&file)?.only_capture(),
        None => Err(Error::input(path, "the capture", "of no known format", KNOWN)),
    }
}

/// The name of the last folder in `path`, which may be empty for the working directory.
pub(super) fn folder_name(path: &Path) -> String {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let folder = path.canonicalize().unwrap_or(path.to_owned());
    folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The cameras of a `cameras.json` without its images, as a path to render along.
///
/// # Errors
/// As [`open_capture`]; the images don't have to exist.
pub fn read_camera_path(file: &Path) -> Result<Vec<Camera>> {
    cameras_json::read_cameras(file)
}

/// How many folders deep captures are looked for.
const DEPTH: usize = 2;

/// Every capture in `path`: itself, or those in the folders up to two levels below it, in the order of their paths.
///
/// # Errors
/// A folder that can't be read or holds no capture.
pub fn find_captures(path: &Path) -> Result<Vec<Capture>> {
    capture_folders(path)?.iter().map(|folder| open_capture(folder)).collect()
}

/// Where [`find_captures`] finds them.
pub(super) fn capture_folders(path: &Path) -> Result<Vec<PathBuf>> {
    let mut folders = vec![];
    collect_folders(path, DEPTH, &mut folders)?;
    if folders.is_empty() {
        let expected = format!("{KNOWN} or in folders below it");
        return Err(Error::input(path, "the folder", "without captures", expected));
    }
    folders.sort();
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

impl Capture {
    /// Checks what every format has to hold: two views, rigid poses, sensible intrinsics.
    pub(super) fn new(name: String, file: PathBuf, frames: Vec<Frame>) -> Result<Self> {
        if frames.len() < 2 {
            return Err(Error::input(&file, "the number of views", frames.len(), "two or more"));
        }
        check_cameras(&file, frames.iter().map(|frame| &frame.camera))?;
        Ok(Capture { name, file, frames })
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Never: a capture has two views at least.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The file that describes the capture.
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// The cameras, at the sizes of the files.
    pub fn cameras(&self) -> Vec<Camera> {
        self.frames.iter().map(|frame| frame.camera).collect()
    }

    /// The images' names, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.frames.iter().map(|frame| frame.name.as_str())
    }

    /// Reads the views of `indices`, fitted to `size`, or as they are.
    ///
    /// # Errors
    /// An image that is missing, can't be decoded, or has another size than the capture declares.
    pub fn load(&self, indices: &[usize], size: Option<ImageSize>) -> Result<Vec<View>> {
        indices.iter().map(|&index| self.load_view(&self.frames[index], size)).collect()
    }

    /// [`Capture::load`] of every view.
    ///
    /// # Errors
    /// As there.
    pub fn load_all(&self, size: Option<ImageSize>) -> Result<Vec<View>> {
        self.frames.iter().map(|frame| self.load_view(frame, size)).collect()
    }

    fn load_view(&self, frame: &Frame, size: Option<ImageSize>) -> Result<View> {
        let image = self.read_photo(frame)?;
        let (planes, camera) = match size {
            Some(size) => fit(&image, &frame.camera, size),
            None => (Planes::from_rgb(&image), frame.camera),
        };
        Ok(View { name: frame.name.clone(), image: planes.to_tensor(), camera })
    }

    /// The photo of view `index` at its camera's size, lens distortion removed.
    ///
    /// # Errors
    /// As [`Capture::load`].
    pub(super) fn photo(&self, index: usize) -> Result<RgbImage> {
        self.read_photo(&self.frames[index])
    }

    fn read_photo(&self, frame: &Frame) -> Result<RgbImage> {
        let photo = self.decode(frame, &frame.photo.read()?)?;
        Ok(frame.distortion.remove(photo.pixels, &frame.camera.intrinsics))
    }

    fn decode(&self, frame: &Frame, encoded: &[u8]) -> Result<io::Photo> {
        let Camera { width, height, .. } = frame.camera;
        let photo = io::decode_photo(encoded, frame.photo.file(), (width, height))?;
        if photo.pixels.dimensions() == (width, height) {
            return Ok(photo);
        }
        let found = format!("{}×{} pixels", photo.pixels.width(), photo.pixels.height());
        let expected = format!("{width}×{height} as in {}", self.file.display());
        Err(Error::input(frame.photo.file(), "the image", found, expected))
    }

    /// The image file of view `index` as a pinhole camera would have written it: its own bytes where it is 8-bit RGB, upright
    /// and free of distortion.
    pub(super) fn encoded(&self, index: usize) -> Result<Vec<u8>> {
        let frame = &self.frames[index];
        let bytes = frame.photo.read()?;
        let photo = self.decode(frame, &bytes)?;
        if photo.as_stored && frame.distortion == Distortion::default() {
            return Ok(bytes.into_owned());
        }
        let pixels = frame.distortion.remove(photo.pixels, &frame.camera.intrinsics);
        io::encode_photo(&pixels, photo.is_jpeg)
    }
}

/// Rigid poses and sensible intrinsics.
pub(super) fn check_cameras<'a>(file: &Path, cameras: impl Iterator<Item = &'a Camera>) -> Result<()> {
    for (i, camera) in cameras.enumerate() {
        let field = |name: String| format!("{name} of view {i}");
        check_pose(&camera.c2w)
            .map_err(|(found, expected)| Error::input(file, field("c2w".into()), found, expected))?;
        camera
            .intrinsics
            .check(camera.width, camera.height)
            .map_err(|(name, found, expected)| Error::input(file, field(name), found, expected))?;
    }
    Ok(())
}
