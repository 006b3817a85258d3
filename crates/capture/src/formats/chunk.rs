//! Chunks of RealEstate10K, ACID and DL3DV: `*.torch`, a torch.save file with a list of posed videos, each a dict {"key", "url",
//! "timestamps", "cameras" [n, 18], "images": n encoded images} (spec 10.7).

use super::CaptureOpener;
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose};
use crate::geometry::{Camera, Intrinsics, pose_to_rows};
use crate::pixels::{SUPPORTED_IMAGES, encoded_image_size};
use glam::{DMat4, DVec4};
use globalsplat_files::{Error, Result, split_keyed_path};
use globalsplat_torch_file::{Array, Dtype, Id, TorchFile, Value};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// File extension of a chunk.
pub const CHUNK_EXTENSION: &str = "torch";
/// Name of the index file that identifies a folder of chunks: {key: chunk's file name}.
pub const CHUNK_INDEX_FILE: &str = "index.json";
/// Number of values of a camera: f_x, f_y, c_x, c_y as fractions of the image's width and height, 0, 0, and the first three rows of
/// w2c.
pub const CAMERA_NUMBERS: usize = 18;

/// Number of views that is always allowed. A chunk may refer to one image repeatedly, in a byte or two each time.
const ALWAYS_ALLOWED_VIEWS: usize = 100_000;
/// Minimum number of bytes of the file per view beyond [`ALWAYS_ALLOWED_VIEWS`]. An image with its description takes more.
const MIN_BYTES_PER_VIEW: usize = 50;

/// A posed video.
#[derive(Debug, Clone)]
struct Scene {
    /// Key of the scene in an index.
    key: String,
    /// Camera values, [views, [`CAMERA_NUMBERS`]].
    cameras: Array,
    /// Byte range of each view's encoded image in the file.
    images: Vec<Range<usize>>,
}

/// A chunk in memory, with images still encoded.
#[derive(Debug, Clone)]
pub struct Chunk {
    file: PathBuf,
    bytes: Arc<Vec<u8>>,
    scenes: Vec<Scene>,
}

/// Recognizes `CHUNK.torch#KEY`, or `CHUNK.torch` with a single scene.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let keyed = split_keyed_path(path).find(|(file, _)| is_chunk(file));
    let (file, key) = match keyed {
        Some((file, key)) => (file, Some(key)),
        None => (is_chunk(path).then(|| path.to_owned())?, None),
    };
    Some(Box::new(move |purpose| Chunk::read(&file)?.capture_for(key.as_deref(), purpose)))
}

/// Returns `true` if `path` is a file with the extension of a chunk.
fn is_chunk(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == CHUNK_EXTENSION) && path.is_file()
}

impl Chunk {
    /// Reads a chunk. Executes nothing that it contains and trusts none of the sizes that it declares.
    ///
    /// # Errors
    /// Fails if the file can't be read, is damaged, or holds anything other than scenes.
    pub fn read(file: &Path) -> Result<Self> {
        Self::parse(file, std::fs::read(file).map_err(Error::read(file))?)
    }

    /// Parses `bytes`, the contents of the chunk `file`.
    ///
    /// # Errors
    /// Fails like [`Chunk::read`], except for errors of reading the file.
    pub fn parse(file: &Path, bytes: Vec<u8>) -> Result<Self> {
        let max_views = ALWAYS_ALLOWED_VIEWS + bytes.len() / MIN_BYTES_PER_VIEW;
        let scenes = list_scenes(&TorchFile::parse(file, &bytes)?, max_views).map_err(|why| {
            let expected = "a list of scenes, of tensors, lists, dicts, strings and numbers alone";
            Error::input(file, "data.pkl", format!("unusable ({why})"), expected)
        })?;
        Ok(Chunk { file: file.to_owned(), bytes: Arc::new(bytes), scenes })
    }

    /// Returns the names of the scenes, in order.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.scenes.iter().map(|scene| scene.key.as_str())
    }

    /// Returns the scene `key`.
    ///
    /// # Errors
    /// Fails if there is no such scene, or if it violates the requirements on captures.
    pub fn capture(&self, key: &str) -> Result<Capture> {
        self.capture_for(Some(key), Purpose::Photos)
    }

    /// Returns the scene `key`, or the single one without a key.
    fn capture_for(&self, key: Option<&str>, purpose: Purpose) -> Result<Capture> {
        const SHOWN: usize = 8;
        let is_chosen = |scene: &&Scene| key.map_or(self.scenes.len() == 1, |key| scene.key == key);
        if let Some(scene) = self.scenes.iter().find(is_chosen) {
            return self.capture_of(scene, purpose);
        }
        if self.scenes.is_empty() {
            return Err(Error::input(&self.file, "the list of scenes", "empty", "one scene at least"));
        }
        let (keys, count) = (self.keys().take(SHOWN).collect::<Vec<_>>().join(", "), self.scenes.len());
        let choice = format!("one of its {count}: {keys}{}", if count > SHOWN { ", …" } else { "" });
        Err(match key {
            Some(key) => Error::input(&self.file, "the scene", format!("{key:?}, which is missing"), choice),
            None => {
                let file = self.file.display();
                Error::request(format!("{file}: it holds {count} scenes, expected {file}#KEY with {choice}"))
            }
        })
    }

    fn capture_of(&self, scene: &Scene, purpose: Purpose) -> Result<Capture> {
        let named = PathBuf::from(format!("{}#{}", self.file.display(), scene.key));
        // A damaged frame is detected when it is loaded. Until then, assume the size of the other frames.
        let sizes: Vec<_> =
            scene.images.iter().map(|image| encoded_image_size(&self.bytes[image.clone()])).collect();
        let undecodable = || Error::input(&named, "every image", "undecodable", SUPPORTED_IMAGES);
        let size = sizes.iter().flatten().next().copied().ok_or_else(undecodable);
        let usual = purpose.size(&named, "the images", size)?;
        let cameras =
            scene.cameras.to_f32(&self.bytes).expect("floats inside the file, as the parser checked");
        let views = scene.images.iter().zip(cameras.chunks_exact(CAMERA_NUMBERS)).zip(&sizes).enumerate();
        let frames = views.map(|(index, ((bytes, numbers), size))| {
            let name = format!("{index:06}");
            let (file, bytes) = (self.bytes.clone(), bytes.clone());
            let image = ImageLocation::Bytes { file, bytes, name: named.join(&name) };
            Frame::pinhole(image, name, camera(numbers, size.unwrap_or(usual)))
        });
        Capture::new(scene.key.clone(), named.clone(), frames.collect(), Changes::default(), purpose)
    }
}

/// Builds a camera from a chunk's values and the image's (width, height).
fn camera(numbers: &[f32], (width, height): (u32, u32)) -> Camera {
    let at = |i: usize| f64::from(numbers[i]);
    let (w, h) = (f64::from(width), f64::from(height));
    let row = |i: usize| DVec4::new(at(i), at(i + 1), at(i + 2), at(i + 3));
    let w2c = DMat4::from_cols(row(6), row(10), row(14), DVec4::W).transpose();
    let intrinsics = Intrinsics { fx: at(0) * w, fy: at(1) * h, cx: at(2) * w, cy: at(3) * h };
    Camera { intrinsics, c2w: w2c.inverse(), width, height }
}

/// Returns a camera's 18 values in a chunk: f_x, f_y, c_x, c_y as fractions of the image's width and height, 0, 0, and the first three
/// rows of the world-to-camera matrix.
pub fn camera_numbers(camera: &Camera) -> [f32; CAMERA_NUMBERS] {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let k = camera.intrinsics;
    let mut numbers = [0f32; CAMERA_NUMBERS];
    let intrinsics = [k.fx / w, k.fy / h, k.cx / w, k.cy / h, 0., 0.];
    let rows = pose_to_rows(&camera.c2w.inverse());
    for (number, value) in numbers.iter_mut().zip(intrinsics.into_iter().chain(rows)) {
        *number = value as f32;
    }
    numbers
}

/// Returns the scenes in a chunk. Every error message names the scene and the field.
///
/// # Errors
/// Fails if the chunk isn't a list of scenes, or if they have more than `max_views` views together.
fn list_scenes(chunk: &TorchFile, max_views: usize) -> Result<Vec<Scene>, String> {
    let values = &chunk.values;
    let Value::List(list) = values.get(values.root) else {
        return Err(format!("{}, expected a list of scenes", values.get(values.root).type_name()));
    };
    let mut views = 0;
    let scene = |(index, &scene): (usize, &Id)| {
        let Value::Dict(dict) = values.get(scene) else {
            return Err(format!("scene {index} is {}, expected a dict", values.get(scene).type_name()));
        };
        let get =
            |field: &str| values.find(dict, field).ok_or_else(|| format!("scene {index} has no {field}"));
        let array = |field: &str, value: &Value| {
            let array = Array::locate(values, &chunk.storages, value);
            array.map_err(|why| format!("{field} of scene {index} {why}"))
        };
        let refusal = |field: &str, found: String, expected: &str| {
            format!("{field} of scene {index} is {found}, expected {expected}")
        };
        let images = match get("images")? {
            Value::List(images) => images,
            other => return Err(refusal("images", other.type_name().into(), "a list of tensors")),
        };
        views += images.len();
        if views > max_views {
            return Err(format!("{views} views or more, for which the file has no room"));
        }
        let (cameras, shape) = (array("cameras", get("cameras")?)?, [images.len(), CAMERA_NUMBERS]);
        if !cameras.is_float() || cameras.shape != shape {
            let found = format!("{} {:?}", cameras.dtype, cameras.shape);
            return Err(refusal("cameras", found, &format!("floats {shape:?} for as many images")));
        }
        let key = match get("key")? {
            Value::Str(key) => key.to_string(),
            other => return Err(refusal("key", other.type_name().into(), "a string")),
        };
        let image = |&id: &Id| {
            let image = array("images", values.get(id))?;
            if image.dtype == Dtype::U8 && image.shape.len() == 1 && image.is_contiguous() {
                return Ok(image.bytes);
            }
            let found = format!("{} {:?}", image.dtype, image.shape);
            Err(refusal("an image", found, "the contiguous bytes of a JPEG"))
        };
        let images = images.iter().map(image).collect::<Result<_, String>>()?;
        Ok(Scene { key, cameras, images })
    };
    list.iter().enumerate().map(scene).collect()
}
