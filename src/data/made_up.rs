//! Made-up videos, named where a data set is named: `synth:seed=1,scenes=10000`.

use super::capture::{Capture, Changes, Frame, Photo, Purpose};
use super::pixels::Distortion;
use crate::error::{Error, Result};
use crate::io::{PHOTO_EXTENSIONS, checksum, read_image};
use crate::scene::ImageSize;
use crate::synth::{Texture, Video, VideoSettings};
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// As an error tells it.
const EXPECTED: &str =
    "synth:seed=S,scenes=N and, if need be, first=I, frames=F, size=PIXELS, pictures=FOLDER";

/// Videos of one seed, each made when it is asked for.
#[derive(Debug, Clone)]
pub struct MadeUp {
    /// As it was written.
    name: String,
    seed: u64,
    /// The number of the first video: others of the same seed can be kept for validation.
    first: u64,
    scenes: u64,
    settings: VideoSettings,
    /// Of the files of pictures that are seen on things, if there are some.
    pictures_checksum: Option<u32>,
}

impl MadeUp {
    /// What such a name begins with.
    pub(super) const PREFIX: &str = "synth:";

    /// How many videos there can be.
    pub const SCENES: RangeInclusive<u64> = 1..=1_000_000;
    /// The number that the first can have.
    pub const FIRST: RangeInclusive<u64> = 0..=1 << 32;
    /// Photos of each.
    pub const FRAMES: RangeInclusive<u64> = 3..=10_000;
    /// Side of a photo in pixels.
    pub const SIZE: RangeInclusive<u64> = 16..=8192;

    /// `scenes` videos of `seed`, from number `first` on.
    pub fn new(seed: u64, first: u64, scenes: u64, settings: VideoSettings) -> MadeUp {
        let name = format!("{}seed={seed},first={first},scenes={scenes}", Self::PREFIX);
        MadeUp { name, seed, first, scenes, settings, pictures_checksum: None }
    }

    /// What `path` names, if it is no path but made-up videos.
    ///
    /// # Errors
    /// A name that begins as theirs, with a field that is missing, unknown or no number in its range.
    pub fn named(path: &Path) -> Result<Option<MadeUp>> {
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
                return Err(refuse(name, "there twice"));
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
        Ok(Some(MadeUp { name, seed, first, scenes, settings, pictures_checksum }))
    }

    /// Returns what the videos depend on beside their name.
    pub(super) fn made_by(&self) -> String {
        let pictures = self.pictures_checksum.map(|checksum| format!(", pictures {checksum:08x}"));
        format!("globalsplat {}{}", env!("CARGO_PKG_VERSION"), pictures.unwrap_or_default())
    }

    /// Names of the scenes.
    pub fn keys(&self) -> Vec<String> {
        (self.first..self.first + self.scenes).map(|number| self.key(number)).collect()
    }

    /// Name of the scene of a number: of all that are of the seed, not of these.
    fn key(&self, number: u64) -> String {
        format!("{}_{number:06}", self.seed)
    }

    /// Makes video `index` of them, its pictures not yet.
    ///
    /// # Errors
    /// None but what every capture is checked for.
    pub fn capture(&self, index: usize) -> Result<Capture> {
        let number = self.first + index as u64;
        let video = Arc::new(Video::new(self.seed, number, &self.settings));
        let frame = |(index, &camera)| Frame {
            photo: Photo::Made { video: video.clone(), index },
            name: format!("{index:06}"),
            camera,
            distortion: Distortion::default(),
        };
        let frames = video.cameras().iter().enumerate().map(frame).collect();
        let file = PathBuf::from(&self.name);
        Capture::new(self.key(number), file, frames, Changes::default(), Purpose::Photos)
    }
}

/// Pictures that are to be seen on things: all that lie in `folder`.
///
/// # Errors
/// No folder, none in it, or one that can't be read.
pub fn read_pictures(folder: &Path) -> Result<Vec<Arc<Texture>>> {
    let files = picture_files(folder)?;
    files.iter().map(|file| Ok(Arc::new(Texture::of_picture(&read_image(file)?)))).collect()
}

/// Lists the pictures in `folder`, one at least, by their names.
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
        return Err(Error::input(folder, "the pictures", "none", "PNG or JPEG files"));
    }
    files.sort();
    Ok(files)
}
