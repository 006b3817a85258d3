//! Captures from photos or a video: which folders may be used, what an earlier call has made, and the steps in their order.

use crate::colmap::Colmap;
use crate::photos::{find_photo_masks, find_photos, find_positions};
use crate::poses::Estimate;
use crate::progress::{Progress, Reporter, Step};
use crate::record::{CaptureReport, FILE, Matching, Record, VideoRecord};
use crate::video::{check_video, first_visible, remove_frames, write_sharpest_frames};
use globalsplat_capture::{COLMAP_MODELS, GEO_FILE, is_polycam, list_photos};
use globalsplat_files::{Error, FolderLock, Result, check_writable_dir, is_same_file, real_path};
use std::collections::BTreeMap;
use std::fs::{self, DirEntry};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Time between attempts to lock a capture.
const PAUSE: Duration = Duration::from_millis(200);

/// Options of [`make_capture`].
#[derive(Debug, Clone, Default)]
pub struct CaptureOptions {
    /// Number of frames to take from a video, 1 to 2,000. `None` stands for one frame per 6 % of the longer side that the picture moves,
    /// but 30 to 300 frames.
    pub frames: Option<usize>,
    /// A camera model of COLMAP. By default EQUIRECTANGULAR for panoramas of 360° whose XMP data say so, else OPENCV for 10 or more photos
    /// of one size and focal length, and SIMPLE_RADIAL for fewer.
    pub camera_model: Option<String>,
    /// Choice of pairs.
    pub matching: Matching,
    /// Folder of masks, named like the photos; by default the folder `masks` among the photos, if there is one. Black pixels have no
    /// features.
    pub masks: Option<PathBuf>,
    /// `true` to leave the largest model in COLMAP's coordinates. Otherwise it is turned upright, as by
    /// [`estimate_upright`](globalsplat_capture::estimate_upright), and is in metres if the positions of the photos in their EXIF data, or in a file `geo.txt` among or beside them, agree with it.
    pub keeps_coordinates: bool,
    /// `true` to use a finished capture as it is, whatever settings it was made with.
    pub keeps_finished: bool,
}

/// Makes a capture in the folder `out` of `source`, a folder of photos or a video: chooses the frames of a video like
/// [`extract_frames`](crate::extract_frames), estimates poses by `colmap` on all cores, and writes the photos to `images` and COLMAP's
/// models to `sparse/0`, `sparse/1`, …
///
/// `on_progress` is called several times a second. If it returns `false`, the work is stopped and the result is `None`; the same call
/// continues where it was stopped. `capture.json` records how far the capture is. A call with other settings repeats what depends on them.
///
/// Photos that are damaged, of a single color or identical to another are left out and reported.
///
/// # Errors
/// Returns an error if there are fewer than two different photos or frames; if `out` contains something else, or the capture of other
/// photos; if ffmpeg or COLMAP fails; or if COLMAP registers no photo.
pub fn make_capture(
    source: &Path,
    out: &Path,
    options: &CaptureOptions,
    colmap: &Colmap,
    on_progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Option<CaptureReport>> {
    Reporter::run(on_progress, |reporter| make_or_continue(source, out, options, colmap, reporter))
}

fn make_or_continue(
    source: &Path,
    out: &Path,
    options: &CaptureOptions,
    colmap: &Colmap,
    reporter: &mut Reporter,
) -> Result<CaptureReport> {
    let models = COLMAP_MODELS.map(|(model, _)| model);
    if let Some(model) = options.camera_model.as_ref().filter(|model| !models.contains(&model.as_str())) {
        return Err(Error::setting("the camera model", model, format!("one of {}", models.join(", "))));
    }
    if out.to_str().is_none() {
        return Err(Error::input(
            out,
            "the output",
            "a path that isn't UTF-8",
            "one that is, which COLMAP needs",
        ));
    }
    let (images, is_video) = (out.join("images"), source.is_file());
    let photos = if is_video { &images } else { source };
    let read = || {
        let old = Record::read(out)?;
        check_output(photos, out, is_video, old.is_none()).map(|()| old)
    };
    // Nothing is created for what is refused.
    let is_started = read()?.is_some();
    match is_video {
        true if is_started => {}
        true => check_video(source, options.frames)?,
        false => list_photos(photos).and_then(|list| check_count(photos, list.photos.len()))?,
    }
    check_writable_dir(out)?;
    let _lock = wait_for_lock(out, reporter)?;
    let mut old = read()?;
    let write_frames = || frames_of_video(source, out, options, old.as_ref(), reporter);
    let video = is_video.then(write_frames).transpose()?;
    // A call that was stopped before it had all frames.
    old = old.filter(|old| old.video.as_ref().is_none_or(VideoRecord::is_finished));
    let (found, other_files) = find_photos(photos)?;
    check_count(photos, found.len())?;
    let new = Record {
        video,
        colmap: colmap.name_and_version(),
        camera_model: options.camera_model.clone(),
        matching: match options.matching {
            Matching::Auto if is_video => Matching::Sequential,
            matching => matching,
        },
        is_upright: !options.keeps_coordinates,
        positions: match is_video || options.keeps_coordinates {
            true => BTreeMap::new(),
            false => find_positions(photos, &found)?,
        },
        masks: find_photo_masks(photos, &found, options.masks.as_deref(), out, old.as_ref())?,
        found,
        ..Record::default()
    };
    let record = match old {
        Some(old) if old.found != new.found => {
            let found = format!("that of {} other or changed photos", old.found.len());
            let expected = format!(
                "the {} photos of {}, or a folder without a capture",
                new.found.len(),
                photos.display()
            );
            return Err(Error::input(out.join(FILE), "the list of photos", found, expected));
        }
        Some(old) => old.update(new, options.keeps_finished),
        None => new,
    };
    record.write(out)?;
    let mut estimate = Estimate { photos, out, images: &images, colmap, record, reporter };
    let report = match estimate.record.report.clone() {
        Some(report) => report,
        None => estimate.run_steps()?,
    };
    Ok(CaptureReport { video: estimate.record.video, other_files, ..report })
}

fn check_count(photos: &Path, count: usize) -> Result<()> {
    match count {
        0 | 1 => Err(Error::input(photos, "the number of photos", count, "2 or more")),
        _ => Ok(()),
    }
}

/// Checks that a capture of the photos in the folder `photos` may be written to `out`: the photos may be the capture's own images, but no
/// other folder of photos may contain the capture, which would then be found among the photos. If `is_new`, the folder `out` may only
/// contain hidden files and these photos, or a folder of images without any.
fn check_output(photos: &Path, out: &Path, is_video: bool, is_new: bool) -> Result<()> {
    // The frames of a video are written later.
    if !is_video {
        if is_polycam(photos) {
            let expected = "--scene with this folder, or a folder of photos alone";
            return Err(Error::input(
                photos,
                "the folder of photos",
                "raw data of Polycam, which have poses",
                expected,
            ));
        }
        fs::metadata(photos).map_err(Error::read(photos))?;
        if real_path(out).starts_with(real_path(photos)) {
            let expected = format!("a folder outside of {}", photos.display());
            return Err(Error::input(out, "the output", "inside the folder of photos", expected));
        }
    }
    let is_known = |entry: &DirEntry| {
        entry.file_name().as_encoded_bytes().starts_with(b".")
            || entry.file_name() == GEO_FILE
            || is_same_file(&entry.path(), photos) && (!is_video || first_visible(photos).is_none())
    };
    let other = fs::read_dir(out).into_iter().flatten().flatten().find(|entry| !is_known(entry));
    match other.filter(|_| is_new) {
        None => Ok(()),
        Some(other) => {
            let found = format!("a folder with {}", other.file_name().display());
            Err(Error::input(out, "the output", found, "a new folder, or one with such a capture"))
        }
    }
}

/// Locks the folder `out`, once no other process uses it.
fn wait_for_lock(out: &Path, reporter: &mut Reporter) -> Result<FolderLock> {
    loop {
        if let Ok(lock) = FolderLock::try_take(out)? {
            return Ok(lock);
        }
        reporter.report(Progress { step: Step::Wait, done: 0, total: 1 })?;
        std::thread::sleep(PAUSE);
    }
}

/// Writes the frames of `video` to the folder of images in `out`, unless the call that wrote the record `old` has.
fn frames_of_video(
    video: &Path,
    out: &Path,
    options: &CaptureOptions,
    old: Option<&Record>,
    reporter: &mut Reporter,
) -> Result<VideoRecord> {
    let (mut record, images) = (VideoRecord::new(video, options.frames)?, out.join("images"));
    match old.map(|old| &old.video) {
        None => {}
        Some(Some(old)) if old.is_finished() && record.matches(old, options.keeps_finished) => {
            return Ok(old.clone());
        }
        Some(Some(old)) if !old.is_finished() => remove_frames(&images, old.moving.unwrap_or(0))?,
        Some(other) => {
            let found = other.as_ref().map_or("none".to_string(), VideoRecord::to_string);
            let expected = format!("{record}, or a folder without a capture");
            return Err(Error::input(out.join(FILE), "the video", found, expected));
        }
    }
    let before_moving = |count| {
        record.moving = Some(count);
        Record { video: Some(record.clone()), ..Record::default() }.write(out)
    };
    record.chosen = write_sharpest_frames(video, &images, options.frames, reporter, before_moving)?;
    record.moving = None;
    Ok(record)
}
