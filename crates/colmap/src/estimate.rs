//! Estimates the poses of the photos in a folder, step by step.

use crate::colmap::{
    CAMERA_MODELS, Colmap, Command, ModelSummary, Outcome, exhaustive_pairs, model_folders, read_models,
    sequential_pairs,
};
use crate::photos::{FoundPhoto, Photo, SkippedPhoto, find_photos, import_photos};
use crate::record::{FILE, Matching, PoseReport, Record, Step, VIDEO_FILE, format_first};
use globalsplat_capture::MASKS_FOLDER;
use globalsplat_files::{Error, Result, write_atomically};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Maximum number of photos of which every pair is matched by default.
const EXHAUSTIVE_PHOTOS: usize = 200;
/// Distance up to which photos in shooting order are matched.
const OVERLAP: usize = 10;
/// Number of photos spread over a sequence of which every pair is matched.
const SPREAD: usize = 64;
/// Number of pairs that one call of COLMAP matches.
const PAIRS_PER_CALL: usize = 128;

/// Side in pixels to which larger photos are reduced before features are detected.
const MAX_SIDE: u32 = 1600;
/// Side from which the photo isn't enlarged twofold before features are detected.
const UPSAMPLED_SIDE: u32 = 1000;
/// Number of features per photo.
const FEATURES: u32 = 2048;
/// Largest distance in pixels between a feature and the projection of its point, in photos of at most [`MAX_SIDE`] pixels; COLMAP's 4
/// keeps wrong matches on repeated textures, such as paving.
const MAX_REPROJECTION_ERROR: f64 = 2.;

/// Minimum number of photos with one camera for which the camera has separate focal lengths and tangential distortion.
const OPENCV_PHOTOS: usize = 10;
/// Minimum number of photos of a fisheye for which the lens's centre is estimated. Few photos can't tell it from a rotation of the camera.
const CENTRE_PHOTOS: usize = 10;
/// Focal length of photos without EXIF, relative to their longer side: that of a phone's or a camera's wide lens. The estimate may fail if
/// it is far off.
const FOCAL: f64 = 0.85;
/// [`FOCAL`] of a fisheye lens. For one of 0.38, the estimate succeeds from 0.25 to 0.6.
const FISHEYE_FOCAL: f64 = 0.4;
/// Fisheye models of COLMAP, and their numbers of focal lengths and of distortion coefficients.
const FISHEYE_MODELS: [(&str, usize, usize); 7] = [
    ("OPENCV_FISHEYE", 2, 4),
    ("SIMPLE_RADIAL_FISHEYE", 1, 1),
    ("RADIAL_FISHEYE", 1, 2),
    ("THIN_PRISM_FISHEYE", 2, 8),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    ("SIMPLE_FISHEYE", 1, 0),
    ("FISHEYE", 2, 0),
];

/// Share of the photos below which a report says what to try.
const FEW_REGISTERED: f64 = 0.8;

/// Settings of [`estimate_poses`].
#[derive(Debug, Clone, Default)]
pub struct PoseOptions {
    /// One of [`CAMERA_MODELS`]. By default EQUIRECTANGULAR for panoramas of 360° whose XMP data say so, else OPENCV for
    /// 10 or more photos of one size and focal length, and SIMPLE_RADIAL for fewer.
    pub camera_model: Option<String>,
    /// Choice of pairs.
    pub matching: Matching,
    /// Folder of masks, named like the photos; by default the folder `masks` among the photos, if there is one. Black pixels have no
    /// features.
    pub masks: Option<PathBuf>,
    /// `true` to use a finished estimate as it is, whatever settings it was made with.
    pub keeps_finished: bool,
}

/// Progress of [`estimate_poses`].
#[derive(Debug, Clone, Copy)]
pub struct PoseProgress {
    /// Current step.
    pub step: Step,
    /// Number of photos or pairs that the step is finished with.
    pub done: usize,
    /// Number of photos or pairs in all.
    pub total: usize,
}

/// Estimates the poses of the photos in the folder `photos` by `colmap`, on all cores, and writes a capture to the folder `out`: the photos
/// in `images`, and COLMAP's models in `sparse/0`, `sparse/1`, …
///
/// `on_progress` is called several times a second. If it returns `false`, COLMAP is stopped and the result is `None`; the same call
/// continues where it was stopped. `capture.json` records how far the estimate is. A call with other settings repeats what depends on
/// them.
///
/// Photos that are damaged, of a single color or identical to another are left out and reported.
///
/// # Errors
/// Returns an error if there are fewer than two different photos; if `out` contains something else, or the capture of other photos; if
/// COLMAP fails; or if it registers no photo.
pub fn estimate_poses(
    photos: &Path,
    out: &Path,
    options: &PoseOptions,
    colmap: &Colmap,
    on_progress: &mut dyn FnMut(PoseProgress) -> bool,
) -> Result<Option<PoseReport>> {
    if let Some(model) = options.camera_model.as_deref().filter(|model| !CAMERA_MODELS.contains(model)) {
        return Err(Error::setting(
            "the camera model",
            model,
            format!("one of {}", CAMERA_MODELS.join(", ")),
        ));
    }
    check_folders(photos, out)?;
    let (found, others) = find_photos(photos)?;
    if found.len() < 2 {
        return Err(Error::input(photos, "the number of photos", found.len(), "2 or more"));
    }
    let images = out.join("images");
    let record = prepare_record(photos, out, options, colmap, found)?;
    fs::create_dir_all(&images).map_err(Error::write(&images))?;
    record.write(out)?;
    let mut estimate = Estimate { out, images, colmap, record, on_progress };
    for step in [Step::Photos, Step::Features, Step::Pairs, Step::Poses] {
        let start = Instant::now();
        let outcome = match step {
            Step::Photos => estimate.import(photos),
            Step::Features => estimate.extract_features(),
            Step::Pairs => estimate.match_pairs(),
            Step::Poses => estimate.run_mapper(),
        };
        if estimate.record.report.is_none() {
            *estimate.record.seconds.entry(step).or_default() += start.elapsed().as_secs_f64();
        }
        estimate.record.write(out)?;
        if outcome? == Outcome::Stopped {
            return Ok(None);
        }
    }
    if estimate.record.report.is_none() {
        estimate.record.report = Some(estimate.report()?);
        estimate.record.write(out)?;
    }
    Ok(estimate.record.report.map(|report| PoseReport { other_files: others, ..report }))
}

/// Checks that a capture of the photos in `photos` may be written to `out`: the photos may be the capture's own images, but no other folder
/// of photos may contain the capture, which would then be found among the photos.
fn check_folders(photos: &Path, out: &Path) -> Result<()> {
    let canonical = photos.canonicalize().map_err(Error::read(photos))?;
    let existing = out.ancestors().find_map(|folder| {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        folder.canonicalize().ok()
    });
    if existing.is_some_and(|out| out.starts_with(&canonical)) {
        let expected = format!("a folder outside of {}", photos.display());
        return Err(Error::input(out, "the output", "inside the folder of photos", expected));
    }
    Ok(())
}

/// Returns the record of the estimate: the one in `out`, without what depends on settings that have changed, or a new one.
fn prepare_record(
    photos: &Path,
    out: &Path,
    options: &PoseOptions,
    colmap: &Colmap,
    found: Vec<FoundPhoto>,
) -> Result<Record> {
    let PoseOptions { camera_model, matching, masks, .. } = options.clone();
    let new = Record {
        colmap: colmap.name_and_version(),
        camera_model,
        matching,
        masks,
        found,
        photos: None,
        skipped: vec![],
        has_cameras: false,
        has_features: false,
        matched_pairs: 0,
        seconds: BTreeMap::new(),
        report: None,
    };
    let Some(old) = Record::read(out)? else {
        check_new_folder(photos, out)?;
        return Ok(new);
    };
    if old.found != new.found {
        return Err(Error::input(
            out.join(FILE),
            "the list of photos",
            format!("that of {} other or changed photos", old.found.len()),
            format!("the {} photos of {}, or a folder without a capture", new.found.len(), photos.display()),
        ));
    }
    if options.keeps_finished && old.report.is_some() {
        return Ok(old);
    }
    if new.masks != old.masks {
        return Ok(new);
    }
    let mut record = Record { colmap: new.colmap, camera_model: new.camera_model, matching, ..old.clone() };
    if (&record.colmap, &record.camera_model) != (&old.colmap, &old.camera_model) {
        record.has_cameras = false;
        record.has_features = false;
        record.matched_pairs = 0;
        record.seconds.retain(|step, _| *step == Step::Photos);
        record.report = None;
    } else if record.matching != old.matching {
        record.matched_pairs = 0;
        record.seconds.remove(&Step::Poses);
        record.report = None;
    }
    Ok(record)
}

/// Checks that the folder `out` is missing, empty, or has nothing but the photos and the record of the video that they are from.
fn check_new_folder(photos: &Path, out: &Path) -> Result<()> {
    let photos = photos.canonicalize().map_err(Error::read(photos))?;
    for entry in fs::read_dir(out).into_iter().flatten().flatten() {
        let is_own =
            entry.file_name() == VIDEO_FILE || entry.file_name().as_encoded_bytes().starts_with(b".");
        if !is_own && entry.path().canonicalize().ok().as_ref() != Some(&photos) {
            let found = format!("a folder with {}", entry.file_name().display());
            return Err(Error::input(out, "the output", found, "a new folder, or one with such a capture"));
        }
    }
    Ok(())
}

/// An estimate at work.
struct Estimate<'a> {
    out: &'a Path,
    /// Folder of the photos that COLMAP reads.
    images: PathBuf,
    colmap: &'a Colmap,
    record: Record,
    on_progress: &'a mut dyn FnMut(PoseProgress) -> bool,
}

impl Estimate<'_> {
    fn import(&mut self, source: &Path) -> Result<Outcome> {
        if self.record.photos.is_none() {
            let total = self.record.found.len();
            let mut report = |done| (self.on_progress)(PoseProgress { step: Step::Photos, done, total });
            let masks = self.record.masks.as_deref();
            let imported = import_photos(source, &self.record.found, masks, &self.images, &mut report)?;
            let Some(imported) = imported else { return Ok(Outcome::Stopped) };
            if imported.photos.len() < 2 {
                return Err(too_few(source, total, &imported.skipped));
            }
            self.record.photos = Some(imported.photos);
            self.record.skipped = imported.skipped;
            self.record.write(self.out)?;
        }
        Ok(Outcome::Finished)
    }

    fn photos(&self) -> &[Photo] {
        self.record.photos.as_deref().unwrap_or_default()
    }

    fn database(&self) -> PathBuf {
        self.out.join("database.db")
    }

    /// Runs a command on the database. `count` is added to the counts that it reports of `step`.
    fn run(&mut self, command: Command, step: Step, before: usize, total: usize) -> Result<Outcome> {
        let command = command.path("database_path", &self.database());
        let mut done = before;
        if !(self.on_progress)(PoseProgress { step, done, total }) {
            return Ok(Outcome::Stopped);
        }
        command.run(self.colmap, &self.out.join("colmap.log"), &mut |count| {
            done = count.map_or(done, |count| (before + count).min(total));
            (self.on_progress)(PoseProgress { step, done, total })
        })
    }

    /// Detects features. Photos of one size and focal length share a camera, whose number is that of their group.
    fn extract_features(&mut self) -> Result<Outcome> {
        if self.record.has_features {
            return Ok(Outcome::Finished);
        }
        let groups = group_by_camera(self.photos(), self.record.camera_model.as_deref());
        let total = self.photos().len();
        if !self.record.has_cameras {
            // COLMAP would give photos a second camera if it was stopped between writing the first one and its photo.
            for suffix in ["", "-wal", "-shm"] {
                let _ = fs::remove_file(self.out.join(format!("database.db{suffix}")));
            }
            for (number, group) in groups.shared.iter().enumerate() {
                let first = self.extraction(&group[..1], group.len())?;
                if self.run(first, Step::Features, number, total)? == Outcome::Stopped {
                    return Ok(Outcome::Stopped);
                }
            }
            self.record.has_cameras = true;
            self.record.write(self.out)?;
        }
        let mut before = 0;
        for (number, group) in groups.shared.iter().enumerate() {
            let rest =
                self.extraction(group, group.len())?.option("ImageReader.existing_camera_id", number + 1);
            if self.run(rest, Step::Features, before, total)? == Outcome::Stopped {
                return Ok(Outcome::Stopped);
            }
            before += group.len();
        }
        if !groups.single.is_empty() {
            let singles =
                self.extraction(&groups.single, 1)?.option("ImageReader.single_camera_per_image", true);
            if self.run(singles, Step::Features, before, total)? == Outcome::Stopped {
                return Ok(Outcome::Stopped);
            }
        }
        self.record.has_features = true;
        self.record.write(self.out)?;
        Ok(Outcome::Finished)
    }

    /// Returns the command that extracts the features of `photos`, whose camera has `sharing` photos.
    fn extraction(&self, photos: &[Photo], sharing: usize) -> Result<Command> {
        let default = match sharing {
            _ if photos.iter().all(|photo| photo.is_equirectangular) => "EQUIRECTANGULAR",
            OPENCV_PHOTOS.. => "OPENCV",
            _ => "SIMPLE_RADIAL",
        };
        let model = self.record.camera_model.as_deref().unwrap_or(default);
        let side = photos.iter().map(|photo| photo.width.max(photo.height)).max().unwrap_or(0);
        let list = self.write_list("photos.txt", photos.iter().map(|photo| photo.name.clone()))?;
        let focal = photos[0].focal.map_or(FOCAL, |focal| focal / f64::from(side));
        let command = Command::new("feature_extractor");
        let command = match fisheye_parameters(model, &photos[0]) {
            Some(parameters) => command.option("ImageReader.camera_params", parameters),
            None => command.option("ImageReader.default_focal_length_factor", focal),
        };
        let masks = self.out.join(MASKS_FOLDER);
        let command = if masks.is_dir() { command.path("ImageReader.mask_path", &masks) } else { command };
        Ok(command
            .path("image_path", &self.images)
            .path("image_list_path", &list)
            .option("ImageReader.camera_model", model)
            .option("FeatureExtraction.use_gpu", false)
            .option("FeatureExtraction.max_image_size", MAX_SIDE)
            .option("SiftExtraction.max_num_features", FEATURES)
            .option("SiftExtraction.first_octave", if side < UPSAMPLED_SIDE { -1 } else { 0 }))
    }

    fn write_list(&self, name: &str, lines: impl Iterator<Item = String>) -> Result<PathBuf> {
        let path = self.out.join(name);
        write_atomically(&path, |writer| {
            lines.into_iter().try_for_each(|line| writeln!(writer, "{line}").map_err(Error::write(&path)))
        })?;
        Ok(path)
    }

    fn match_pairs(&mut self) -> Result<Outcome> {
        let count = self.photos().len();
        let is_exhaustive = match self.record.matching {
            Matching::Auto => count <= EXHAUSTIVE_PHOTOS,
            matching => matching == Matching::Exhaustive,
        };
        let pairs =
            if is_exhaustive { exhaustive_pairs(count) } else { sequential_pairs(count, OVERLAP, SPREAD) };
        while self.record.matched_pairs < pairs.len() {
            let done = self.record.matched_pairs;
            let next = &pairs[done..pairs.len().min(done + PAIRS_PER_CALL)];
            let names: Vec<&str> = self.photos().iter().map(|photo| photo.name.as_str()).collect();
            let lines = next.iter().map(|&(a, b)| format!("{} {}", names[a], names[b]));
            let list = self.write_list("pairs.txt", lines)?;
            let command = Command::new("matches_importer")
                .path("match_list_path", &list)
                .option("FeatureMatching.use_gpu", false);
            if self.run(command, Step::Pairs, done, pairs.len())? == Outcome::Stopped {
                return Ok(Outcome::Stopped);
            }
            if done + next.len() == pairs.len() && !is_exhaustive {
                // Does nothing if no photo has a position.
                let nearby = Command::new("spatial_matcher").option("FeatureMatching.use_gpu", false);
                if self.run(nearby, Step::Pairs, pairs.len(), pairs.len())? == Outcome::Stopped {
                    return Ok(Outcome::Stopped);
                }
            }
            self.record.matched_pairs += next.len();
            self.record.write(self.out)?;
        }
        Ok(Outcome::Finished)
    }

    fn run_mapper(&mut self) -> Result<Outcome> {
        if self.record.report.is_some() {
            return Ok(Outcome::Finished);
        }
        let [sparse, partial] = ["sparse", "sparse.partial"].map(|name| self.out.join(name));
        let remove = |folder: &Path| match folder.is_dir() {
            true => fs::remove_dir_all(folder).map_err(Error::write(folder)),
            false => Ok(()),
        };
        remove(&partial)?;
        fs::create_dir(&partial).map_err(Error::write(&partial))?;
        let side = self.photos().iter().map(|photo| photo.width.max(photo.height)).max().unwrap_or(0);
        let reduction = (f64::from(side) / f64::from(MAX_SIDE)).max(1.);
        let refines_centre =
            is_fisheye(self.record.camera_model.as_deref()) && self.photos().len() >= CENTRE_PHOTOS;
        let mapper = Command::new("mapper")
            .path("image_path", &self.images)
            .path("output_path", &partial)
            .option("Mapper.filter_max_reproj_error", MAX_REPROJECTION_ERROR * reduction)
            .option("Mapper.ba_refine_principal_point", refines_centre);
        let outcome = self.run(mapper, Step::Poses, 0, self.photos().len());
        // COLMAP's program fails with this message if it registers no photo, which is reported in other words.
        let is_without_model = |why: &Error| why.to_string().contains("sparse model");
        let is_empty = fs::read_dir(&partial).map_err(Error::read(&partial))?.next().is_none();
        match outcome {
            Ok(Outcome::Stopped) => return Ok(Outcome::Stopped),
            Ok(_) if is_empty => return Err(none_registered(self.photos().len(), self.out)),
            Err(why) if is_empty && is_without_model(&why) => {
                return Err(none_registered(self.photos().len(), self.out));
            }
            outcome => outcome?,
        };
        if self.adjust_robustly(&partial, refines_centre)? == Outcome::Stopped {
            return Ok(Outcome::Stopped);
        }
        remove(&sparse)?;
        fs::rename(&partial, &sparse).map_err(Error::write(&sparse))?;
        Ok(Outcome::Finished)
    }

    /// Adjusts the models in `sparse` with a loss that weighs wrong matches less than the squared errors by which COLMAP has registered the photos.
    /// Does nothing without pycolmap.
    fn adjust_robustly(&mut self, sparse: &Path, refines_centre: bool) -> Result<Outcome> {
        if !self.colmap.is_python {
            return Ok(Outcome::Finished);
        }
        let total = self.photos().len();
        let registered = read_models(sparse)?.first().map_or(0, |model| model.names.len());
        for folder in model_folders(sparse)? {
            let adjustment = Command::new("bundle_adjuster")
                .path("input_path", &folder)
                .path("output_path", &folder)
                .option("refine_principal_point", refines_centre);
            if self.run(adjustment, Step::Poses, registered, total)? == Outcome::Stopped {
                return Ok(Outcome::Stopped);
            }
        }
        Ok(Outcome::Finished)
    }

    fn report(&self) -> Result<PoseReport> {
        let mut models = read_models(&self.out.join("sparse"))?.into_iter();
        let Some(largest) = models.next().filter(|model| model.names.len() >= 2) else {
            return Err(none_registered(self.photos().len(), self.out));
        };
        let ModelSummary { names, points, error } = largest;
        let registered: BTreeSet<&str> = names.iter().map(String::as_str).collect();
        let unregistered = self.photos().iter().filter(|photo| !registered.contains(photo.name.as_str()));
        let unregistered: Vec<String> = unregistered.map(|photo| photo.name.clone()).collect();
        let models: Vec<usize> =
            [names.len()].into_iter().chain(models.map(|model| model.names.len())).collect();
        Ok(PoseReport {
            colmap: self.record.colmap.clone(),
            photos: self.record.found.len(),
            registered: names.len(),
            reprojection_error: error,
            points,
            other_files: None,
            skipped: self.record.skipped.clone(),
            advice: self.advice(&models),
            unregistered,
            models,
            seconds: self.record.seconds.clone(),
        })
    }

    /// Returns what to try if the largest of `models` has few of the photos.
    fn advice(&self, models: &[usize]) -> Vec<String> {
        let mut advice = vec![];
        if models[0] as f64 >= FEW_REGISTERED * self.photos().len() as f64 {
            return advice;
        }
        if models.len() > 1 {
            advice.push(
                "The models have no photo that connects them: take photos in between, unless they show different places."
                    .to_string(),
            );
        }
        advice.push(
            "Photos are registered if they overlap others by two thirds, are sharp, and show surfaces with texture.".into(),
        );
        if self.record.camera_model.is_none() {
            advice.push(
                "Photos of a fisheye or wide lens may need another camera model, such as OPENCV_FISHEYE."
                    .into(),
            );
        }
        if self.record.matching != Matching::Exhaustive && self.photos().len() > EXHAUSTIVE_PHOTOS {
            advice
                .push("Photos whose names aren't in the order of shooting need exhaustive matching.".into());
        }
        advice
    }
}

/// Photos by their cameras.
struct CameraGroups {
    /// Photos of one size, focal length and kind each: two or more, or one whose camera isn't left to COLMAP, because its metadata tell it or
    /// it is a fisheye.
    shared: Vec<Vec<Photo>>,
    /// The other photos.
    single: Vec<Photo>,
}

fn is_fisheye(model: Option<&str>) -> bool {
    FISHEYE_MODELS.iter().any(|(fisheye, ..)| model == Some(*fisheye))
}

fn group_by_camera(photos: &[Photo], model: Option<&str>) -> CameraGroups {
    let is_fisheye = is_fisheye(model);
    let mut groups = BTreeMap::<_, Vec<Photo>>::new();
    for photo in photos {
        let focal = photo.focal.map(|focal| focal.round() as u64);
        groups
            .entry((photo.width, photo.height, focal, photo.is_equirectangular))
            .or_default()
            .push(photo.clone());
    }
    let is_single = |group: &Vec<Photo>| {
        !is_fisheye && matches!(group.as_slice(), [Photo { focal: None, is_equirectangular: false, .. }])
    };
    let (single, shared): (Vec<_>, Vec<_>) = groups.into_values().partition(is_single);
    CameraGroups { shared, single: single.into_iter().flatten().collect() }
}

/// Returns the parameters at which the estimate of a fisheye lens starts, in COLMAP's notation: the focal length that EXIF tells or
/// [`FISHEYE_FOCAL`], the photo's centre, and no distortion. Returns `None` for other models.
///
/// COLMAP 4.2 matches no photos of a fisheye whose focal length isn't given.
fn fisheye_parameters(model: &str, photo: &Photo) -> Option<String> {
    let &(_, focals, coefficients) = FISHEYE_MODELS.iter().find(|(fisheye, ..)| *fisheye == model)?;
    let (width, height) = (f64::from(photo.width), f64::from(photo.height));
    let focal = photo.focal.unwrap_or(FISHEYE_FOCAL * width.max(height));
    let parameters = [vec![focal; focals], vec![width / 2., height / 2.], vec![0.; coefficients]].concat();
    Some(parameters.iter().map(f64::to_string).collect::<Vec<_>>().join(","))
}

/// Returns the error for a folder of `total` photos of which fewer than two aren't `skipped`.
fn too_few(folder: &Path, total: usize, skipped: &[SkippedPhoto]) -> Error {
    let reasons = skipped.iter().map(|photo| format!("{} is {}", photo.name, photo.reason));
    let found = format!("{total}, of which {} can't be used ({})", skipped.len(), format_first(reasons));
    Error::input(folder, "the number of photos", found, "2 or more different ones")
}

/// Returns the error if none of `count` photos was registered.
fn none_registered(count: usize, out: &Path) -> Error {
    Error::failed(format!(
        "COLMAP registered none of the {count} photos: they may overlap too little, be blurred, lack texture, show different places, or be \
         taken from a single point; see {}",
        out.join("colmap.log").display()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_capture::Lens;

    #[test]
    fn fisheyes_start_without_distortion() {
        let photo = |focal| {
            let name = "a.jpg".to_string();
            Photo { name, width: 400, height: 300, focal, is_equirectangular: false }
        };
        let mut count = 0;
        for model in CAMERA_MODELS {
            let Some(parameters) = fisheye_parameters(model, &photo(None)) else {
                assert!(!model.contains("FISHEYE"), "{model}");
                continue;
            };
            count += 1;
            let parameters: Vec<f64> = parameters.split(',').map(|number| number.parse().unwrap()).collect();
            let lens = Lens::from_colmap(model, &parameters, [300, 400].into()).expect(model);
            // A ray 0.5 radians to the right.
            let point = lens.project(glam::DVec3::new(0.5f64.sin(), 0., 0.5f64.cos())).unwrap();
            assert!(point.abs_diff_eq(glam::DVec2::new(200. + 0.5 * 160., 150.), 1e-9), "{model}: {point}");
        }
        assert_eq!(count, FISHEYE_MODELS.len());
        let by_exif = fisheye_parameters("FISHEYE", &photo(Some(150.5)));
        assert_eq!(by_exif.as_deref(), Some("150.5,150.5,200,150"));
    }
}
