//! Synthetic videos. They are named in place of a dataset path: `synth:seed=1,scenes=10000`.

use super::{Texture, Video, VideoSettings};
use globalsplat_capture::{Capture, ImageSize, ImageSource, PHOTO_EXTENSIONS, read_image};
use globalsplat_files::{Error, Result, checksum};
use image::RgbImage;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Description of the expected name for error messages.
const EXPECTED: &str =
    "synth:seed=S,scenes=N and, if need be, first=I, frames=F, size=PIXELS, pictures=FOLDER";

/// Synthetic videos of one seed, each generated on request.
#[derive(Debug, Clone)]
pub struct SyntheticDataset {
    /// Name as the user wrote it.
    name: String,
    seed: u64,
    /// Index of the first video. Other videos of the same seed can be reserved for validation.
    first: u64,
    scenes: u64,
    settings: VideoSettings,
    /// Checksum of the image files that are shown on surfaces, if there are any.
    pictures_checksum: Option<u32>,
}

impl SyntheticDataset {
    /// Prefix of the name of synthetic videos.
    pub const PREFIX: &str = "synth:";

    /// Allowed number of videos.
    pub const SCENES: RangeInclusive<u64> = 1..=1_000_000;
    /// Allowed index of the first video.
    pub const FIRST: RangeInclusive<u64> = 0..=1 << 32;
    /// Allowed number of photos of each video.
    pub const FRAMES: RangeInclusive<u64> = 3..=10_000;
    /// Allowed side length of a photo in pixels.
    pub const SIZE: RangeInclusive<u64> = 16..=8192;

    /// Creates `scenes` videos of `seed`, starting at index `first`.
    pub fn new(seed: u64, first: u64, scenes: u64, settings: VideoSettings) -> SyntheticDataset {
        let name = format!("{}seed={seed},first={first},scenes={scenes}", Self::PREFIX);
        SyntheticDataset { name, seed, first, scenes, settings, pictures_checksum: None }
    }

    /// Parses `path` as the name of synthetic videos. Returns `None` if it is an ordinary path.
    ///
    /// # Errors
    /// Fails if the name has the prefix of synthetic videos, but a field is missing, repeated, unknown or out of range.
    pub fn named(path: &Path) -> Result<Option<SyntheticDataset>> {
        let Some(fields) = path.to_str().and_then(|name| name.strip_prefix(Self::PREFIX)) else {
            return Ok(None);
        };
        let refuse = |field: &str, found: &str| Error::input(path, field, found, EXPECTED);
        let (mut seed, mut scenes, mut first, mut frames, mut size) = (0, None, 0, 24, 128);
        let (mut pictures, mut pictures_checksum) = (vec![], None);
        let mut said = BTreeSet::new();
        for field in fields.split(',') {
            let (name, value) = field.split_once('=').unwrap_or((field, ""));
            if !said.insert(name) {
                return Err(refuse(name, "repeated"));
            }
            let number = || value.parse::<u64>().map_err(|_| refuse(name, &format!("{value:?}")));
            match name {
                "seed" => seed = number()?,
                "scenes" => scenes = Some(number()?),
                "first" => first = number()?,
                "frames" => frames = number()?,
                "size" => size = number()?,
                "pictures" if value.is_empty() => return Err(refuse(name, "nothing")),
                "pictures" => {
                    pictures = read_pictures(Path::new(value))?;
                    pictures_checksum = Some(checksum(picture_files(Path::new(value))?)?);
                }
                _ => return Err(refuse("a field", &format!("{name:?}"))),
            }
        }
        let scenes = scenes.ok_or_else(|| refuse("scenes", "missing"))?;
        for (name, value, range) in [
            ("scenes", scenes, Self::SCENES),
            ("first", first, Self::FIRST),
            ("frames", frames, Self::FRAMES),
            ("size", size, Self::SIZE),
        ] {
            if !range.contains(&value) {
                let expected = format!("{} to {}", range.start(), range.end());
                return Err(Error::input(path, name, value, expected));
            }
        }
        let (frames, size) = (frames as usize, ImageSize { height: size as u32, width: size as u32 });
        let settings = VideoSettings { frames, size, pictures };
        let name = path.to_string_lossy().into_owned();
        Ok(Some(SyntheticDataset { name, seed, first, scenes, settings, pictures_checksum }))
    }

    /// Returns what the videos depend on besides their name: the version of this crate, and the checksum of the user's images.
    pub fn generator(&self) -> String {
        let pictures = self.pictures_checksum.map(|checksum| format!(", pictures {checksum:08x}"));
        format!("globalsplat {}{}", env!("CARGO_PKG_VERSION"), pictures.unwrap_or_default())
    }

    /// Returns the names of the scenes.
    pub fn keys(&self) -> Vec<String> {
        (self.first..self.first + self.scenes).map(|number| self.key(number)).collect()
    }

    /// Returns the name of scene `number`, counted over all scenes of the seed.
    fn key(&self, number: u64) -> String {
        format!("{}_{number:06}", self.seed)
    }

    /// Generates video number `index` of this set without rendering its images.
    ///
    /// # Errors
    /// Fails only if the capture violates the checks that apply to every capture.
    pub fn capture(&self, index: usize) -> Result<Capture> {
        let number = self.first + index as u64;
        let video = Arc::new(Video::new(self.seed, number, &self.settings));
        let cameras = video.cameras().to_vec();
        Capture::from_source(self.key(number), PathBuf::from(&self.name), &cameras, video)
    }
}

impl ImageSource for Video {
    fn name(&self) -> &str {
        "a synthetic video"
    }

    fn image(&self, index: usize) -> RgbImage {
        self.photo(index)
    }

    fn depth(&self, index: usize) -> Option<Vec<f32>> {
        Some(Video::depth(self, index))
    }
}

/// Reads the images to show on surfaces: all image files in `folder`.
///
/// # Errors
/// Fails if the folder doesn't exist or contains no image, or if an image can't be read.
pub fn read_pictures(folder: &Path) -> Result<Vec<Arc<Texture>>> {
    let files = picture_files(folder)?;
    files.iter().map(|file| Ok(Arc::new(Texture::from_image(&read_image(file)?)))).collect()
}

/// Lists the image files in `folder`, at least one, sorted by name.
fn picture_files(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(Error::read(folder))?;
    let mut files = vec![];
    for entry in entries {
        let path = entry.map_err(Error::read(folder))?.path();
        let extension = path.extension().map(|e| e.to_ascii_lowercase());
        if extension.is_some_and(|e| PHOTO_EXTENSIONS.iter().any(|known| e == *known)) {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(Error::input(folder, "the pictures", "none", "files of photos, such as PNG or JPEG"));
    }
    files.sort();
    Ok(files)
}
