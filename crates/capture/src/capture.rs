//! The in-memory representation of a capture, common to all file formats.

use crate::geometry::{Camera, ImageSize, Upright, check_pose, nearest_rigid_of_scaled};
use crate::holdout::Holdout;
use crate::image_source::ImageSource;
use crate::lens::{Lens, LensModel, PinholeView, Projection, split_into_views};
use crate::photos::{describe_photos, find_masks_in, part_name, unique_stems};
use crate::pixels::{
    DecodedPhoto, Planes, add_background, decode_photo, encode_photo, gray_to_rgb, has_alpha_channel,
    multiply, read_image_size, read_mask, resize_and_crop, source_window, undistort,
};
use glam::{DMat3, DMat4};
use globalsplat_files::{Error, InputFiles, Result, is_same_file, parent_of, split_keyed_path};
use image::RgbImage;
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A photo whose pixels are not loaded.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    pub image: ImageLocation,
    /// File of the image's mask.
    pub mask: Option<PathBuf>,
    /// Name of the image in the capture.
    pub name: String,
    /// Intrinsics of the lens, pose, and size of the image file. If the lens is a perspective one, this is the pinhole camera of the
    /// image after the distortion is removed.
    pub camera: Camera,
    /// Lens that took the image in the file.
    pub lens: LensModel,
}

impl Frame {
    /// Creates the frame of a photo without a mask that a pinhole camera took.
    pub fn pinhole(image: ImageLocation, name: String, camera: Camera) -> Self {
        Frame { image, mask: None, name, camera, lens: LensModel::default() }
    }
}

/// Name of the file in a capture's folder that records how it was made.
pub const CAPTURE_RECORD: &str = "capture.json";

/// A pinhole view of a photo.
#[derive(Debug, Clone)]
struct View {
    /// Index of the photo in [`Capture::frames`].
    frame: usize,
    /// Name of the photo, or of the part of it that the view shows.
    name: String,
    camera: Camera,
    projection: Projection,
}

/// Location of a photo's image.
#[derive(Debug, Clone)]
pub(crate) enum ImageLocation {
    /// An image file.
    File(PathBuf),
    /// A byte range of an in-memory file that holds many images, which chunks do.
    #[cfg_attr(not(feature = "chunks"), expect(dead_code))]
    Bytes {
        file: Arc<Vec<u8>>,
        bytes: Range<usize>,
        /// Name that error messages use for the image.
        name: PathBuf,
    },
    /// Image `index` of a source that computes images on request.
    Source { source: Arc<dyn ImageSource>, index: usize },
}

impl ImageLocation {
    /// Returns the path that error messages use for the image.
    fn file(&self) -> &Path {
        match self {
            ImageLocation::File(path) | ImageLocation::Bytes { name: path, .. } => path,
            ImageLocation::Source { source, .. } => Path::new(source.name()),
        }
    }

    /// Returns the image as it is encoded in its file. An image that is computed is encoded as a JPEG.
    fn read(&self) -> Result<Cow<'_, [u8]>> {
        match self {
            ImageLocation::File(path) => Ok(std::fs::read(path).map_err(Error::read(path))?.into()),
            ImageLocation::Bytes { file, bytes, .. } => Ok(file[bytes.clone()].into()),
            ImageLocation::Source { source, index } => Ok(encode_photo(&source.image(*index), true)?.into()),
        }
    }
}

/// Memory limit for photos that are decoded at the same time. A photo is small again once it is fitted to the model's image size.
const DECODED_BYTES: u64 = 1 << 30;
/// Memory per pixel while a photo is decoded, and per pixel of its views.
const DECODED_BYTES_PER_PIXEL: u64 = 6;

/// Posed photos of one scene. Images are read only when they are loaded.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Name of the folder, or key of the scene in a chunk.
    pub name: String,
    file: PathBuf,
    /// All photos. Those of the capture's own test part come last.
    frames: Vec<Frame>,
    /// Views of all photos, in their order.
    views: Vec<View>,
    /// Number of views in the training part, which come first in `views`.
    train: usize,
    is_complete: bool,
    /// Gray level that replaces what is left out.
    background: Option<u8>,
    /// `true` if what masks leave out is black.
    is_over_black: bool,
    warnings: Vec<String>,
}

/// Record of what a format's reader leaves out or changes.
#[derive(Debug, Default)]
pub(crate) struct Changes {
    /// Names of missing photos.
    pub missing: Vec<String>,
    /// Names of photos whose pose contained a scaled rotation, each with the scale factor that was removed.
    pub scaled: Vec<(String, f64)>,
    /// Descriptions of other changes, one line each.
    pub lines: Vec<String>,
}

impl Changes {
    /// Returns the file of photo `name`: the one that was `found`, or, if `purpose` needs no photos, the one that is `declared`. Returns
    /// `None` and counts the photo as missing otherwise.
    pub fn photo(
        &mut self,
        name: &str,
        found: Option<PathBuf>,
        purpose: Purpose,
        declared: PathBuf,
    ) -> Option<PathBuf> {
        let is_needed = matches!(purpose, Purpose::Photos);
        if found.is_none() && is_needed {
            self.missing.push(name.to_string());
        }
        found.or((!is_needed).then_some(declared))
    }

    /// Removes the scale from `c2w`, the pose of photo `name`, if its rotation is scaled. Returns any other pose unchanged.
    pub fn remove_scale(&mut self, name: &str, c2w: DMat4) -> DMat4 {
        match nearest_rigid_of_scaled(&c2w) {
            Ok((rigid, scale)) if check_pose(&c2w).is_err() => {
                self.scaled.push((name.to_string(), scale));
                rigid
            }
            _ => c2w,
        }
    }

    /// Returns one line for each kind of change to the capture that `file` describes, of which `present` photos are left.
    fn into_lines(self, file: &Path, present: usize) -> Vec<String> {
        let missing = describe_photos(file, &self.missing, |count| {
            format!("{count} of {} photos are missing and left out", present + count)
        });
        let (scaled, factors): (Vec<String>, Vec<f64>) = self.scaled.into_iter().unzip();
        let scaled = describe_photos(file, &scaled, |count| {
            let first = factors[0];
            format!("{count} of {present} rotations are scaled, the first by {first:.6}, which is taken out")
        });
        let others = self.lines.into_iter().map(|line| format!("{}: {line}", file.display()));
        missing.into_iter().chain(scaled).chain(others).collect()
    }
}

/// Minimum number of views that a scene can be reconstructed from.
const MIN_VIEWS: usize = 2;

/// A photo and its camera.
#[derive(Debug, Clone)]
pub struct Photo {
    /// Name of the image in the capture.
    pub name: String,
    /// Pixels.
    pub image: Planes,
    /// Weight of each pixel, row by row: 255 where the pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub mask: Option<Vec<u8>>,
    /// Camera at the size of `image`.
    pub camera: Camera,
}

impl Photo {
    /// Returns `true` if no pixel counts.
    pub fn is_masked_out(&self) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask.iter().all(|&weight| weight == 0))
    }
}

/// Purpose for which a capture is read.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    /// The capture's photos, which must exist.
    Photos,
    /// The capture's cameras alone. A photo whose size is neither in the capture's file nor readable from the photo itself is
    /// assumed to have this size.
    Cameras(Option<ImageSize>),
}

impl Purpose {
    /// Returns the size (width, height) of the photo `field`, for which `file` declares none. `asked` is the size read from the
    /// photo itself.
    pub(crate) fn size(self, file: &Path, field: &str, asked: Result<(u32, u32)>) -> Result<(u32, u32)> {
        match (asked, self) {
            (Ok(size), _) => Ok(size),
            (Err(_), Purpose::Cameras(Some(ImageSize { width, height }))) => Ok((width, height)),
            (Err(_), Purpose::Cameras(None)) => {
                let expected = "one in the file, a photo to be asked, or --size WxH";
                Err(Error::input(file, format!("the size of {field}"), "missing", expected))
            }
            (Err(e), Purpose::Photos) => Err(e),
        }
    }
}

impl Capture {
    /// Checks the requirements common to all formats: at least two views, or one camera of a path; rigid poses; valid intrinsics.
    /// If a photo's size differs from that in `frames` but the aspect ratio agrees, its intrinsics are scaled. `changes` lists what
    /// the format's reader left out or changed.
    pub(crate) fn new(
        name: String,
        file: PathBuf,
        frames: Vec<Frame>,
        changes: Changes,
        purpose: Purpose,
    ) -> Result<Self> {
        let (least, expected) = match purpose {
            Purpose::Photos => (MIN_VIEWS, "two or more"),
            Purpose::Cameras(_) => (1, "one or more"),
        };
        let count = frames.len();
        if count < least {
            let (field, found) = match changes.missing.as_slice() {
                [] => ("the number of views", count.to_string()),
                [name, ..] => {
                    let found = format!("{count} of {}, {name:?} is missing", count + changes.missing.len());
                    ("the number of frames with an image", found)
                }
            };
            return Err(Error::input(&file, field, found, expected));
        }
        let empty = Capture {
            name,
            file: file.clone(),
            frames: vec![],
            views: vec![],
            train: 0,
            is_complete: true,
            background: None,
            is_over_black: false,
            warnings: vec![],
        };
        let capture = empty.with_test(&file, frames, changes, purpose)?;
        Ok(Capture { train: capture.views.len(), ..capture })
    }

    /// Creates a capture whose images are computed by `source` on request: image i is seen by camera i, and named by its index.
    ///
    /// # Errors
    /// Fails if there are fewer than two cameras, or a pose isn't rigid, or intrinsics are invalid. `file` is the path that error
    /// messages name.
    pub fn from_source(
        name: String,
        file: PathBuf,
        cameras: &[Camera],
        source: Arc<dyn ImageSource>,
    ) -> Result<Self> {
        let frame = |(index, &camera): (usize, &Camera)| {
            let image = ImageLocation::Source { source: source.clone(), index };
            Frame::pinhole(image, format!("{index:06}"), camera)
        };
        let frames = cameras.iter().enumerate().map(frame).collect();
        Capture::new(name, file, frames, Changes::default(), Purpose::Photos)
    }

    /// Adds `frames`, described by `file`, as the test part, which is held out unless another split is requested.
    pub(crate) fn with_test(
        mut self,
        file: &Path,
        mut frames: Vec<Frame>,
        changes: Changes,
        purpose: Purpose,
    ) -> Result<Self> {
        self.is_complete &= changes.missing.is_empty();
        check_cameras(file, frames.iter().map(|frame| &frame.camera))?;
        self.warnings.extend(changes.into_lines(file, frames.len()));
        if matches!(purpose, Purpose::Photos) {
            self.warnings.extend(fit_cameras_to_photos(file, &mut frames));
            self.warnings.extend(check_masks(file, &frames)?);
        }
        let (views, line) = views_of_frames(file, &frames, purpose)?;
        self.warnings.extend(line);
        let first = self.frames.len();
        self.views.extend(views.into_iter().map(|view| View { frame: first + view.frame, ..view }));
        self.frames.append(&mut frames);
        Ok(self)
    }

    /// Uses the masks in `folder` in place of those that the capture itself has. The mask of a photo has the photo's name, with the
    /// extension of an image added or in place of its own, as in `images/1.jpg.png` or `1.png` for `images/1.jpg`.
    ///
    /// # Errors
    /// Fails if the folder can't be read or has no mask for any photo, or if a mask is a photo or has another aspect ratio than its photo.
    pub fn with_masks(mut self, folder: &Path) -> Result<Self> {
        let names: Vec<&str> = self.frames.iter().map(|frame| frame.name.as_str()).collect();
        let masks = find_masks_in(folder, &names)?;
        let without: Vec<&str> =
            names.iter().zip(&masks).filter(|(_, mask)| mask.is_none()).map(|(name, _)| *name).collect();
        let line = describe_photos(folder, &without, |count| {
            format!("{count} of {} photos have no mask and count whole", names.len())
        });
        for (frame, mask) in self.frames.iter_mut().zip(masks) {
            if let Some(mask) = mask.as_ref().filter(|mask| is_same_file(mask, frame.image.file())) {
                return Err(Error::input(mask, "the mask", "the photo itself", "a mask of the photo"));
            }
            frame.mask = mask;
        }
        self.warnings.extend(line);
        self.warnings.extend(check_masks(folder, &self.frames)?);
        Ok(self)
    }

    /// Replaces what masks and transparency leave out by the gray `level`, 0 for black to 255 for white, at the photos' own size. Then all
    /// pixels count, as NeRF's benchmarks have it.
    pub fn with_background(self, level: u8) -> Self {
        Capture { background: Some(level), ..self }
    }

    /// Multiplies the photos by their masks, so that what a mask leaves out is black, as what is transparent always is. The weights stay: a
    /// photo of any size with weights w lies over a color c as photo + (1 − w)·c.
    #[must_use]
    pub fn over_black(self) -> Self {
        Capture { is_over_black: true, ..self }
    }

    /// Returns the gray level of [`Capture::with_background`].
    pub fn background(&self) -> Option<u8> {
        self.background
    }

    /// Inserts `lines` before the other warnings.
    pub(crate) fn with_warnings(mut self, mut lines: Vec<String>) -> Self {
        lines.append(&mut self.warnings);
        self.warnings = lines;
        self
    }

    /// Returns what was left out or changed when the capture was opened: one line for each kind of change, with counts and names.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Returns `true` if every photo named by the capture exists, so that the indices of its photos are those in the capture's file.
    pub fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// Returns the indices of the context views and those of the held-out views. [`Holdout::None`] holds out the capture's own test
    /// part, if it has one. Any other split is made of the remaining views alone and leaves the test part out. It counts photos, so
    /// that all views of a photo are on the same side.
    pub fn split(&self, holdout: Holdout) -> (Vec<usize>, Vec<usize>) {
        match holdout {
            Holdout::None => (0..self.len()).partition(|&view| view < self.train),
            Holdout::Every { every, first } => {
                (0..self.train).partition(|&view| self.views[view].frame % every != first)
            }
        }
    }

    /// Returns `true` if the capture itself defines which views are held out.
    pub fn has_test_part(&self) -> bool {
        self.train < self.len()
    }

    /// Returns the indices of the views at which images from elsewhere are scored: the capture's own test part if it has one,
    /// otherwise all views.
    pub fn scored_views(&self) -> Vec<usize> {
        if self.has_test_part() { (self.train..self.len()).collect() } else { (0..self.len()).collect() }
    }

    /// Returns the number of views. It is the number of photos, unless photos of wide lenses are split.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Returns `true` if there are no views, which never happens: a capture has at least one camera.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Returns the file that describes the capture.
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// Returns the cameras of the views, at the sizes of the image files, or at that of the part of a photo that a view shows.
    pub fn cameras(&self) -> Vec<Camera> {
        self.views.iter().map(|view| view.camera).collect()
    }

    /// Returns the camera of view `index`.
    pub fn camera(&self, index: usize) -> Camera {
        self.views[index].camera
    }

    /// Returns `true` if any view has fewer pixels than `size` along a side. Fitting enlarges such a view, which adds no detail.
    pub fn has_smaller(&self, size: ImageSize) -> bool {
        let is_smaller = |camera: &Camera| camera.height < size.height || camera.width < size.width;
        self.views.iter().any(|view| is_smaller(&view.camera))
    }

    /// Returns the names of the views, in order. They are those of the images; if a photo is split into several views, as in
    /// `photo@left.jpg`, with the part that the view shows.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.views.iter().map(|view| view.name.as_str())
    }

    /// Returns a unique file name without extension for the rendered image of each view. The names are those of the photos,
    /// relative to the deepest folder that contains all of them. If the names differ only in their extensions, the extensions
    /// become part of the names. If they aren't unique even then, numbers replace them.
    pub fn render_names(&self) -> Vec<String> {
        self.render_names_with(&[""])
    }

    /// Returns names like [`Capture::render_names`] for several images of each view, whose names end in `suffixes`. No two of the
    /// names with suffixes are equal.
    pub fn render_names_with(&self, suffixes: &[&str]) -> Vec<String> {
        unique_stems(&self.names().collect::<Vec<_>>(), suffixes)
    }

    /// Returns the number of photos with a mask: a file, or an alpha channel by their header.
    pub fn mask_count(&self) -> usize {
        let has_mask = |frame: &&Frame| match &frame.image {
            _ if frame.mask.is_some() => true,
            ImageLocation::File(photo) => has_alpha_channel(photo).unwrap_or(false),
            ImageLocation::Bytes { .. } | ImageLocation::Source { .. } => false,
        };
        self.frames.par_iter().filter(has_mask).count()
    }

    /// Adds the files that the capture is read from to `inputs`: those that describe it, and its photos.
    pub fn add_input_files(&self, inputs: &mut InputFiles) {
        // The path may end in `#` and the key of one of the file's scenes.
        let files = split_keyed_path(&self.file).rev().map(|(file, _)| file);
        let described = std::iter::once(self.file.clone()).chain(files).find(|file| file.is_file());
        let described = described.unwrap_or_default();
        inputs.add(&described);
        // A COLMAP model consists of several files.
        let form = described.extension().filter(|form| *form == "bin" || *form == "txt");
        let siblings = form.and_then(|_| std::fs::read_dir(parent_of(&described)).ok());
        self.record().iter().for_each(|record| inputs.add(record));
        for sibling in siblings.into_iter().flatten().flatten() {
            if Path::new(&sibling.file_name()).extension() == form {
                inputs.add(&sibling.path());
            }
        }
        for frame in &self.frames {
            if let ImageLocation::File(photo) = &frame.image {
                inputs.add_photo(photo);
            }
            frame.mask.iter().for_each(|mask| inputs.add_photo(mask));
        }
    }

    /// Returns the file that records how the capture was made, if `globalsplat capture` made it.
    fn record(&self) -> Option<PathBuf> {
        // The model is in the capture's folder sparse/0.
        let is_model = self.file.extension().is_some_and(|form| form == "bin" || form == "txt");
        let record = self.file.ancestors().nth(3).map(|folder| folder.join(CAPTURE_RECORD));
        record.filter(|record| is_model && record.is_file())
    }

    /// Returns the transform from COLMAP's coordinates to those of the capture, if `globalsplat capture` has turned it upright.
    pub fn upright(&self) -> Option<Upright> {
        let text = std::fs::read_to_string(self.record()?).ok()?;
        let mut record: serde_json::Value = serde_json::from_str(&text).ok()?;
        // Models that aren't connected to the largest one are as COLMAP has left them.
        let is_largest = record.pointer("/report/registered")?.as_u64()? == self.frames.len() as u64;
        let transform = record.pointer_mut("/report/transform")?.take();
        is_largest.then(|| serde_json::from_value(transform).ok()).flatten()
    }

    /// Reads the views `indices`, fitted to `size`, or at their own size if it is `None`. A photo is decoded once for all of its views.
    ///
    /// # Errors
    /// Fails if an image or a mask is missing or can't be decoded, if an image has another size than the capture declares.
    pub fn load(&self, indices: &[usize], size: Option<ImageSize>) -> Result<Vec<Photo>> {
        // The views of each photo, with their positions in `indices`.
        let mut photos: BTreeMap<usize, Vec<(usize, &View)>> = BTreeMap::new();
        for (position, &index) in indices.iter().enumerate() {
            let view = &self.views[index];
            photos.entry(view.frame).or_default().push((position, view));
        }
        let pixels = |(&frame, views): (&usize, &Vec<(usize, &View)>)| {
            let area = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
            let distorted = views.iter().filter(|(_, view)| !view.projection.is_identity());
            area(&self.frames[frame].camera) + distorted.map(|(_, view)| area(&view.camera)).sum::<u64>()
        };
        let largest = photos.iter().map(pixels).max().unwrap_or(0).max(1);
        let at_once = (DECODED_BYTES / (DECODED_BYTES_PER_PIXEL * largest)).max(1) as usize;
        let photos: Vec<_> = photos.into_iter().collect();
        let mut loaded: Vec<(usize, Photo)> = vec![];
        for photos in photos.chunks(at_once) {
            let load = |(frame, views): &(usize, Vec<_>)| self.load_views(*frame, views, size);
            let all: Vec<_> = photos.par_iter().map(load).collect();
            // If several images can't be read, the error is that of the first one.
            for views in all {
                loaded.extend(views?);
            }
        }
        loaded.sort_by_key(|(position, _)| *position);
        Ok(loaded.into_iter().map(|(_, photo)| photo).collect())
    }

    /// Reads every view like [`Capture::load`].
    ///
    /// # Errors
    /// Fails like [`Capture::load`].
    pub fn load_all(&self, size: Option<ImageSize>) -> Result<Vec<Photo>> {
        self.load(&(0..self.len()).collect::<Vec<_>>(), size)
    }

    /// Computes the CRC-32 of the views `indices`: the bytes of their photo files and masks, and their cameras. Images that are
    /// computed contribute their cameras alone.
    ///
    /// # Errors
    /// Fails if a photo or a mask can't be read.
    pub fn checksum(&self, indices: impl IntoIterator<Item = usize>) -> Result<u32> {
        let mut hasher = crc32fast::Hasher::new();
        for index in indices {
            let View { frame, camera, projection, .. } = &self.views[index];
            let Frame { image, mask, .. } = &self.frames[*frame];
            hasher.update(format!("{camera:?}{projection:?}").as_bytes());
            if !matches!(image, ImageLocation::Source { .. }) {
                hasher.update(&image.read()?);
            }
            if let Some(mask) = mask {
                hasher.update(&std::fs::read(mask).map_err(Error::read(mask))?);
            }
        }
        Ok(hasher.finalize())
    }

    /// Loads `views` of the photo `frame`, each with a number.
    fn load_views(
        &self,
        frame: usize,
        views: &[(usize, &View)],
        size: Option<ImageSize>,
    ) -> Result<Vec<(usize, Photo)>> {
        let (photo, mask) = self.read_photo(&self.frames[frame])?;
        let load = |&(number, view): &(usize, &View)| {
            let fit = |image: &RgbImage| match size {
                Some(size) => resize_and_crop(image, &view.camera, size),
                None => (Planes::from_rgb(image), view.camera),
            };
            let (image, mask) = view_pixels(&photo, mask.as_ref(), view, size);
            let (image, camera) = fit(&image);
            let mask = mask.map(|mask| fit(&mask).0.into_first_channel());
            let mask = mask.filter(|mask| mask.iter().any(|&weight| weight < u8::MAX));
            (number, Photo { name: view.name.clone(), image, mask, camera })
        };
        Ok(views.iter().map(load).collect())
    }

    /// Returns the depths of view `index` along its camera's axis at the pixel centers, row by row, in the capture's unit. They are
    /// infinite in the sky. Returns `None` unless an [`ImageSource`] computes them.
    pub fn depth(&self, index: usize) -> Option<Vec<f32>> {
        match &self.frames[self.views[index].frame].image {
            ImageLocation::Source { source, index } => source.depth(*index),
            ImageLocation::File(_) | ImageLocation::Bytes { .. } => None,
        }
    }

    /// Returns the photo of view `index` at its camera's size, with lens distortion removed, and the weights of its pixels, as in
    /// [`Photo::mask`], in equal channels. Pixels that the photo doesn't show are black.
    ///
    /// # Errors
    /// Fails like [`Capture::load`].
    pub fn photo_with_mask(&self, index: usize) -> Result<(RgbImage, Option<RgbImage>)> {
        let view = &self.views[index];
        let (photo, mask) = self.read_photo(&self.frames[view.frame])?;
        if view.projection.is_identity() {
            return Ok((photo, mask));
        }
        let (image, mask) = view_pixels(&photo, mask.as_ref(), view, None);
        Ok((image.into_owned(), mask.map(Cow::into_owned)))
    }

    /// Returns the pixels of a photo as its lens took them, and their weights in equal channels: the mask's, multiplied by the photo's
    /// opacity. With a background, no pixel is left out.
    fn read_photo(&self, frame: &Frame) -> Result<(RgbImage, Option<RgbImage>)> {
        if let ImageLocation::Source { source, index } = &frame.image {
            return Ok((source.image(*index), None));
        }
        let DecodedPhoto { mut pixels, alpha, .. } = self.decode(frame, &frame.image.read()?)?;
        let alpha = alpha.map(|alpha| gray_to_rgb(&alpha));
        let mask = frame.mask.as_ref().map(|file| read_mask(file, pixels.dimensions())).transpose()?;
        if let Some(level) = self.background {
            // Where a photo is transparent, it is composited over black already.
            if let Some(alpha) = &alpha {
                add_background(&mut pixels, alpha, level);
            }
            if let Some(mask) = &mask {
                multiply(&mut pixels, mask);
                add_background(&mut pixels, mask, level);
            }
            return Ok((pixels, None));
        }
        let Some(mut mask) = mask else { return Ok((pixels, alpha)) };
        if self.is_over_black {
            multiply(&mut pixels, &mask);
        }
        if let Some(alpha) = alpha {
            multiply(&mut mask, &alpha);
        }
        Ok((pixels, Some(mask)))
    }

    fn decode(&self, frame: &Frame, encoded: &[u8]) -> Result<DecodedPhoto> {
        let Camera { width, height, .. } = frame.camera;
        let photo = decode_photo(encoded, frame.image.file(), (width, height))?;
        if photo.pixels.dimensions() == (width, height) {
            return Ok(photo);
        }
        let found = format!("{}×{} pixels", photo.pixels.width(), photo.pixels.height());
        let expected = format!("{width}×{height} as in {}", self.file.display());
        Err(Error::input(frame.image.file(), "the image", found, expected))
    }

    /// Returns the image file of view `index` as a pinhole camera would have written it. These are the original bytes if the image
    /// is 8-bit RGB, upright and free of distortion. Pixels that the photo doesn't show are black.
    ///
    /// # Errors
    /// Fails like [`Capture::load`].
    pub fn encoded(&self, index: usize) -> Result<Vec<u8>> {
        let view = &self.views[index];
        let frame = &self.frames[view.frame];
        let bytes = frame.image.read()?;
        let photo = self.decode(frame, &bytes)?;
        match view_pixels(&photo.pixels, None, view, None).0 {
            Cow::Borrowed(_) if photo.is_verbatim => Ok(bytes.into_owned()),
            image => encode_photo(&image, photo.is_jpeg),
        }
    }
}

/// Returns the pixels of `view` of `photo`, and their weights in equal channels: those of the photo's `mask`, and 0 where the photo doesn't
/// show the view. There are no weights if every pixel counts. Pixels are undefined where fitting the view to `size` doesn't read them.
fn view_pixels<'a>(
    photo: &'a RgbImage,
    mask: Option<&'a RgbImage>,
    view: &View,
    size: Option<ImageSize>,
) -> (Cow<'a, RgbImage>, Option<Cow<'a, RgbImage>>) {
    let View { projection, camera, .. } = view;
    if projection.is_identity() {
        return (Cow::Borrowed(photo), mask.map(Cow::Borrowed));
    }
    let own_size = ImageSize { height: camera.height, width: camera.width };
    let window = source_window(camera, size.unwrap_or(own_size));
    let (image, shown) = undistort(photo, projection, camera, &window);
    let mask = mask.map(|mask| {
        let mut mask = undistort(mask, projection, camera, &window).0;
        shown.iter().for_each(|shown| multiply(&mut mask, shown));
        mask
    });
    (Cow::Owned(image), mask.or(shown).map(Cow::Owned))
}

/// Returns the pinhole views of `frames`, which `file` describes, and a line about those whose lenses aren't perspective ones.
fn views_of_frames(file: &Path, frames: &[Frame], purpose: Purpose) -> Result<(Vec<View>, Option<String>)> {
    let is_path = matches!(purpose, Purpose::Cameras(_));
    let is_split = |frame: &Frame| !is_path && !matches!(frame.lens, LensModel::Perspective(_));
    // Photos of one camera have the same lens.
    let mut lenses: Vec<Lens> = vec![];
    for lens in
        frames.iter().filter(|frame| is_split(frame)).map(|frame| Lens::new(&frame.camera, frame.lens))
    {
        if !lenses.contains(&lens) {
            lenses.push(lens);
        }
    }
    let splits: Vec<_> = lenses.par_iter().map(split_into_views).collect();
    let (mut views, mut photos, mut parts) = (vec![], 0, 0);
    for (index, frame) in frames.iter().enumerate() {
        let (name, camera, lens) = (&frame.name, &frame.camera, Lens::new(&frame.camera, frame.lens));
        if !is_split(frame) {
            if frame.lens == LensModel::Equirectangular {
                let (field, found) = (format!("the camera of {name}"), "EQUIRECTANGULAR");
                let expected = "a camera with a field of view below 180 degrees";
                return Err(Error::input(file, field, found, expected));
            }
            let projection = Projection { lens, rotation: DMat3::IDENTITY };
            views.push(View { frame: index, name: name.clone(), camera: *camera, projection });
            continue;
        }
        let split = lenses.iter().rposition(|known| *known == lens).expect("a lens that was split");
        photos += 1;
        parts += splits[split].len();
        views.extend(splits[split].iter().map(|&PinholeView { suffix, rotation, intrinsics, size }| {
            let c2w = camera.c2w * DMat4::from_mat3(rotation);
            let camera = Camera { intrinsics, c2w, width: size.width, height: size.height };
            let projection = Projection { lens, rotation };
            View { frame: index, name: part_name(name, suffix), camera, projection }
        }));
    }
    let line = (photos > 0).then(|| {
        let (file, all) = (file.display(), frames.len());
        format!(
            "{file}: {photos} of {all} photos have a fisheye or 360° lens and become {parts} pinhole views"
        )
    });
    Ok((views, line))
}

/// Scales the intrinsics of `frames` to photos whose size differs from that in `file` but whose aspect ratio agrees with it, and
/// returns a line about it. A photo whose size can't be read keeps its camera; loading it reports the error.
fn fit_cameras_to_photos(file: &Path, frames: &mut [Frame]) -> Option<String> {
    let scaled = |frame: &Frame| match &frame.image {
        ImageLocation::File(path) => frame.camera.scaled_to(read_image_size(path).ok()?),
        ImageLocation::Bytes { .. } | ImageLocation::Source { .. } => None,
    };
    let scaled: Vec<_> = frames.par_iter().map(scaled).collect();
    let (all, mut names, mut sizes) = (frames.len(), vec![], vec![]);
    for (frame, camera) in frames.iter_mut().zip(scaled) {
        let Some(camera) = camera else { continue };
        let Camera { width, height, .. } = std::mem::replace(&mut frame.camera, camera);
        sizes.push(format!("{}×{} pixels in place of {width}×{height}", camera.width, camera.height));
        names.push(frame.name.as_str());
    }
    describe_photos(file, &names, |count| {
        let first = &sizes[0];
        format!(
            "{count} of {all} photos have another size than it says, the first {first}: their intrinsics are scaled"
        )
    })
}

/// Checks that the masks of `frames` have the sizes of their photos up to a factor. Returns a line about those that have another size.
fn check_masks(file: &Path, frames: &[Frame]) -> Result<Option<String>> {
    let is_resized = |frame: &Frame| -> Result<bool> {
        let Some(mask) = &frame.mask else { return Ok(false) };
        let Camera { width, height, .. } = frame.camera;
        let size = read_image_size(mask)?;
        let has_size = |camera: Camera| (camera.width, camera.height) == size;
        if has_size(frame.camera) {
            return Ok(false);
        }
        if frame.camera.scaled_to(size).is_some_and(has_size) {
            return Ok(true);
        }
        let found = format!("{}×{} pixels", size.0, size.1);
        let expected = format!("{width}×{height} pixels as {}, or both by one factor", frame.name);
        Err(Error::input(mask, "the mask", found, expected))
    };
    // If several masks are wrong, the error is that of the first one.
    let resized: Vec<Result<bool>> = frames.par_iter().map(is_resized).collect();
    let resized = resized.into_iter().collect::<Result<Vec<_>>>()?;
    let resized = frames.iter().zip(resized).filter(|(_, is_resized)| *is_resized);
    let names: Vec<&str> = resized.map(|(frame, _)| frame.name.as_str()).collect();
    Ok(describe_photos(file, &names, |count| {
        format!("the masks of {count} of {} photos have another size and are resized", frames.len())
    }))
}

/// Checks that poses are rigid and that intrinsics are valid.
pub(crate) fn check_cameras<'a>(file: &Path, cameras: impl Iterator<Item = &'a Camera>) -> Result<()> {
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
