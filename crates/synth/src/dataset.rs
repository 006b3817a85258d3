//! Synthetic videos. They are named in place of a dataset path: `synth:seed=1,scenes=10000`.

use super::{Video, VideoSettings};
use globalsplat_capture::{Capture, Error, ImageSize, ImageSource, Result};
use image::RgbImage;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Description of the expected name for error messages.
const EXPECTED: &str = "synth:seed=S,scenes=N and, if need be, first=I, frames=F, size=PIXELS";

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
}

impl SyntheticDataset {
    /// Prefix of the name of synthetic videos.
    pub const PREFIX: &str = "synth:";
    /// What the videos depend on besides their name: the version of this crate.
    pub const GENERATOR: &str = concat!("globalsplat ", env!("CARGO_PKG_VERSION"));

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
        SyntheticDataset { name, seed, first, scenes, settings }
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
        let size = ImageSize { height: size as u32, width: size as u32 };
        let settings = VideoSettings { frames: frames as usize, off_path: 0, is_object: false, size };
        let name = path.to_string_lossy().into_owned();
        Ok(Some(SyntheticDataset { name, seed, first, scenes, settings }))
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
        self.capture_of(index, Arc::new(self.video(index)))
    }

    /// Generates the scene of video number `index`.
    pub fn video(&self, index: usize) -> Video {
        Video::new(self.seed, self.first + index as u64, &self.settings)
    }

    /// Returns the capture of `video`, number `index`.
    ///
    /// # Errors
    /// Fails like [`SyntheticDataset::capture`].
    pub fn capture_of(&self, index: usize, video: Arc<Video>) -> Result<Capture> {
        let name = self.key(self.first + index as u64);
        let cameras = video.cameras().to_vec();
        Capture::from_source(name, PathBuf::from(&self.name), &cameras, video)
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
