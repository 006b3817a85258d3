//! Captures from photos or a video.

use crate::colmap::Colmap;
use crate::estimate::{PoseOptions, PoseProgress, estimate_poses};
use crate::record::{Matching, PoseReport, VIDEO_FILE};
use crate::video::{VideoOptions, VideoProgress, extract_frames};
use globalsplat_files::{Error, Result, read_text, write_json};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::UNIX_EPOCH;

/// Options of [`make_capture`].
#[derive(Debug, Clone, Default)]
pub struct CaptureOptions {
    /// Choice of the frames of a video.
    pub video: VideoOptions,
    /// Settings of the estimate. Frames of a video are matched in their order unless [`PoseOptions::matching`] says otherwise.
    pub poses: PoseOptions,
}

/// Progress of [`make_capture`].
#[derive(Debug, Clone, Copy)]
pub enum CaptureProgress {
    /// Frames of the video are chosen and written.
    Video(VideoProgress),
    /// Poses are estimated.
    Poses(PoseProgress),
}

/// Result of [`make_capture`].
#[derive(Debug, Clone, Serialize)]
pub struct CaptureReport {
    /// The frames that were taken from a video.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub video: Option<VideoRecord>,
    /// Result of the estimate.
    #[serde(flatten)]
    pub poses: PoseReport,
}

/// Which video the frames of a capture are from, and what was said of them.
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
    /// Summary of the frames, as `240 of 3600 frames, the sharpest of each stretch of equal motion`.
    pub summary: String,
    /// Sentences on what the user should know of the video.
    pub warnings: Vec<String>,
    /// Time of each frame in seconds from the start of the video.
    pub times: Vec<f64>,
}

impl VideoRecord {
    /// Describes the file at `video`, without its frames.
    fn new(video: &Path, frames: Option<usize>) -> Result<Self> {
        let metadata = std::fs::metadata(video).map_err(Error::read(video))?;
        let modified = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        Ok(VideoRecord {
            name: video.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            bytes: metadata.len(),
            modified: modified.unwrap_or_default().as_secs(),
            frames,
            summary: String::new(),
            warnings: vec![],
            times: vec![],
        })
    }

    /// Returns `true` if the frames of `other` are those of this video and this request.
    fn matches(&self, other: &Self) -> bool {
        let key = |record: &Self| (record.name.clone(), record.bytes, record.modified, record.frames);
        key(self) == key(other)
    }
}

/// Makes a capture in the folder `out` of `source`, a folder of photos or a video: chooses the frames of a video by [`extract_frames`] and
/// estimates poses by [`estimate_poses`].
///
/// If `on_progress` returns `false`, the work is stopped and the result is `None`; the same call continues it.
///
/// # Errors
/// Fails like these functions. Frames of another video in `out` are an error, too.
pub fn make_capture(
    source: &Path,
    out: &Path,
    options: &CaptureOptions,
    colmap: &Colmap,
    mut on_progress: impl FnMut(CaptureProgress) -> bool,
) -> Result<Option<CaptureReport>> {
    let mut poses = options.poses.clone();
    let estimate =
        |photos: &Path, poses: &PoseOptions, on_progress: &mut dyn FnMut(CaptureProgress) -> bool| {
            estimate_poses(photos, out, poses, colmap, &mut |progress| {
                on_progress(CaptureProgress::Poses(progress))
            })
        };
    if !source.is_file() {
        let report = estimate(source, &poses, &mut on_progress)?;
        return Ok(report.map(|poses| CaptureReport { video: None, poses }));
    }
    let Some(video) = frames_of_video(source, out, options, &mut on_progress)? else {
        return Ok(None);
    };
    if poses.matching == Matching::Auto {
        poses.matching = Matching::Sequential;
    }
    let report = estimate(&out.join("images"), &poses, &mut on_progress)?;
    Ok(report.map(|poses| CaptureReport { video: Some(video), poses }))
}

/// Writes the frames of `video` to the folder of images in `out`, unless an earlier call has. Returns `None` if `on_progress` returns
/// `false`.
fn frames_of_video(
    video: &Path,
    out: &Path,
    options: &CaptureOptions,
    on_progress: &mut dyn FnMut(CaptureProgress) -> bool,
) -> Result<Option<VideoRecord>> {
    let record = VideoRecord::new(video, options.video.frames)?;
    let file = out.join(VIDEO_FILE);
    if file.exists() {
        let refuse = |why| Error::input(&file, "the contents", why, "what an earlier run wrote");
        let old: VideoRecord = serde_json::from_str(&read_text(&file)?).map_err(refuse)?;
        let asked = VideoRecord {
            frames: if options.poses.keeps_finished { old.frames } else { record.frames },
            ..record.clone()
        };
        if !asked.matches(&old) {
            let expected = format!("{}, or a folder without a capture", record.describe());
            return Err(Error::input(&file, "the video", old.describe(), expected));
        }
        return Ok(Some(old));
    }
    // A call that was killed leaves hidden files, or frames alone.
    let is_own = |entry: std::fs::DirEntry| {
        let name = entry.file_name();
        let is_frame = |frame: std::fs::DirEntry| frame.file_name().as_encoded_bytes().starts_with(b"frame_");
        let has_frames_alone = || {
            std::fs::read_dir(entry.path())
                .is_ok_and(|mut frames| frames.all(|frame| frame.is_ok_and(is_frame)))
        };
        name.as_encoded_bytes().starts_with(b".") || name == "images" && has_frames_alone()
    };
    if std::fs::read_dir(out).is_ok_and(|mut entries| !entries.all(|entry| entry.is_ok_and(is_own))) {
        return Err(Error::input(
            out,
            "the output",
            "a folder with other files",
            "a new folder, or one with such a capture",
        ));
    }
    let mut is_stopped = false;
    let frames = extract_frames(video, &out.join("images"), &options.video, |progress| {
        is_stopped |= !on_progress(CaptureProgress::Video(progress));
        !is_stopped
    });
    if is_stopped {
        return Ok(None);
    }
    let frames = frames?;
    let record =
        VideoRecord { summary: frames.summary(), warnings: frames.warnings, times: frames.times, ..record };
    write_json(&file, &record)?;
    Ok(Some(record))
}

impl VideoRecord {
    /// Describes which frames were asked for.
    fn describe(&self) -> String {
        let frames = self.frames.map(|frames| format!("{frames} frames of ")).unwrap_or_default();
        format!("{frames}{} ({} bytes)", self.name, self.bytes)
    }
}
