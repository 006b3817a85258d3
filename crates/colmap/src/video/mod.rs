//! Frames of a video: the sharpest of each segment of equal motion.
//!
//! A first pass of ffmpeg decodes small gray images, of which sharpness and motion are measured. The frames are chosen from these, and a
//! second pass writes them in full size.

mod ffmpeg;
mod frame_selection;
mod motion;

use crate::progress::{Progress, Reporter, Step};
use ffmpeg::Video;
use frame_selection::{positions, select_frames};
use globalsplat_files::{Error, Result};
use motion::{MotionTracker, sharpness_of};
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::path::Path;
use std::{fs, io};

/// Maximum number of frames: the filter of the second pass, which lists them, has to fit into a command line.
const MAX_REQUESTED_FRAMES: usize = 2000;

/// Frames that were chosen from a video.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct VideoFrames {
    /// Index of each frame in the video, from 0.
    pub indices: Vec<usize>,
    /// Summary, as `240 of 3600 frames, the sharpest of each segment of equal motion`.
    pub summary: String,
    /// What the user should know of the video, a sentence each: that nothing moves, that colors or frames are lost.
    pub warnings: Vec<String>,
}

/// Writes frames of `video` as JPEGs `frame_00001.jpg`, `frame_00002.jpg`, … to `folder`. The video is divided into segments in which the
/// picture moves equally far, and the sharpest frame of each is chosen; a camera at rest adds no frames. A cut starts a new segment.
/// Frames are upright, progressive and with square pixels; HDR becomes SDR. They appear in the folder, which must be new or empty, when all
/// are written.
///
/// The number of frames is `count`, 1 to 2,000. `None` stands for one frame per 6 % of the longer side that the picture moves, but 30 to
/// 300 frames.
///
/// `on_progress` is called for every frame, and several times a second in the second pass. If it returns `false`, the result is `None` and
/// the folder stays as it was.
///
/// # Errors
/// Returns an error if ffmpeg or ffprobe is missing, if `folder` has files, if `video` isn't a video of two or more frames, if the number
/// of frames is out of range, or if a frame can't be written.
pub fn extract_frames(
    video: &Path,
    folder: &Path,
    count: Option<usize>,
    on_progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Option<VideoFrames>> {
    Reporter::run(on_progress, |reporter| write_sharpest_frames(video, folder, count, reporter, |_| Ok(())))
}

/// Checks that `video` can be opened, and that the number of frames is in range.
pub(crate) fn check_video(video: &Path, count: Option<usize>) -> Result<()> {
    open(video, count).map(drop)
}

fn open(video: &Path, count: Option<usize>) -> Result<Video<'_>> {
    if let Some(count) = count.filter(|count| !(1..=MAX_REQUESTED_FRAMES).contains(count)) {
        return Err(Error::setting("the number of frames", count, format!("1 to {MAX_REQUESTED_FRAMES}")));
    }
    Video::open(video)
}

/// Returns the name of a file in `folder` that isn't hidden, if there is one.
pub(crate) fn first_visible(folder: &Path) -> Option<OsString> {
    let mut names = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.find(|name| !name.as_encoded_bytes().starts_with(b"."))
}

/// Writes frames like [`extract_frames`]. Calls `before_moving` with their number before any appears in the folder, and ends if it fails.
pub(crate) fn write_sharpest_frames(
    video: &Path,
    folder: &Path,
    count: Option<usize>,
    reporter: &mut Reporter,
    before_moving: impl FnOnce(usize) -> Result<()>,
) -> Result<VideoFrames> {
    if let Some(name) = first_visible(folder) {
        let found = format!("one with {}", name.display());
        return Err(Error::input(folder, "the folder of frames", found, "a new or empty folder"));
    }
    let source = open(video, count)?;
    let (sharpness, motion) = measure(&source, reporter)?;
    let total = sharpness.len();
    if total < 2 {
        return Err(Error::input(video, "the number of frames", total, "2 or more"));
    }
    let indices = select_frames(&positions(&motion, count), &sharpness);
    let chosen = indices.len();
    let mut warnings = source.warnings.clone();
    if chosen == 1 && count != Some(1) {
        warnings.push("nothing moves in the video".into());
    } else if let Some(count) = count.filter(|count| chosen < *count) {
        warnings.push(format!("the picture moves in {chosen} frames only, fewer than the {count} requested"));
    }
    // Edit lists hide a few of the declared frames.
    if let Some(declared) = source.declared_frames.filter(|declared| total * 20 < declared * 19) {
        warnings.push(format!("{total} of {declared} frames can be decoded"));
    }
    let partial = folder.join(".globalsplat-partial");
    // A call that was killed may have left frames.
    let _ = fs::remove_dir_all(&partial);
    fs::create_dir_all(&partial).map_err(Error::write(folder))?;
    let written = write_frames(&source, &indices, &partial, reporter);
    let written = written.and_then(|()| before_moving(chosen));
    let written = written.and_then(|()| move_frames(&partial, folder).map_err(Error::write(folder)));
    let _ = fs::remove_dir_all(&partial);
    written?;
    let summary = format!("{chosen} of {total} frames, the sharpest of each segment of equal motion");
    Ok(VideoFrames { indices, summary, warnings })
}

/// Runs the first pass over the video. Returns the sharpness of each frame, and how far the picture moves from the frame before to it, in
/// units of the longer side.
fn measure(video: &Video, reporter: &mut Reporter) -> Result<(Vec<f64>, Vec<f64>)> {
    let (mut sharpness, mut motion, mut tracker) = (vec![], vec![], MotionTracker::default());
    video.decode_small(|frame| {
        sharpness.push(sharpness_of(frame));
        motion.push(tracker.add(frame));
        // The number that the file declares is an estimate.
        let done = motion.len();
        reporter.report(Progress { step: Step::Measure, done, total: video.expected_frames.max(done) })
    })?;
    Ok((sharpness, motion))
}

/// Runs the second pass over the video, which writes the frames `chosen` to `folder`.
fn write_frames(video: &Video, chosen: &[usize], folder: &Path, reporter: &mut Reporter) -> Result<()> {
    let total = chosen.len();
    let mut report_written = || {
        let done = frames_in(folder).len();
        reporter.report(Progress { step: Step::Frames, done, total }).map(|()| done)
    };
    video.write(chosen, folder, || report_written().map(drop))?;
    match report_written()? {
        written if written == total => Ok(()),
        written => Err(video.failed(format!("ffmpeg wrote {written} of {total} frames"))),
    }
}

/// Moves the frames in the folder `from` to the folder `to`.
fn move_frames(from: &Path, to: &Path) -> io::Result<()> {
    frames_in(from).iter().try_for_each(|name| fs::rename(from.join(name), to.join(name)))
}

/// Removes the first `count` frames from `folder`, as far as a call that was stopped has moved them there.
pub(crate) fn remove_frames(folder: &Path, count: usize) -> Result<()> {
    let frames = (1..=count).map(|number| folder.join(format!("frame_{number:05}.jpg")));
    frames.filter(|frame| frame.exists()).try_for_each(fs::remove_file).map_err(Error::write(folder))
}

/// Returns the names of the frames in `folder`.
fn frames_in(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let is_frame = |name: &String| {
        let number = name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".jpg"));
        number.is_some_and(|number| number.len() >= 5 && number.bytes().all(|digit| digit.is_ascii_digit()))
    };
    names.filter(is_frame).collect()
}
