//! Frames of a video: the sharpest of each stretch of equal motion.
//!
//! A first pass of ffmpeg decodes small grey images, of which sharpness and motion are measured. The frames are chosen from these, and a
//! second pass writes them in full size.

mod choice;
mod ffmpeg;
mod grey;
mod motion;

use choice::{choose_frames, positions};
use ffmpeg::{Converter, Probe, Shown};
use globalsplat_files::{Error, Result, replace_dir};
use motion::MotionTracker;
use std::path::{Path, PathBuf};

/// Options of [`extract_frames`].
#[derive(Debug, Clone, Default)]
pub struct VideoOptions {
    /// Number of frames to write, 1 to 2,000. `None` stands for one frame per 6 % of the longer side that the picture moves, but 30 to 300
    /// frames.
    pub frames: Option<usize>,
}

/// Pass of [`extract_frames`] over a video.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VideoPass {
    /// Measures the sharpness and the motion of every frame.
    Measure,
    /// Writes the chosen frames.
    Write,
}

/// Progress of [`extract_frames`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VideoProgress {
    /// Current pass.
    pub pass: VideoPass,
    /// Number of frames that are measured or written.
    pub done: usize,
    /// Number of frames that will be, as far as the file tells it.
    pub total: Option<usize>,
}

/// Frames that [`extract_frames`] wrote.
#[derive(Debug, Clone)]
pub struct VideoFrames {
    /// Paths of the frames, in the order of the video.
    pub files: Vec<PathBuf>,
    /// Time of each frame in seconds from the start of the video.
    pub times: Vec<f64>,
    /// Number of frames in the video.
    pub source_frames: usize,
    /// Average number of frames per second in the video; 0 if the file doesn't tell it.
    pub fps: f64,
    /// Width and height of the frames in pixels.
    pub size: (u32, u32),
    /// What the user should know of the video, a sentence each: that nothing moves, that colors or frames are lost.
    pub warnings: Vec<String>,
}

impl VideoFrames {
    /// Returns a summary: "240 of 3600 frames, the sharpest of each stretch of equal motion".
    pub fn summary(&self) -> String {
        let (frames, source) = (self.files.len(), self.source_frames);
        format!("{frames} of {source} frames, the sharpest of each stretch of equal motion")
    }
}

/// Maximum number of frames: the filter of the second pass, which lists them, has to fit into a command line.
const MAX_FRAMES: usize = 2000;

/// Writes frames of `video` as JPEGs `frame_00001.jpg`, `frame_00002.jpg`, … to `folder`. The video is divided into stretches in which the
/// picture moves equally far, and the sharpest frame of each is chosen; a camera at rest adds no frames. A cut starts a new stretch.
/// Frames are upright, progressive and with square pixels; HDR becomes SDR. Replaces the frames of an earlier call in `folder`; its
/// other files stay. The folder changes only when all frames are written.
///
/// `on_progress` is called for every frame, and at least every 0.1 s in the second pass. If it returns `false`, the function ends with
/// an error and leaves the folder as it was.
///
/// # Errors
/// Returns an error if ffmpeg or ffprobe is missing, if `video` isn't a video of two or more frames, if the number of frames is out of
/// range, if a frame can't be written, or if `on_progress` returned `false`.
pub fn extract_frames(
    video: &Path,
    folder: &Path,
    options: &VideoOptions,
    mut on_progress: impl FnMut(VideoProgress) -> bool,
) -> Result<VideoFrames> {
    if let Some(frames) = options.frames.filter(|frames| !(1..=MAX_FRAMES).contains(frames)) {
        return Err(Error::setting("the number of frames", frames, format!("1 to {MAX_FRAMES}")));
    }
    let metadata = std::fs::metadata(video).map_err(Error::read(video))?;
    if !metadata.is_file() {
        return Err(Error::input(video, "the path", "no file", "a video"));
    }
    let probe = ffmpeg::probe(video)?;
    let converter = Converter::new(video, &probe)?;
    let mut warnings = converter.warnings.clone();

    let measures = measure(&converter, &probe, &mut on_progress)?;
    let source_frames = measures.sharpness.len();
    if source_frames < 2 {
        return Err(Error::input(video, "the number of frames", source_frames, "2 or more"));
    }
    let positions = positions(&measures.motion, options.frames);
    let chosen = choose_frames(&positions, &measures.sharpness);
    if chosen.len() == 1 && options.frames != Some(1) {
        warnings.push("nothing moves in the video".into());
    } else if let Some(wanted) = options.frames.filter(|wanted| chosen.len() < *wanted) {
        warnings.push(format!(
            "the picture moves in {} frames only, fewer than the {wanted} requested",
            chosen.len()
        ));
    }
    // Edit lists hide a few of the declared frames.
    if let Some(declared) = probe.declared_frames.filter(|declared| source_frames * 20 < declared * 19) {
        warnings.push(format!("{source_frames} of {declared} frames can be decoded"));
    }

    let mut shown = vec![];
    let own_names = own_frames(folder)?;
    let own_names: Vec<&str> = own_names.iter().map(String::as_str).collect();
    replace_dir(folder, &own_names, |place| {
        shown = write_frames(&converter, &chosen, place, &mut on_progress)?;
        Ok::<_, Error>(())
    })?;
    // For raw streams, which have no times.
    let time_of = |frame: usize| if probe.fps > 0. { frame as f64 / probe.fps } else { 0. };
    Ok(VideoFrames {
        files: (1..=chosen.len()).map(|number| folder.join(frame_name(number))).collect(),
        times: shown
            .iter()
            .zip(&chosen)
            .map(|(shown, frame)| shown.time.unwrap_or(time_of(*frame)))
            .collect(),
        source_frames,
        fps: probe.fps,
        size: shown[0].size,
        warnings,
    })
}

/// Sharpness of each frame, and how far the picture moves from the frame before to it, in units of the longer side.
struct Measures {
    sharpness: Vec<f64>,
    motion: Vec<f64>,
}

/// Runs the first pass over the video.
fn measure(
    converter: &Converter,
    probe: &Probe,
    on_progress: &mut impl FnMut(VideoProgress) -> bool,
) -> Result<Measures> {
    let (mut measures, mut tracker) =
        (Measures { sharpness: vec![], motion: vec![] }, MotionTracker::default());
    let mut pass = converter.decode_small()?;
    while let Some(frame) = pass.next_frame()? {
        measures.sharpness.push(frame.sharpness());
        measures.motion.push(tracker.add(&frame));
        let done = measures.motion.len();
        // The number that the file declares is an estimate.
        let total = probe.expected_frames().map(|expected| expected.max(done));
        if !on_progress(VideoProgress { pass: VideoPass::Measure, done, total }) {
            return Err(converter.stopped());
        }
    }
    pass.finish()?;
    Ok(measures)
}

/// Runs the second pass over the video, which writes the frames `chosen` to `folder`. Returns what ffmpeg tells of them.
fn write_frames(
    converter: &Converter,
    chosen: &[usize],
    folder: &Path,
    on_progress: &mut impl FnMut(VideoProgress) -> bool,
) -> Result<Vec<Shown>> {
    let mut pass = converter.write(chosen, folder)?;
    let mut shown: Vec<Shown> = vec![];
    while let Some(found) = pass.next_shown() {
        shown.extend(found);
        let progress = VideoProgress { pass: VideoPass::Write, done: shown.len(), total: Some(chosen.len()) };
        if !on_progress(progress) {
            return Err(converter.stopped());
        }
    }
    pass.finish()?;
    match shown.len() == chosen.len() {
        true => Ok(shown),
        false => Err(converter.failed(format!("ffmpeg wrote {} of {} frames", shown.len(), chosen.len()))),
    }
}

/// Returns the file name of the frame `number`, which counts from 1.
fn frame_name(number: usize) -> String {
    format!("frame_{number:05}.jpg")
}

/// Returns the names of the frames that an earlier call wrote to `folder`.
fn own_frames(folder: &Path) -> Result<Vec<String>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(_) => return Ok(vec![]),
    };
    let mut names = vec![];
    for entry in entries {
        let name = entry.map_err(Error::read(folder))?.file_name().to_string_lossy().into_owned();
        let number = name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".jpg")?.parse().ok());
        if number.is_some_and(|number| name == frame_name(number)) {
            names.push(name);
        }
    }
    Ok(names)
}
