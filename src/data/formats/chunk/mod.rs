//! Chunks of RealEstate10K, ACID and DL3DV: `*.torch`, a torch.save file with a list of posed videos, each a dict {"key",
//! "url", "timestamps", "cameras" [n, 18], "images": n encoded images} (spec 10.7).

mod scenes;
mod write;

pub use write::{ChunkWriter, INDEX_FILE};

use super::Found;
use crate::data::capture::{Capture, Changes, Frame, Photo, Purpose};
use crate::data::pixels::Distortion;
use crate::error::{Error, Result};
use crate::io::{Archive, encoded_image_size, files_and_keys};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat4, DVec4};
use scenes::{Scene, scenes};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The ending of a chunk's name.
const EXTENSION: &str = "torch";
/// Numbers of a camera: f_x, f_y, c_x, c_y of the image's width and height, 0, 0, w2c's first three rows.
const CAMERA_NUMBERS: usize = 18;

/// A chunk in memory, images still encoded.
#[derive(Debug, Clone)]
pub struct Chunk {
    file: PathBuf,
    bytes: Arc<Vec<u8>>,
    scenes: Vec<Scene>,
}

/// `CHUNK.torch#KEY`, or `CHUNK.torch` with one scene alone.
pub(super) fn find(path: &Path) -> Option<Found> {
    if let Some((file, key)) = files_and_keys(path).find(|(file, _)| is_chunk(file)) {
        return Some(Box::new(move |purpose| Chunk::read(&file)?.capture_for(&key, purpose)));
    }
    let file = is_chunk(path).then(|| path.to_owned())?;
    Some(Box::new(move |purpose| Chunk::read(&file)?.only_capture(purpose)))
}

/// Whether `path` is a file of scenes, by its name.
fn is_chunk(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == EXTENSION) && path.is_file()
}

impl Chunk {
    /// Reads a chunk, runs nothing that it holds, and believes nothing that it says about sizes.
    ///
    /// # Errors
    /// A file that can't be read, is damaged, or holds anything but scenes.
    pub fn read(file: &Path) -> Result<Self> {
        Self::parse(file, std::fs::read(file).map_err(Error::read(file))?)
    }

    /// [`Chunk::read`] of the bytes that `file` holds.
    ///
    /// # Errors
    /// As there.
    pub fn parse(file: &Path, bytes: Vec<u8>) -> Result<Self> {
        let archive = Archive::open(file, &bytes)?;
        let expected = "a list of scenes, of tensors, lists, dicts, strings and numbers alone";
        let scenes =
            scenes(&bytes, &archive).map_err(|found| Error::input(file, "data.pkl", found, expected))?;
        Ok(Chunk { file: file.to_owned(), bytes: Arc::new(bytes), scenes })
    }

    /// The scenes' names, in order.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.scenes.iter().map(|scene| scene.key.as_str())
    }

    /// The scene `key`.
    ///
    /// # Errors
    /// No such scene, or one that breaks what every capture has to hold.
    pub fn capture(&self, key: &str) -> Result<Capture> {
        self.capture_for(key, Purpose::Photos)
    }

    fn capture_for(&self, key: &str, purpose: Purpose) -> Result<Capture> {
        match self.scenes.iter().find(|scene| scene.key == key) {
            Some(scene) => self.capture_of(scene, purpose),
            None => Err(Error::input(
                &self.file,
                "the scene",
                format!("{key:?}, which is not there"),
                self.choice(),
            )),
        }
    }

    /// The scene of a chunk that has one alone.
    ///
    /// # Errors
    /// More scenes, or none; otherwise as [`Chunk::capture`].
    fn only_capture(&self, purpose: Purpose) -> Result<Capture> {
        match self.scenes.as_slice() {
            [scene] => self.capture_of(scene, purpose),
            scenes => {
                let file = self.file.display();
                Err(Error::Request(format!(
                    "{file}: it holds {} scenes, expected {file}#KEY with {}",
                    scenes.len(),
                    self.choice()
                )))
            }
        }
    }

    /// Which scenes there are, for an error.
    fn choice(&self) -> String {
        const SHOWN: usize = 8;
        let keys: Vec<&str> = self.keys().take(SHOWN).collect();
        let more = if self.scenes.len() > SHOWN { ", …" } else { "" };
        format!("one of its {}: {}{more}", self.scenes.len(), keys.join(", "))
    }

    fn capture_of(&self, scene: &Scene, purpose: Purpose) -> Result<Capture> {
        let named = PathBuf::from(format!("{}#{}", self.file.display(), scene.key));
        // A frame that is damaged is found when it is loaded; until then it is as large as the others.
        let sizes: Vec<_> =
            scene.images.iter().map(|image| encoded_image_size(&self.bytes[image.clone()])).collect();
        let undecodable = || Error::input(&named, "every image", "undecodable", "a JPEG or PNG");
        let told = sizes.iter().flatten().next().copied().ok_or_else(undecodable);
        let usual = purpose.size(&named, "the images", told)?;
        let cameras = scene.cameras(&self.bytes);
        let frames = scene
            .images
            .iter()
            .cloned()
            .zip(cameras.chunks_exact(CAMERA_NUMBERS))
            .zip(&sizes)
            .enumerate()
            .map(|(index, ((bytes, numbers), size))| {
                let name = format!("{index:06}");
                let camera = camera(numbers, size.unwrap_or(usual));
                let photo = Photo::Part { file: self.bytes.clone(), bytes, name: named.join(&name) };
                Frame { photo, name, camera, distortion: Distortion::default() }
            });
        Capture::new(scene.key.clone(), named.clone(), frames.collect(), Changes::default(), purpose)
    }
}

/// From a chunk's numbers and (width, height).
fn camera(numbers: &[f32], (width, height): (u32, u32)) -> Camera {
    let at = |i: usize| f64::from(numbers[i]);
    let (w, h) = (f64::from(width), f64::from(height));
    let row = |i: usize| DVec4::new(at(i), at(i + 1), at(i + 2), at(i + 3));
    let w2c = DMat4::from_cols(row(6), row(10), row(14), DVec4::W).transpose();
    let intrinsics = Intrinsics { fx: at(0) * w, fy: at(1) * h, cx: at(2) * w, cy: at(3) * h };
    Camera { intrinsics, c2w: w2c.inverse(), width, height }
}

/// What [`camera`] reads.
fn camera_numbers(camera: &Camera) -> [f32; CAMERA_NUMBERS] {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let k = camera.intrinsics;
    let mut numbers = [0f32; CAMERA_NUMBERS];
    for (number, value) in numbers.iter_mut().zip([k.fx / w, k.fy / h, k.cx / w, k.cy / h]) {
        *number = value as f32;
    }
    let rows = crate::scene::pose_to_rows(&camera.c2w.inverse());
    for (number, value) in numbers[6..].iter_mut().zip(rows) {
        *number = value as f32;
    }
    numbers
}
