//! The file that records how far a capture has come, so that the same call continues it, and the settings and results in it.

use crate::photos::{FoundMask, FoundPhoto, MAX_PIXELS, Photo, SkippedPhoto};
use crate::progress::Step;
use crate::video::VideoFrames;
use globalsplat_capture::{GeoPosition, Upright, format_names};
use globalsplat_files::{Error, Result, read_text, write_json};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;
use std::str::FromStr;
use std::time::UNIX_EPOCH;

/// Name of the file, in the capture's folder.
pub(crate) const FILE: &str = globalsplat_capture::CAPTURE_RECORD;

/// Number of photos that messages name.
pub(crate) const SHOWN_NAMES: usize = 5;

/// How pairs of photos to match are chosen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Matching {
    /// [`Matching::Sequential`] for frames of a video and more than 200 photos, otherwise [`Matching::Exhaustive`].
    #[default]
    Auto,
    /// Every pair.
    Exhaustive,
    /// Each photo with the 10 next ones in order of their names, every pair among 64 photos spread evenly, and each photo with those taken
    /// nearby if photos have GPS positions.
    Sequential,
}

impl FromStr for Matching {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        serde_json::from_value(text.into()).map_err(|_| "expected auto, exhaustive or sequential".into())
    }
}

/// Source video of a capture and its chosen frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VideoRecord {
    /// Name of the file.
    name: String,
    /// Size of the file.
    bytes: u64,
    /// Time of its last modification, in seconds since 1970.
    modified: u64,
    /// Number of frames that was asked for.
    frames: Option<usize>,
    /// Number of frames that a call was about to move to the folder of images, by whose end this is missing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) moving: Option<usize>,
    /// The chosen frames.
    #[serde(flatten)]
    pub chosen: VideoFrames,
}

impl VideoRecord {
    /// Describes the file at `video`, of which no frames are chosen yet.
    pub(crate) fn new(video: &Path, frames: Option<usize>) -> Result<Self> {
        let metadata = std::fs::metadata(video).map_err(Error::read(video))?;
        let modified = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        Ok(VideoRecord {
            name: video.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            bytes: metadata.len(),
            modified: modified.unwrap_or_default().as_secs(),
            frames,
            moving: None,
            chosen: VideoFrames::default(),
        })
    }

    /// Returns `true` if the frames are chosen and written.
    pub(crate) fn is_finished(&self) -> bool {
        !self.chosen.indices.is_empty()
    }

    /// Returns `true` if the frames of `other` are those of this video, and as many as this one asks for or `any_number`.
    pub(crate) fn matches(&self, other: &Self, any_number: bool) -> bool {
        (&self.name, self.bytes, self.modified) == (&other.name, other.bytes, other.modified)
            && (any_number || self.frames == other.frames)
    }
}

/// Formats which frames were asked for, as `240 frames of walk.mp4 (1234 bytes)`.
impl fmt::Display for VideoRecord {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        self.frames.iter().try_for_each(|frames| write!(f, "{frames} frames of "))?;
        write!(f, "{} ({} bytes)", self.name, self.bytes)
    }
}

/// Result of [`make_capture`](crate::make_capture).
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CaptureReport {
    /// The video that the photos are frames of.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub video: Option<VideoRecord>,
    /// Version of COLMAP, as `pycolmap 4.2.1`.
    pub colmap: String,
    /// Number of photos found.
    pub photos: usize,
    /// Number of photos in the largest model.
    pub registered: usize,
    /// Number of photos of each model, the largest first. Readers of captures use the largest.
    pub models: Vec<usize>,
    /// Mean reprojection error of the largest model in pixels.
    pub reprojection_error: f64,
    /// Number of points of the largest model.
    pub points: usize,
    /// Transform from COLMAP's coordinates of the largest model to those that were written, unless they are the same.
    #[serde(default)]
    pub transform: Option<Upright>,
    /// Line about files in the folder that aren't photos.
    pub other_files: Option<String>,
    /// Photos that are damaged, show nothing, or are identical to another.
    pub skipped: Vec<SkippedPhoto>,
    /// Names of the photos whose size was reduced, as they have more than 128 megapixels.
    #[serde(default)]
    pub reduced: Vec<String>,
    /// Names of the photos without a mask, if others have one.
    #[serde(default)]
    pub unmasked: Vec<String>,
    /// Names of the other photos that aren't in the largest model.
    pub unregistered: Vec<String>,
    /// What to try if few photos were registered.
    pub advice: Vec<String>,
    /// Seconds that each step took.
    pub seconds: BTreeMap<Step, f64>,
}

/// Formats the result in sentences, one per line.
impl fmt::Display for CaptureReport {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let CaptureReport { photos, registered, points, reprojection_error, .. } = self;
        write!(
            f,
            "{registered} of {photos} photos registered, {points} points, reprojection error {reprojection_error:.2} pixels"
        )?;
        self.transform.iter().try_for_each(|upright| write!(f, "\n{upright}"))?;
        if self.models.len() > 1 {
            write!(f, "\n{} separate models, of which the largest is used", self.models.len())?;
        }
        self.other_files.iter().try_for_each(|line| write!(f, "\n{line}"))?;
        if !self.skipped.is_empty() {
            let skip = |photo: &SkippedPhoto| format!("{} ({})", photo.name, photo.reason);
            let skipped: Vec<String> = self.skipped.iter().map(skip).collect();
            write!(f, "\nnot used: {}", format_names(&skipped, SHOWN_NAMES))?;
        }
        let reduced = format!("reduced to {} megapixels or less", MAX_PIXELS / 1_000_000);
        for (what, names) in [
            (&*reduced, &self.reduced),
            ("without a mask, so that they count whole", &self.unmasked),
            ("not registered", &self.unregistered),
        ] {
            if !names.is_empty() {
                write!(f, "\n{what}: {}", format_names(names, SHOWN_NAMES))?;
            }
        }
        self.advice.iter().try_for_each(|sentence| write!(f, "\n{sentence}"))
    }
}

/// Progress of a capture, with its photos and settings.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Record {
    /// The video that the photos are frames of.
    pub video: Option<VideoRecord>,
    /// Version of COLMAP, as `pycolmap 4.2.1`.
    pub colmap: String,
    /// Camera model, or `None` to choose it by the number of photos.
    pub camera_model: Option<String>,
    /// Choice of pairs.
    pub matching: Matching,
    /// `true` to turn the largest model upright.
    #[serde(default)]
    pub is_upright: bool,
    /// The positions of photos in a file, by the names of the photos.
    #[serde(default)]
    pub positions: BTreeMap<String, GeoPosition>,
    /// Files of the masks, by the names of their photos.
    pub masks: BTreeMap<String, FoundMask>,
    /// Names of the masks that calls have written. Others in their folder are the user's.
    #[serde(default)]
    pub own_masks: BTreeSet<String>,
    /// Photos in the folder of the user, or frames of the video.
    pub found: Vec<FoundPhoto>,
    /// Photos in the folder of images, once they are all there.
    pub photos: Option<Vec<Photo>>,
    /// Photos that aren't used.
    pub skipped: Vec<SkippedPhoto>,
    /// `true` if the database has a camera for each group of photos.
    pub has_cameras: bool,
    /// `true` if the database has the features of all photos.
    pub has_features: bool,
    /// Number of pairs whose features are matched.
    pub matched_pairs: usize,
    /// Transform from COLMAP's coordinates of the largest model to those that were written.
    #[serde(skip)]
    pub transform: Option<Upright>,
    /// Seconds that each step took, in all calls together.
    pub seconds: BTreeMap<Step, f64>,
    /// The result, without what isn't kept: the video and the other files.
    pub report: Option<CaptureReport>,
}

impl Record {
    /// Reads the record in the folder `out`, if there is one.
    ///
    /// # Errors
    /// Returns an error if the file isn't a record.
    pub fn read(out: &Path) -> Result<Option<Self>> {
        let file = out.join(FILE);
        if !file.exists() {
            return Ok(None);
        }
        let refuse = |why| Error::input(&file, "the contents", why, "what an earlier run wrote");
        let mut json: Value = serde_json::from_str(&read_text(&file)?).map_err(refuse)?;
        // Earlier versions recorded a folder.
        if let Some(masks) = json.get_mut("masks").filter(|masks| masks.is_null()) {
            *masks = json!({});
        }
        serde_json::from_value(json).map(Some).map_err(refuse)
    }

    /// Writes the record to the folder `out`.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn write(&self, out: &Path) -> Result<()> {
        write_json(&out.join(FILE), self)
    }

    /// Returns this record with the settings of `new`, without what depends on settings that have changed. If `keeps_finished`, a finished
    /// capture stays as it is.
    pub fn update(mut self, new: Record, keeps_finished: bool) -> Record {
        let has_other_masks = self.masks != new.masks;
        let is_kept = (new.masks.is_empty() || !has_other_masks) && (new.is_upright || !self.is_upright);
        if keeps_finished && self.report.is_some() && is_kept {
            return self;
        }
        // The photos stay frames of their video if the user names their folder.
        let video = new.video.or_else(|| self.video.clone());
        let new = Record { video, own_masks: self.own_masks.clone(), ..new };
        if has_other_masks {
            return new;
        }
        if (&self.colmap, &self.camera_model) != (&new.colmap, &new.camera_model) {
            self.seconds.retain(|step, _| *step == Step::Photos);
            return Record { photos: self.photos, skipped: self.skipped, seconds: self.seconds, ..new };
        }
        let matched_pairs = if self.matching == new.matching { self.matched_pairs } else { 0 };
        if (&self.matching, self.is_upright, &self.positions)
            != (&new.matching, new.is_upright, &new.positions)
        {
            self.seconds.remove(&Step::Poses);
            let Record { matching, is_upright, positions, .. } = new;
            return Record { matching, is_upright, positions, matched_pairs, report: None, ..self };
        }
        self
    }
}
