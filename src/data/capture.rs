//! A capture: what every format on disk is read into.

use super::cameras_json;
use super::preprocess::{ImageSize, fit};
use crate::error::{Error, Result};
use crate::io::{read_image, tensor_from_rgb};
use crate::scene::{Camera, check_pose};
use std::path::{Path, PathBuf};
use tch::Tensor;

/// A view without its pixels.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    /// The image file.
    pub image: PathBuf,
    /// As the capture names the image.
    pub name: String,
    /// At the size of the file.
    pub camera: Camera,
}

/// Posed photos of one scene. The images are read when they are asked for.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The folder's name.
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

/// Opens whatever capture is at `path`; the format is recognized by what is on disk.
///
/// # Errors
/// Nothing that is known there, or a capture that breaks its format's rules.
pub fn open_capture(path: &Path) -> Result<Capture> {
    if !path.exists() {
        return Err(Error::Request(format!("{}: no such capture", path.display())));
    }
    match cameras_file(path) {
        Some(file) => cameras_json::read(&file),
        None => Err(Error::input(path, "the capture", "of no known format", "a folder with a cameras.json")),
    }
}

/// The cameras of a capture file without its images, as a path to render along.
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
    let mut folders = vec![];
    collect_folders(path, DEPTH, &mut folders)?;
    if folders.is_empty() {
        return Err(Error::input(path, "the folder", "without captures", "folders with a cameras.json"));
    }
    folders.sort();
    folders.iter().map(|folder| open_capture(folder)).collect()
}

fn collect_folders(path: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<()> {
    if cameras_file(path).is_some() {
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

fn cameras_file(path: &Path) -> Option<PathBuf> {
    let file = if path.is_dir() { path.join(cameras_json::FILE_NAME) } else { path.to_owned() };
    (file.is_file() && file.file_name().is_some_and(|name| name == cameras_json::FILE_NAME)).then_some(file)
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
        let image = read_image(&frame.image)?;
        let Camera { width, height, .. } = frame.camera;
        if image.dimensions() != (width, height) {
            let found = format!("{}×{} pixels", image.width(), image.height());
            return Err(Error::input(
                &frame.image,
                "the image",
                found,
                format!("{width}×{height} as in {}", self.file.display()),
            ));
        }
        let (image, camera) = match size {
            Some(size) => fit(image, &frame.camera, size),
            None => (image, frame.camera),
        };
        Ok(View { name: frame.name.clone(), image: tensor_from_rgb(&image), camera })
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
