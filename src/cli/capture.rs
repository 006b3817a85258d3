//! The command `capture`, and the captures that other commands make of photos.

use super::{Output, open_capture, progress, signals};
use crate::Error;
use crate::data;
use crate::io::{InputFiles, check_writable_file};
use crate::quality::{CaptureQuality, NextPhoto, Registration, Verdict, write_quality_page};
use anyhow::Result;
use clap::Args;
use clap::builder::BoolishValueParser;
use globalsplat_colmap::{CaptureOptions, CaptureReport, Colmap, Matching, Step, make_capture};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Make a capture from a folder of photos or a video: find the camera poses, by COLMAP, and say what to expect of them.
///
/// COLMAP is the newer of the colmap on the PATH and pycolmap, which `make poses` or `pip install pycolmap` installs;
/// GLOBALSPLAT_COLMAP names a colmap, or a Python that has pycolmap. It runs on all cores, without a GPU and offline. Ctrl-C
/// stops it, and the same command continues. Photos that are damaged, of a single color or identical to another are left
/// out. Of a video, which ffmpeg reads, the sharpest frames are taken, as far apart as the picture has moved.
///
/// The capture is good, usable or will fail: whether photos look as the depths of others and the poses predict shows poses that
/// are wrong, and too little parallax, blur, exposure or coverage show what a splat will suffer from.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat capture photos/room --out captures/room\n  \
    globalsplat capture walk.mp4 --frames 150 --out captures/walk\n  \
    globalsplat capture captures/room --report room.html\n  \
    globalsplat capture photos/garden --out captures/garden --camera-model OPENCV_FISHEYE")]
pub struct Capture {
    /// Folder of photos that show the same scene and overlap, or a video; without --out, a capture with poses, whose quality is measured
    #[arg(value_name = "PHOTOS|VIDEO|CAPTURE")]
    source: PathBuf,
    /// Folder for the capture: images, sparse and capture.json
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also write a page about the quality of the capture: a map of its cameras and of what they show, the doubtful photos, and where to
    /// take more
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    /// Number of frames to take from a video; by default one per 6 % of the picture's longer side that it moves, but 30 to 300
    #[arg(long, value_name = "N", requires = "out")]
    frames: Option<usize>,
    /// Camera model of COLMAP; by default EQUIRECTANGULAR for photos whose metadata say that they show 360 degrees, else OPENCV for
    /// 10 or more photos of one size and focal length, and SIMPLE_RADIAL for fewer
    #[arg(long, value_name = "MODEL", requires = "out")]
    camera_model: Option<String>,
    /// Pairs of photos to match: exhaustive, which is every pair; sequential, which is each photo with the next 10 by name and those
    /// nearby by GPS, and every pair among 64; or auto, which is sequential for videos and more than 200 photos
    #[arg(long, value_name = "PAIRS", default_value = "auto", value_parser = str::parse::<Matching>)]
    matching: Matching,
    /// Folder of masks named like the photos, as in photo.jpg.png, photo.png or photo_mask.png: nothing is matched in black pixels; by
    /// default the folder `masks` among the photos
    #[arg(long, value_name = "DIR", requires = "out")]
    masks: Option<PathBuf>,
    #[command(flatten)]
    upright: UprightOption,
}

/// The option `--upright` of commands that make captures of photos.
#[derive(Clone, Copy, Default, Args)]
pub struct UprightOption {
    /// Turn the capture of the photos upright, with -y up and the floor at y = 0, and scale it to metres if positions of the photos in EXIF
    /// or in a file geo.txt suffice for it; off: leave COLMAP's coordinates
    #[arg(long, value_name = "on|off", num_args = 0..=1, require_equals = true, default_missing_value = "on",
        value_parser = BoolishValueParser::new(), hide_possible_values = true)]
    upright: Option<bool>,
}

impl Capture {
    pub fn run(self) -> Result<Output> {
        if let Some(page) = &self.report {
            if page.extension().is_none_or(|extension| extension != "html") {
                return Err(Error::input(page, "the page's file extension", "another", ".html").into());
            }
            check_writable_file(page)?;
        }
        signals::handle_stop_requests();
        let Some(out) = &self.out else { return self.measure_capture() };
        let options = CaptureOptions {
            frames: self.frames,
            camera_model: self.camera_model.as_ref().map(|model| model.to_uppercase()),
            matching: self.matching,
            masks: self.masks.clone(),
            keeps_coordinates: self.upright.upright == Some(false),
            keeps_finished: false,
        };
        if self.frames.is_some() && self.source.is_dir() {
            return Err(Error::request("--frames is for videos, and the source is a folder of photos").into());
        }
        signals::end_at_request(1);
        let report = run_make_capture(&self.source, out, &options)?;
        let quality = self.measure_quality(&open_capture(out)?, Some(registration(&report)))?;
        let mut json = serde_json::to_value(&report)?;
        json["out"] = out.to_string_lossy().into();
        add_quality(&mut json, &quality)?;
        let (out, name) = (out.to_string_lossy(), out.file_name().unwrap_or("scene".as_ref()));
        let splat = Path::new(name).with_extension("ply");
        let next = ["globalsplat", "refine", "--scene", &out, "--out", &splat.to_string_lossy()];
        let quality = describe_quality(&quality);
        Ok(Output::new(json, format!("{out}: {report}\n{quality}\nnext: {}", shlex::try_join(next)?)))
    }

    /// Measures the quality of the source, a capture with poses.
    fn measure_capture(&self) -> Result<Output> {
        let capture = open_capture(&self.source).map_err(|error| {
            Error::request(format!("{error}; of photos or a video, --out DIR makes a capture"))
        })?;
        let quality = self.measure_quality(&capture, None)?;
        let mut json = json!({ "capture": self.source.to_string_lossy() });
        add_quality(&mut json, &quality)?;
        Ok(Output::new(json, format!("{}: {}", self.source.display(), describe_quality(&quality))))
    }

    /// Measures the quality of `capture`, with progress on standard error, and writes the page about it.
    fn measure_quality(
        &self,
        capture: &data::Capture,
        registration: Option<Registration>,
    ) -> Result<CaptureQuality> {
        let mut inputs = InputFiles::default();
        capture.add_input_files(&mut inputs);
        self.report.iter().try_for_each(|file| inputs.check_file(file))?;
        let bar = progress::bar(capture.len() as u64, "photos measured");
        signals::end_at_request(2);
        let quality = CaptureQuality::measure(capture, registration, |done| {
            bar.set_position(done as u64);
            !signals::is_stop_requested()
        })?;
        signals::end_at_request(1);
        bar.finish_and_clear();
        let Some(quality) = quality else { anyhow::bail!("stopped before the quality was measured") };
        self.report.iter().try_for_each(|file| write_quality_page(file, capture, &quality))?;
        Ok(quality)
    }
}

/// Returns what a report says of the estimate of poses.
fn registration(report: &CaptureReport) -> Registration {
    let &CaptureReport { photos, registered, reprojection_error, .. } = report;
    Registration { photos, registered, reprojection_error }
}

/// Adds the verdict and all figures to a result.
fn add_quality(json: &mut Value, quality: &CaptureQuality) -> Result<()> {
    json["verdict"] = serde_json::to_value(quality.verdict)?;
    json["quality"] = serde_json::to_value(quality)?;
    Ok(())
}

/// Describes the quality in a line, and the photos to take next in another if it isn't good.
fn describe_quality(quality: &CaptureQuality) -> String {
    let next: Vec<String> = quality.next_photos.iter().map(NextPhoto::to_string).collect();
    match quality.verdict {
        Verdict::Good => quality.to_string(),
        _ if next.is_empty() => quality.to_string(),
        _ => format!("{quality}\nphotos to take next: {}", next.join(", ")),
    }
}

/// Makes a capture of `source` in the folder `out`, with progress on standard error. A request to stop ends the program with an error.
fn run_make_capture(source: &Path, out: &Path, options: &CaptureOptions) -> Result<CaptureReport> {
    std::fs::metadata(source).map_err(Error::read(source))?;
    let colmap = Colmap::find()?;
    eprintln!("{colmap}");
    let mut bar: Option<(&'static str, progress::Progress)> = None;
    signals::end_at_request(2);
    let report = make_capture(source, out, options, &colmap, &mut |at| {
        let unit = at.step.unit();
        if bar.as_ref().is_none_or(|(current, _)| *current != unit) {
            if at.step == Step::Wait {
                eprintln!("another process uses {}; waiting", out.display());
            }
            let next = progress::bar(at.total as u64, unit);
            if let Some((_, finished)) = bar.replace((unit, next)) {
                finished.finish_and_clear();
            }
        }
        if let Some((_, bar)) = &bar {
            bar.set_length(at.total as u64);
            bar.set_position(at.done as u64);
        }
        !signals::is_stop_requested()
    });
    signals::end_at_request(1);
    if let Some((_, bar)) = bar {
        bar.finish_and_clear();
    }
    let Some(report) = report? else {
        anyhow::bail!("stopped; the same command continues in {}", out.display())
    };
    if let Some(video) = &report.video {
        eprintln!("{}: {}", source.display(), video.chosen.summary);
        video.chosen.warnings.iter().for_each(|line| eprintln!("{}: {line}", source.display()));
    }
    Ok(report)
}

/// The photos of a command: a capture, or photos or a video of which one is made.
#[derive(Args)]
#[group(required = true, multiple = false)]
pub struct SceneSource {
    /// Capture: a folder with a cameras.json, a transforms.json, a COLMAP model or Polycam's keyframes, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH")]
    scene: Option<PathBuf>,
    /// Folder of photos, or a video, without camera poses: COLMAP finds them first, as in `globalsplat capture`, and the capture
    /// is kept beside the output, as room_capture for room.ply
    #[arg(long, value_name = "PHOTOS|VIDEO")]
    photos: Option<PathBuf>,
}

impl SceneSource {
    /// Returns `true` if the capture has to be made first.
    pub fn is_unposed(&self) -> bool {
        self.photos.is_some()
    }

    /// Returns the path of the capture, and the folder of masks to open it with. If it has to be made, it is made beside the output `out` with
    /// the masks in the folder `masks`, which it then has itself.
    pub fn path<'a>(
        &self,
        masks: Option<&'a Path>,
        upright: UprightOption,
        out: &Path,
    ) -> Result<(PathBuf, Option<&'a Path>)> {
        let Some(photos) = &self.photos else {
            if upright.upright.is_some() {
                let line = "--upright is for --photos; convert --upright turns a splat of a capture";
                return Err(Error::request(line).into());
            }
            return Ok((self.scene.clone().unwrap_or_default(), masks));
        };
        let name = out.file_name().unwrap_or_default().to_string_lossy();
        let stem = name.rsplit_once('.').map_or(&*name, |(stem, _)| stem);
        let capture = out.with_file_name(format!("{}_capture", stem.trim_end_matches(".compressed")));
        // A capture that `globalsplat capture` made with other settings is used as it is.
        let masks = masks.map(Path::to_owned);
        let keeps_coordinates = upright.upright == Some(false);
        let options =
            CaptureOptions { keeps_finished: true, keeps_coordinates, masks, ..CaptureOptions::default() };
        let report = run_make_capture(photos, &capture, &options)?;
        eprintln!("{}: {report}", capture.display());
        Ok((capture, None))
    }
}
