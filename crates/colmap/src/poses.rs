//! Estimates the poses of the photos of a capture, step by step.

use crate::colmap::Colmap;
use crate::photos::{Photo, SkippedPhoto, import_photos};
use crate::progress::{Progress, Reporter, Step};
use crate::record::{CaptureReport, Matching, Record, SHOWN_NAMES};
use glam::DVec3;
use globalsplat_capture::{
    COLMAP_MODELS, GeoPosition, MASKS_FOLDER, Upright, estimate_upright, format_names, read_colmap_models,
    to_east_north_up,
};
use globalsplat_files::{Error, Result, parent_of, write_file};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
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
/// Minimum number of photos of a fisheye for which the lens's center is estimated. Few photos can't tell it from a rotation of the camera.
const CENTER_PHOTOS: usize = 10;
/// Focal length of photos without EXIF, relative to their longer side: that of a phone's or a camera's wide lens. The estimate may fail if
/// it is far off.
const FOCAL: f64 = 0.85;
/// [`FOCAL`] of a fisheye lens. For one of 0.38, the estimate succeeds from 0.25 to 0.6.
const FISHEYE_FOCAL: f64 = 0.4;
/// Share of the photos below which a report says what to try.
const FEW_REGISTERED: f64 = 0.8;
/// What to try if few photos are registered.
const ADVICE: &str = "Photos are registered if they overlap others by two thirds, are sharp, and show surfaces with texture. Separate models need \
                      photos in between; a fisheye needs a camera model such as OPENCV_FISHEYE; photos in random order need exhaustive matching.";

/// Side of the blocks in which pairs are listed: COLMAP keeps the features of few photos in memory.
const BLOCK: usize = 16;

/// A capture in the making.
pub(crate) struct Estimate<'a, 'b> {
    /// Folder of the user's photos, or of the frames of a video.
    pub photos: &'a Path,
    pub out: &'a Path,
    /// Folder of the photos that COLMAP reads.
    pub images: &'a Path,
    pub colmap: &'a Colmap,
    pub record: Record,
    pub reporter: &'a mut Reporter<'b>,
}

impl Estimate<'_, '_> {
    /// Runs the steps that aren't finished. Returns the result, which is recorded.
    pub fn run_steps(&mut self) -> Result<CaptureReport> {
        self.run_step(Step::Photos, Self::import)?;
        self.run_step(Step::Features, Self::extract_features)?;
        self.run_step(Step::Pairs, Self::match_pairs)?;
        self.run_step(Step::Poses, Self::run_mapper)?;
        let report = self.report()?;
        self.record.report = Some(report.clone());
        self.record.write(self.out)?;
        Ok(report)
    }

    /// Runs a step, and records how far it came in which time, even if it was stopped.
    fn run_step(&mut self, step: Step, run: impl FnOnce(&mut Self) -> Result<()>) -> Result<()> {
        let start = Instant::now();
        let outcome = run(self);
        *self.record.seconds.entry(step).or_default() += start.elapsed().as_secs_f64();
        self.record.write(self.out)?;
        outcome
    }

    /// Brings the photos into the folder of images.
    fn import(&mut self) -> Result<()> {
        if self.record.photos.is_some() {
            return Ok(());
        }
        let (photos, skipped) =
            import_photos(self.photos, self.out, self.images, &mut self.record, self.reporter)?;
        if photos.len() < 2 {
            let explain = |photo: &SkippedPhoto| format!("{} is {}", photo.name, photo.reason);
            let reasons: Vec<String> = skipped.iter().map(explain).collect();
            let reasons = format_names(&reasons, SHOWN_NAMES);
            let (found, unused) = (self.record.found.len(), skipped.len());
            let unusable = format!("{found}, of which {unused} can't be used ({reasons})");
            let expected = "2 or more different ones";
            return Err(Error::input(self.photos, "the number of photos", unusable, expected));
        }
        (self.record.photos, self.record.skipped) = (Some(photos), skipped);
        Ok(())
    }

    fn photos(&self) -> &[Photo] {
        self.record.photos.as_deref().unwrap_or_default()
    }

    /// Returns the photos, each with the name under which it was found.
    fn named_photos(&self) -> Vec<(&String, &Photo)> {
        let Record { found, skipped, .. } = &self.record;
        let mut names: Vec<&String> = found.iter().map(|photo| &photo.name).collect();
        names.retain(|name| skipped.iter().all(|photo| photo.name != **name));
        names.into_iter().zip(self.photos()).collect()
    }

    /// Runs a command of COLMAP on the database, from the progress `start`.
    fn run(&mut self, command: &str, mut options: Value, start: Progress) -> Result<()> {
        options["database_path"] = text(&self.out.join("database.db"));
        self.run_on_files(command, options, start)
    }

    fn run_on_files(&mut self, command: &str, options: Value, start: Progress) -> Result<()> {
        self.colmap.run(command, &options, &self.out.join("colmap.log"), start, self.reporter)
    }

    /// Detects features. Photos of one size and focal length share a camera, whose number is that of their group.
    fn extract_features(&mut self) -> Result<()> {
        if self.record.has_features {
            return Ok(());
        }
        let (shared, single) = group_by_camera(self.photos(), self.record.camera_model.as_deref());
        let mut progress = Progress { step: Step::Features, done: 0, total: self.photos().len() };
        if !self.record.has_cameras {
            // COLMAP would give photos a second camera if it was stopped between writing the first one and its photo.
            for suffix in ["", "-wal", "-shm"] {
                let _ = fs::remove_file(self.out.join(format!("database.db{suffix}")));
            }
            for (number, group) in shared.iter().enumerate() {
                let options = self.extraction(&group[..1], group.len())?;
                self.run("feature_extractor", options, Progress { done: number, ..progress })?;
            }
            self.record.has_cameras = true;
            self.record.write(self.out)?;
        }
        for (number, group) in shared.iter().enumerate() {
            let mut options = self.extraction(group, group.len())?;
            options["ImageReader.existing_camera_id"] = (number + 1).into();
            self.run("feature_extractor", options, progress)?;
            progress.done += group.len();
        }
        if !single.is_empty() {
            let mut options = self.extraction(&single, 1)?;
            options["ImageReader.single_camera_per_image"] = true.into();
            self.run("feature_extractor", options, progress)?;
        }
        self.record.has_features = true;
        Ok(())
    }

    /// Returns the options by which the features of `photos` are extracted, whose camera has `sharing` photos.
    fn extraction(&self, photos: &[Photo], sharing: usize) -> Result<Value> {
        let default = match sharing {
            _ if photos.iter().all(|photo| photo.is_equirectangular) => "EQUIRECTANGULAR",
            OPENCV_PHOTOS.. => "OPENCV",
            _ => "SIMPLE_RADIAL",
        };
        let model = self.record.camera_model.as_deref().unwrap_or(default);
        let side = longest_side(photos);
        let mut options = json!({
            "image_path": text(self.images),
            "image_list_path": self.write_list("photos.txt", photos.iter().map(|photo| photo.name.clone()))?,
            "ImageReader.camera_model": model,
            "FeatureExtraction.use_gpu": false,
            "FeatureExtraction.max_image_size": MAX_SIDE,
            "SiftExtraction.max_num_features": FEATURES,
            "SiftExtraction.first_octave": if side < UPSAMPLED_SIDE { -1 } else { 0 },
        });
        match fisheye_parameters(model, &photos[0]) {
            Some(parameters) => options["ImageReader.camera_params"] = parameters.into(),
            None => {
                let focal = photos[0].focal.map_or(FOCAL, |focal| focal / f64::from(side));
                options["ImageReader.default_focal_length_factor"] = focal.into();
            }
        }
        let masks = self.out.join(MASKS_FOLDER);
        if masks.is_dir() {
            options["ImageReader.mask_path"] = text(&masks);
        }
        Ok(options)
    }

    /// Writes a list for COLMAP, and returns its path.
    fn write_list(&self, name: &str, lines: impl Iterator<Item = String>) -> Result<Value> {
        let (path, lines) = (self.out.join(name), lines.collect::<Vec<_>>().join("\n") + "\n");
        write_file(&path, lines)?;
        Ok(text(&path))
    }

    /// Matches features, some pairs of photos at a time.
    fn match_pairs(&mut self) -> Result<()> {
        let count = self.photos().len();
        let is_exhaustive = match self.record.matching {
            Matching::Auto => count <= EXHAUSTIVE_PHOTOS,
            matching => matching == Matching::Exhaustive,
        };
        let pairs =
            if is_exhaustive { exhaustive_pairs(count) } else { sequential_pairs(count, OVERLAP, SPREAD) };
        while self.record.matched_pairs < pairs.len() {
            let progress =
                Progress { step: Step::Pairs, done: self.record.matched_pairs, total: pairs.len() };
            let next = &pairs[progress.done..pairs.len().min(progress.done + PAIRS_PER_CALL)];
            let name = |photo: usize| &self.photos()[photo].name;
            let lines = next.iter().map(|&(first, second)| format!("{} {}", name(first), name(second)));
            let list = self.write_list("pairs.txt", lines)?;
            let options = json!({ "match_list_path": list, "FeatureMatching.use_gpu": false });
            self.run("matches_importer", options, progress)?;
            let matched = progress.done + next.len();
            if matched == pairs.len() && !is_exhaustive {
                // Does nothing if no photo has a position.
                let options = json!({ "FeatureMatching.use_gpu": false });
                self.run("spatial_matcher", options, Progress { done: matched, ..progress })?;
            }
            self.record.matched_pairs = matched;
            self.record.write(self.out)?;
        }
        Ok(())
    }

    /// Registers the photos.
    fn run_mapper(&mut self) -> Result<()> {
        let [sparse, partial] = ["sparse", "sparse.partial"].map(|name| self.out.join(name));
        let remove = |folder: &Path| match folder.is_dir() {
            true => fs::remove_dir_all(folder).map_err(Error::write(folder)),
            false => Ok(()),
        };
        remove(&partial)?;
        fs::create_dir(&partial).map_err(Error::write(&partial))?;
        let total = self.photos().len();
        let progress = Progress { step: Step::Poses, done: 0, total };
        let reduction = (f64::from(longest_side(self.photos())) / f64::from(MAX_SIDE)).max(1.);
        let refines_center = is_fisheye(self.record.camera_model.as_deref()) && total >= CENTER_PHOTOS;
        let options = json!({
            "image_path": text(self.images),
            "output_path": text(&partial),
            "Mapper.filter_max_reproj_error": MAX_REPROJECTION_ERROR * reduction,
            "Mapper.ba_refine_principal_point": refines_center,
        });
        match self.run("mapper", options, progress) {
            // COLMAP's program fails with this message if it registers no photo, which is reported in other words.
            Err(why) if why.to_string().contains("mapper failed: failed to create sparse model") => {}
            outcome => outcome?,
        }
        let models = read_colmap_models(&partial)?;
        if models.first().is_none_or(|largest| largest.photos.len() < 2) {
            return Err(Error::failed(format!(
                "COLMAP registered none of the {total} photos: they may overlap too little, be blurred, lack texture, show different places, \
                 or be taken from a single point; see {}",
                self.out.join("colmap.log").display()
            )));
        }
        // The robust loss weighs wrong matches less than the squared errors by which COLMAP has registered the photos. COLMAP's program has
        // no option for it.
        for model in models.iter().filter(|_| self.colmap.is_python) {
            let options = json!({
                "input_path": text(&model.folder),
                "output_path": text(&model.folder),
                "refine_principal_point": refines_center,
            });
            self.run("bundle_adjuster", options, Progress { done: models[0].photos.len(), ..progress })?;
        }
        self.record.transform =
            self.record.is_upright.then(|| self.turn_upright(&models[0].folder, progress)).transpose()?;
        remove(&sparse)?;
        fs::rename(&partial, &sparse).map_err(Error::write(&sparse))?;
        Ok(())
    }

    /// Turns the largest model, in `folder`, upright, and scales it to metres if the photos have positions that agree with it. Other models, which
    /// nothing connects to it, stay as they are.
    fn turn_upright(&mut self, folder: &Path, progress: Progress) -> Result<Upright> {
        // The model of the mapper may have been adjusted since it was read.
        let model = read_colmap_models(parent_of(folder))?.swap_remove(0);
        let upright = estimate_upright(&model.c2w, &model.points, &self.positions(&model.photos))?;
        let (scale, rotation, translation) = upright.matrix.to_scale_rotation_translation();
        let numbers =
            [&[scale.x, rotation.w, rotation.x, rotation.y, rotation.z][..], &translation.to_array()];
        let numbers: Vec<String> = numbers.concat().iter().map(f64::to_string).collect();
        let options = json!({
            "input_path": text(folder),
            "output_path": text(folder),
            "transform_path": self.write_list("transform.txt", [numbers.join(" ")].into_iter())?,
        });
        self.run_on_files("model_transformer", options, Progress { done: model.photos.len(), ..progress })?;
        Ok(upright)
    }

    /// Returns the positions of photos in metres, east, north and up, of those that have one.
    fn positions(&self, names: &[String]) -> Vec<Option<DVec3>> {
        let by_file = &self.record.positions;
        let located = self
            .named_photos()
            .into_iter()
            .filter_map(|(name, photo)| Some((&photo.name, by_file.get(name).copied().or(photo.position)?)));
        let geographic: BTreeMap<&String, GeoPosition> = located.collect();
        to_east_north_up(&names.iter().map(|name| geographic.get(name).copied()).collect::<Vec<_>>())
    }

    /// Returns the result.
    fn report(&self) -> Result<CaptureReport> {
        let models = read_colmap_models(&self.out.join("sparse"))?;
        let largest = &models[0];
        let registered: BTreeSet<&String> = largest.photos.iter().collect();
        let unregistered = self.photos().iter().filter(|photo| !registered.contains(&photo.name));
        let name = |photo: &Photo| photo.name.clone();
        let Record { masks, .. } = &self.record;
        let is_unmasked = |(name, photo): &&(&String, &Photo)| {
            !masks.is_empty() && !masks.contains_key(*name) && !photo.has_alpha
        };
        let unmasked = self.named_photos();
        let unmasked = unmasked.iter().filter(is_unmasked);
        let is_few = (largest.photos.len() as f64) < FEW_REGISTERED * self.photos().len() as f64;
        Ok(CaptureReport {
            video: None,
            colmap: self.record.colmap.clone(),
            photos: self.record.found.len(),
            registered: largest.photos.len(),
            reprojection_error: largest.reprojection_error,
            points: largest.points.len(),
            transform: self.record.transform,
            other_files: None,
            skipped: self.record.skipped.clone(),
            reduced: self.photos().iter().filter(|photo| photo.is_reduced).map(name).collect(),
            unmasked: unmasked.map(|(name, _)| (*name).clone()).collect(),
            unregistered: unregistered.map(name).collect(),
            advice: if is_few { vec![ADVICE.to_string()] } else { vec![] },
            models: models.iter().map(|model| model.photos.len()).collect(),
            seconds: self.record.seconds.clone(),
        })
    }
}

/// Returns a path as an option of COLMAP.
fn text(path: &Path) -> Value {
    path.to_string_lossy().into()
}

fn longest_side(photos: &[Photo]) -> u32 {
    photos.iter().map(|photo| photo.width.max(photo.height)).max().unwrap_or(0)
}

fn is_fisheye(model: Option<&str>) -> bool {
    model.is_some_and(|model| model.ends_with("FISHEYE"))
}

/// Returns the photos of each camera: those of one size, focal length and kind, if they are two or more, or if their camera isn't left to
/// COLMAP because its metadata tell it or it is a fisheye. Then returns the other photos.
fn group_by_camera(photos: &[Photo], model: Option<&str>) -> (Vec<Vec<Photo>>, Vec<Photo>) {
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
    (shared, single.into_iter().flatten().collect())
}

/// Returns the parameters at which the estimate of a fisheye lens starts, in COLMAP's notation: the focal length that EXIF tells or
/// [`FISHEYE_FOCAL`], the photo's center, and no distortion. Returns `None` for other models.
///
/// COLMAP 4.2 matches no photos of a fisheye whose focal length isn't given.
fn fisheye_parameters(model: &str, photo: &Photo) -> Option<String> {
    let (_, count) = COLMAP_MODELS.iter().find(|(known, _)| *known == model && is_fisheye(Some(known)))?;
    let focals = if model.starts_with("SIMPLE_") || model.starts_with("RADIAL") { 1 } else { 2 };
    let (width, height) = (f64::from(photo.width), f64::from(photo.height));
    let focal = photo.focal.unwrap_or(FISHEYE_FOCAL * width.max(height));
    let parameters =
        [vec![focal; focals], vec![width / 2., height / 2.], vec![0.; count - focals - 2]].concat();
    Some(parameters.iter().map(f64::to_string).collect::<Vec<_>>().join(","))
}

/// Returns all pairs of `count` photos, block by block.
fn exhaustive_pairs(count: usize) -> Vec<(usize, usize)> {
    let mut pairs: Vec<_> =
        (0..count).flat_map(|first| (first + 1..count).map(move |second| (first, second))).collect();
    pairs.sort_by_key(|(first, second)| (first / BLOCK, second / BLOCK));
    pairs
}

/// Returns the pairs of photos in shooting order that are at most `overlap` apart, and every pair among `spread` photos that are spread
/// evenly. The latter connect a path to where it was before; without them COLMAP may place its parts wrongly to each other.
fn sequential_pairs(count: usize, overlap: usize, spread: usize) -> Vec<(usize, usize)> {
    let near = |first: usize| (first + 1..count.min(first + overlap + 1)).map(move |second| (first, second));
    let step = count.div_ceil(spread).max(1);
    let far = exhaustive_pairs(count.div_ceil(step))
        .into_iter()
        .map(|(first, second)| (first * step, second * step));
    (0..count).flat_map(near).chain(far.filter(|(first, second)| second - first > overlap)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_capture::Lens;

    #[test]
    fn fisheyes_start_without_distortion() {
        let photo = |focal| {
            let name = "a.jpg".to_string();
            Photo {
                name,
                width: 400,
                height: 300,
                focal,
                is_equirectangular: false,
                is_reduced: false,
                has_alpha: false,
                position: None,
            }
        };
        for (model, _) in COLMAP_MODELS {
            let parameters = fisheye_parameters(model, &photo(None));
            assert_eq!(parameters.is_some(), model.contains("FISHEYE"), "{model}");
            let Some(parameters) = parameters else { continue };
            let parameters: Vec<f64> = parameters.split(',').map(|number| number.parse().unwrap()).collect();
            let lens = Lens::from_colmap(model, &parameters, [300, 400].into()).expect(model);
            // A ray 0.5 radians to the right.
            let point = lens.project(glam::DVec3::new(0.5f64.sin(), 0., 0.5f64.cos())).unwrap();
            assert!(point.abs_diff_eq(glam::DVec2::new(200. + 0.5 * 160., 150.), 1e-9), "{model}: {point}");
        }
        let by_exif = fisheye_parameters("FISHEYE", &photo(Some(150.5)));
        assert_eq!(by_exif.as_deref(), Some("150.5,150.5,200,150"));
    }

    #[test]
    fn every_pair_occurs_once_and_sequences_pair_neighbours_and_photos_spread_evenly() {
        let (all, sequential) = (exhaustive_pairs(40), sequential_pairs(40, 3, 5));
        // The first block holds the pairs of the first photos.
        assert!(all[..120].iter().all(|(_, second)| *second < BLOCK));
        let of_first = sequential.iter().filter(|(first, _)| *first == 0).map(|(_, second)| *second);
        assert_eq!(of_first.collect::<Vec<_>>(), [1, 2, 3, 8, 16, 24, 32]);
        // 3 neighbours of each photo but the last three, which have 2, 1 and 0; and the pairs of 5.
        for (pairs, count) in [(all, 780), (sequential, 37 * 3 + 2 + 1 + 10)] {
            assert_eq!((pairs.len(), pairs.iter().collect::<BTreeSet<_>>().len()), (count, count));
            assert!(pairs.iter().all(|(first, second)| first < second && *second < 40));
        }
        assert_eq!(sequential_pairs(3, 10, 64), [(0, 1), (0, 2), (1, 2)]);
    }
}
