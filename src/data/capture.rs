//! A capture: what every format on disk is read into.

use super::pixels::{Distortion, Lens, Planes, fit, looked_at, undistort};
use crate::error::{Error, Result};
use crate::io::{self, Inputs};
use crate::scene::{Camera, ImageSize, check_pose};
use crate::synth::Video;
use image::RgbImage;
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
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
    /// A part of a file that holds many images and is in memory.
    Part {
        file: Arc<Vec<u8>>,
        bytes: Range<usize>,
        /// As errors call it.
        name: PathBuf,
    },
    /// Not taken yet: picture `index` of a made-up video.
    Made { video: Arc<Video>, index: usize },
}

impl Photo {
    /// As errors call it.
    fn file(&self) -> &Path {
        match self {
            Photo::File(path) | Photo::Part { name: path, .. } => path,
            Photo::Made { .. } => Path::new("a made-up video"),
        }
    }

    fn read(&self) -> Result<Cow<'_, [u8]>> {
        match self {
            Photo::File(path) => Ok(std::fs::read(path).map_err(Error::read(path))?.into()),
            Photo::Part { file, bytes, .. } => Ok(file[bytes.clone()].into()),
            Photo::Made { video, index } => Ok(io::encode_photo(&video.photo(*index), true)?.into()),
        }
    }
}

/// Posed photos of one scene. The images are read when they are loaded.
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

impl View {
    /// The same; the pixels are shared.
    pub fn shallow_clone(&self) -> Self {
        View { name: self.name.clone(), image: self.image.shallow_clone(), camera: self.camera }
    }

    /// Fitted to `size`, as [`Capture::load`] does it, without reading the photo again.
    ///
    /// # Errors
    /// libtorch's refusal of an image of another shape.
    pub fn fitted(&self, size: ImageSize) -> Result<Self> {
        let (planes, camera) = fit(&io::rgb_from_tensor(&self.image)?, &self.camera, size);
        Ok(View { name: self.name.clone(), image: planes.to_tensor(), camera })
    }
}

/// What a capture is read for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    /// Its photos, which have to be there.
    Photos,
    /// Its cameras alone. Where the file doesn't tell how large its photos are and they aren't there to be asked, they are
    /// taken to be of this size.
    Cameras(Option<ImageSize>),
}

impl Purpose {
    /// The size of the photo `field`, (width, height), of which `file` tells none; `asked` is what the photo says of itself.
    pub(super) fn size(self, file: &Path, field: &str, asked: Result<(u32, u32)>) -> Result<(u32, u32)> {
        match (asked, self) {
            (Ok(size), _) => Ok(size),
            (Err(_), Purpose::Cameras(Some(ImageSize { width, height }))) => Ok((width, height)),
            (Err(_), Purpose::Cameras(None)) => {
                let expected = "one in the file, a photo to be asked, or --size WxH";
                Err(Error::input(file, format!("the size of {field}"), "absent", expected))
            }
            (Err(e), Purpose::Photos) => Err(e),
        }
    }
}

impl Capture {
    /// Checks what every format has to hold: two views, or one camera of a path, rigid poses, sensible intrinsics.
    pub(super) fn new(name: String, file: PathBuf, frames: Vec<Frame>, purpose: Purpose) -> Result<Self> {
        let (least, expected) = match purpose {
            Purpose::Photos => (2, "two or more"),
            Purpose::Cameras(_) => (1, "one or more"),
        };
        if frames.len() < least {
            return Err(Error::input(&file, "the number of views", frames.len(), expected));
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

    /// Whether any photo has fewer pixels than `size` along a side: to be fitted it is enlarged, which shows no more of the scene.
    pub fn has_smaller(&self, size: ImageSize) -> bool {
        let is_smaller = |camera: &Camera| camera.height < size.height || camera.width < size.width;
        self.frames.iter().any(|frame| is_smaller(&frame.camera))
    }

    /// The images' names, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.frames.iter().map(|frame| frame.name.as_str())
    }

    /// What pictures of the views are called, one by one, without their ending: as the photos are, in folders below the one
    /// that all of them share. Each is another one: where endings alone tell photos apart they are part of the name, and where
    /// nothing does, numbers stand for the names.
    pub fn picture_names(&self) -> Vec<String> {
        picture_names(&self.names().collect::<Vec<_>>())
    }

    /// Adds the files that the capture is read from to `inputs`: those that describe it, and its photos.
    pub fn add_inputs(&self, inputs: &mut Inputs) {
        let described = described_in(&self.file);
        inputs.add(&described);
        // A COLMAP model is in several files.
        let form = described.extension().filter(|form| *form == "bin" || *form == "txt");
        let siblings = form.and_then(|_| std::fs::read_dir(described.parent()?).ok());
        for sibling in siblings.into_iter().flatten().flatten() {
            if Path::new(&sibling.file_name()).extension() == form {
                inputs.add(&sibling.path());
            }
        }
        for frame in &self.frames {
            if let Photo::File(photo) = &frame.photo {
                inputs.add_photo(photo);
            }
        }
    }

    /// Reads the views of `indices`, fitted to `size`, or as they are.
    ///
    /// # Errors
    /// An image that is missing, can't be decoded, or has another size than the capture declares.
    pub fn load(&self, indices: &[usize], size: Option<ImageSize>) -> Result<Vec<View>> {
        let lens = self.shared_lens(indices, size);
        let views: Vec<_> = indices
            .par_iter()
            .map(|&index| self.load_view(&self.frames[index], size, lens.as_ref()))
            .collect();
        // Of several that can't be read the first one is told.
        views.into_iter().collect()
    }

    /// [`Capture::load`] of every view.
    ///
    /// # Errors
    /// As there.
    pub fn load_all(&self, size: Option<ImageSize>) -> Result<Vec<View>> {
        self.load(&(0..self.len()).collect::<Vec<_>>(), size)
    }

    /// What the first of several views was taken through, as others mostly are, too. Not of the largest photos: it takes 16 bytes a
    /// pixel, and nobody has looked yet whether they are as large as the capture says.
    fn shared_lens(&self, indices: &[usize], size: Option<ImageSize>) -> Option<Lens> {
        const MOST_PIXELS: u64 = 1 << 23;
        let Frame { camera, distortion, .. } = &self.frames[*indices.first()?];
        let is_shared = indices.len() > 1
            && *distortion != Distortion::default()
            && u64::from(camera.width) * u64::from(camera.height) <= MOST_PIXELS;
        is_shared.then(|| Lens::new(*distortion, *camera, size.map(|size| looked_at(camera, size))))
    }

    fn load_view(&self, frame: &Frame, size: Option<ImageSize>, lens: Option<&Lens>) -> Result<View> {
        let image = self.read_photo(frame, size, lens)?;
        let (planes, camera) = match size {
            Some(size) => fit(&image, &frame.camera, size),
            None => (Planes::from_rgb(&image), frame.camera),
        };
        Ok(View { name: frame.name.clone(), image: planes.to_tensor(), camera })
    }

    /// Depths of view `index` along its camera's axis at its pixels' centres, row by row, in the capture's unit and infinite where
    /// the sky is: made-up captures alone know them.
    pub fn depth(&self, index: usize) -> Option<Vec<f32>> {
        match &self.frames[index].photo {
            Photo::Made { video, index } => Some(video.depth(*index)),
            Photo::File(_) | Photo::Part { .. } => None,
        }
    }

    /// The photo of view `index` at its camera's size, lens distortion removed.
    ///
    /// # Errors
    /// As [`Capture::load`].
    pub(super) fn photo(&self, index: usize) -> Result<RgbImage> {
        self.read_photo(&self.frames[index], None, None)
    }

    /// The photo, lens distortion removed as far as fitting it to `size` looks at it; by `lens` if it is the camera's.
    fn read_photo(&self, frame: &Frame, size: Option<ImageSize>, lens: Option<&Lens>) -> Result<RgbImage> {
        if let Photo::Made { video, index } = &frame.photo {
            return Ok(video.photo(*index));
        }
        let photo = self.decode(frame, &frame.photo.read()?)?;
        if let Some(lens) = lens.filter(|lens| lens.is_of(&frame.distortion, &frame.camera)) {
            return Ok(lens.undistort(photo.pixels));
        }
        let window = size.map(|size| looked_at(&frame.camera, size));
        Ok(undistort(photo.pixels, &frame.distortion, &frame.camera, window))
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
        let pixels = undistort(photo.pixels, &frame.distortion, &frame.camera, None);
        io::encode_photo(&pixels, photo.is_jpeg)
    }
}

/// The file in `path`, which may have the key of one of its scenes after a `#`.
fn described_in(path: &Path) -> PathBuf {
    let text = path.to_string_lossy();
    let prefixes = text.match_indices('#').rev().map(|(at, _)| PathBuf::from(&text[..at]));
    std::iter::once(path.to_owned()).chain(prefixes).find(|file| file.is_file()).unwrap_or_default()
}

fn picture_names(names: &[&str]) -> Vec<String> {
    let plain = |part: Component| match part {
        Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
        Component::ParentDir => Some("up".to_string()),
        _ => None,
    };
    let paths: Vec<Vec<String>> =
        names.iter().map(|name| Path::new(name).components().filter_map(plain).collect()).collect();
    let folders = || paths.iter().map(|path| &path[..path.len().saturating_sub(1)]);
    let shared = |depth: &usize| {
        let first = paths[0].get(*depth);
        folders().all(|folder| folder.get(*depth).is_some_and(|name| Some(name) == first))
    };
    let skipped = if paths.is_empty() { 0 } else { (0..).take_while(shared).count() };
    let below = |path: &Vec<String>| path[skipped..].join("/");
    let stem = |path: &Vec<String>| Path::new(&below(path)).with_extension("").to_string_lossy().into_owned();
    let numbered = |index: usize| format!("{index:06}");
    let choices: [Vec<String>; 2] = [paths.iter().map(stem).collect(), paths.iter().map(below).collect()];
    let is_unique = |names: &Vec<String>| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    choices.into_iter().find(is_unique).unwrap_or_else(|| (0..names.len()).map(numbered).collect())
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

#[cfg(test)]
mod tests {
    use super::picture_names;

    #[test]
    fn pictures_are_named_as_photos_and_none_twice() {
        assert_eq!(picture_names(&["images/000.png", "images/001.png"]), ["000", "001"]);
        assert_eq!(picture_names(&["./images/left/0.png", "./images/right/0.png"]), ["left/0", "right/0"]);
        assert_eq!(picture_names(&["left/0.png", "1.png"]), ["left/0", "1"]);
        assert_eq!(picture_names(&["a/0.png", "a/0.jpg"]), ["0.png", "0.jpg"]);
        assert_eq!(picture_names(&["0.v1.png", "0.v2.png"]), ["0.v1", "0.v2"]);
        assert_eq!(picture_names(&["../a/0.png", "b/0.png"]), ["up/a/0", "b/0"]);
        assert_eq!(picture_names(&["0.png", "0.png"]), ["000000", "000001"]);
        assert_eq!(picture_names(&["000000", "000001"]), ["000000", "000001"]);
        assert!(picture_names(&[]).is_empty());
    }
}
