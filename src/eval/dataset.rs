//! Evaluation of a method over a dataset, by an index: the paper's protocol (spec 9.1). The scores of every scene are stored as soon as
//! they are computed, so an interrupted evaluation resumes after the last finished scene.

use super::evaluation::{
    Efficiency, Evaluation, Failure, REPORT, SCORES, SceneScores, Summary, TABLE, comparison_path, machine,
    scene_file_name,
};
use super::method::Method;
use super::published::known_dataset;
use super::scene::{EvalScene, EvaluationIndex};
use crate::data::{Dataset, OpenGroup, SceneGroup};
use crate::distributed::ProcessGroup;
use crate::error::{Error, Result};
use crate::io::{WeightsFile, checksum, write_jpeg, write_json};
use crate::metrics::{Perceptual, comparison_image};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::cell::LazyCell;
use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;
use tch::{Device, Tensor};

/// Evaluation of a method over a dataset.
///
/// ```no_run
/// use globalsplat::data::{Dataset, Split};
/// use globalsplat::eval::{
///     DatasetEvaluation, EvaluationIndex, Method, weights_fingerprint, write_evaluation, write_report,
/// };
/// use globalsplat::distributed::ProcessGroup;
/// use globalsplat::reconstruct::load_model;
/// use std::path::{Path, PathBuf};
/// use tch::Device;
///
/// # fn main() -> globalsplat::Result<()> {
/// let (weights, root, out) = (Path::new("model.safetensors"), Path::new("re10k"), Path::new("results"));
/// let device = Device::Cpu;
/// let model = load_model(weights, device)?;
/// let dataset = Dataset::open(root, Split::Test)?;
/// let index = EvaluationIndex::read("re10k_24v.json".as_ref())?;
/// let evaluation = DatasetEvaluation {
///     method: Method::Model((&model).into()),
///     name: "GlobalSplat".into(),
///     fingerprint: weights_fingerprint(weights)?,
///     dataset: &dataset,
///     root,
///     dataset_name: DatasetEvaluation::dataset_name(None, root, &index),
///     index: &index,
///     target_size: model.config.data.image_size,
///     device,
///     out,
///     group: &ProcessGroup::single(),
/// }
/// .run(|done, total| {
///     println!("{done} of {total} scenes");
///     // `false` would stop; the next evaluation into the same folder resumes.
///     true
/// })?;
/// write_evaluation(out, &evaluation)?;
/// write_report(&out.join("report.html"), &[(out.to_owned(), evaluation)])?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct DatasetEvaluation<'a> {
    /// Method under evaluation. For splats and images, this is the folder that holds those of every scene.
    pub method: Method<'a>,
    /// Name of the method in the report.
    pub name: String,
    /// Identity of the method, so that an interrupted evaluation doesn't resume with the scores of another method.
    pub fingerprint: String,
    /// Dataset that holds the scenes.
    pub dataset: &'a Dataset,
    /// Folder of the dataset.
    pub root: &'a Path,
    /// Name of the dataset in the report, from [`DatasetEvaluation::dataset_name`].
    pub dataset_name: String,
    /// Index of the scenes' context and target frames.
    pub index: &'a EvaluationIndex,
    /// Size of the images, and of the target photos that they are compared with.
    pub target_size: ImageSize,
    /// Device that splats are rendered on.
    pub device: Device,
    /// Output folder, which holds `scenes/`.
    pub out: &'a Path,
    /// Process group whose ranks divide the scenes among themselves. All of them have access to `out`.
    pub group: &'a ProcessGroup,
}

/// Returns a string that identifies the model in the file `weights`, for [`DatasetEvaluation::fingerprint`]: the file's name and its
/// checksum.
///
/// # Errors
/// Fails if a file can't be read.
pub fn weights_fingerprint(weights: &Path) -> Result<String> {
    let weights = WeightsFile::open(weights)?;
    let name = weights.path().file_name().unwrap_or_default();
    Ok(format!("{} {:08x}", name.display(), checksum([weights.path()])?))
}

/// Results of a rank for its share of the scenes.
#[derive(Debug, Default, Serialize, Deserialize)]
struct RankResults {
    scenes: Vec<SceneScores>,
    failures: Vec<Failure>,
    /// `true` if the caller asked to stop.
    stopped: bool,
}

/// Number of loaded scenes that may wait while another one is evaluated.
const LOADED_AHEAD: usize = 1;

impl DatasetEvaluation<'_> {
    /// Returns the name of the dataset at `root` for the report: `said` if given; else the first known dataset that is a word of the folder's
    /// name, or of the index's; else the name of the folder.
    pub fn dataset_name(said: Option<&str>, root: &Path, index: &EvaluationIndex) -> String {
        if let Some(name) = said {
            return known_dataset(name).unwrap_or(name).to_string();
        }
        let folder = dataset_folder_name(root);
        let names = [folder.clone(), index.name()];
        let mut words = names.iter().flat_map(|name| name.split(|c: char| !c.is_alphanumeric()));
        words.find_map(known_dataset).map_or(folder, str::to_string)
    }

    /// Scores the scenes that the index and the dataset have in common. `on_progress` is called with the number of finished scenes and the
    /// total, and returns `false` to stop. With several ranks, each scores its share, and all of them return the whole.
    ///
    /// # Errors
    /// Fails if there is no scene in common, if `out` holds scores of another method, if every scene fails, if another rank is gone, or if
    /// `on_progress` asked to stop. A scene that fails is recorded in [`Evaluation::failures`].
    pub fn run(&self, mut on_progress: impl FnMut(usize, usize) -> bool) -> Result<Evaluation> {
        let machine = machine(self.device)?;
        let begun = self.group.is_main_process().then(|| self.begin()).transpose()?;
        let (mut scenes, missing) = self.group.broadcast_object(begun)?;
        let own = missing.iter().skip(self.group.rank()).step_by(self.group.world_size());
        let share = self.score_scenes(own.collect(), scenes.len(), &mut on_progress)?;
        let (mut failures, mut stopped) = (vec![], false);
        for share in self.group.all_gather_object(share)? {
            scenes.extend(share.scenes);
            failures.extend(share.failures);
            stopped |= share.stopped;
        }
        if stopped {
            let (done, total) = (scenes.len(), missing.len() + scenes.len());
            return Err(Error::failed(format!(
                "stopped after {done} of {total} scenes; {} holds their scores, and the same command resumes",
                self.out.display()
            )));
        }
        failures.sort_by_key(|failure| missing.iter().position(|key| *key == failure.scene));
        if let (Some(Failure { scene, error }), true) = (failures.first(), scenes.is_empty()) {
            let count = failures.len();
            return Err(Error::failed(format!("none of {count} scenes could be scored; {scene}: {error}")));
        }
        scenes.sort_by(|a, b| a.scores.scene.cmp(&b.scores.scene));
        Ok(Evaluation {
            method: self.name.clone(),
            dataset: self.dataset_name.clone(),
            index: self.index.name(),
            context_views: self.index.context_views(),
            image_size: self.target_size.into(),
            indexed_scenes: self.index.scenes.len(),
            summary: Summary::from_scenes(&scenes),
            efficiency: Efficiency::from_scenes(&scenes),
            machine,
            scenes,
            failures,
        })
    }

    /// Prepares the output folder. Returns the scores that it holds, and the keys of the scenes that it has no scores of, group after group.
    fn begin(&self) -> Result<(Vec<SceneScores>, Vec<String>)> {
        self.claim_folder()?;
        let (mut kept, mut missing) = (vec![], vec![]);
        for group in &self.dataset.groups {
            let open = LazyCell::new(|| group.open().ok());
            for key in group.keys.iter().filter(|key| self.index.scenes.contains_key(*key)) {
                match self.read_valid_scores(key, || open.as_ref()) {
                    Some(scores) => kept.push(scores),
                    None => missing.push(key.clone()),
                }
            }
        }
        if kept.is_empty() && missing.is_empty() {
            let found = format!("none of the {} in the dataset {}", self.dataset.scenes(), self.dataset.name);
            let example = self.index.scenes.keys().next().map_or("", String::as_str);
            let count = self.index.scenes.len();
            let expected = format!("scenes of the dataset; the index has {count} such as {example}");
            return Err(Error::input(&self.index.file, "what the index names", found, expected));
        }
        Ok((kept, missing))
    }

    /// Creates the output folder, or checks that its scores are of this evaluation.
    fn claim_folder(&self) -> Result<()> {
        let index = std::fs::read(&self.index.file).map_err(Error::read(&self.index.file))?;
        // The folder's name alone doesn't identify a dataset, since many folders are called `test`, so use its absolute path. Synthetic
        // videos have no folder, so the path stays as it is.
        let root = self.root.canonicalize().unwrap_or(self.root.to_owned());
        let generator =
            self.dataset.generator().map_or(String::new(), |generator| format!(" of {generator}"));
        let identity = Identity {
            method: self.fingerprint.clone(),
            dataset: root.display().to_string() + &generator,
            index: format!("{:08x} {}", crc32fast::hash(&index), self.index.name()),
            image_size: self.target_size.into(),
        };
        let (file, scenes) = (self.out.join(IDENTITY), self.out.join("scenes"));
        // An evaluation writes `file` first, so without it these files belong to something else.
        let mut others = [SCORES, TABLE, REPORT].into_iter();
        if let (false, Some(name)) = (file.exists(), others.find(|name| self.out.join(name).exists())) {
            let found = format!("a folder with a {name} that no evaluation wrote");
            let expected = "a folder of its own (choose another --out)";
            return Err(Error::input(self.out, "the output", found, expected));
        }
        std::fs::create_dir_all(&scenes).map_err(Error::write(&scenes))?;
        // If no scene has been scored yet, different settings do no harm.
        let mut entries = std::fs::read_dir(&scenes).map_err(Error::read(&scenes))?;
        if entries.next().is_some()
            && let Ok(text) = std::fs::read(&file)
        {
            let found: Identity = serde_json::from_slice(&text).map_err(|e| {
                Error::input(&file, "the file", format!("broken ({e})"), "what globalsplat eval wrote")
            })?;
            if found != identity {
                let expected = format!("{identity} (choose another --out)");
                return Err(Error::input(&file, "the evaluation", format!("of {found}"), expected));
            }
            return Ok(());
        }
        write_json(&file, &identity)
    }

    /// Returns the stored scores of scene `key`, which is in the group that `open` opens. Returns `None`, so that the scene is scored
    /// again, if there are none, if they are of other files, or if they lack a score that can be computed now.
    fn read_valid_scores<'a>(
        &self,
        key: &str,
        open: impl FnOnce() -> Option<&'a OpenGroup>,
    ) -> Option<SceneScores> {
        let text = std::fs::read(scores_path(self.out, key)).ok()?;
        let StoredScores { scores, files } = serde_json::from_slice(&text).ok()?;
        if scores.scores.scene != key || Perceptual::could_add_to(&scores.scores.mean, self.target_size) {
            return None;
        }
        let capture = open()?.capture(key).ok()?;
        let frames = self.index.frames(key, capture.len()).ok()?;
        let found = self.files_checksum(key, frames.checksum(&capture).ok()?).ok()?;
        (files == Some(found)).then_some(scores)
    }

    /// Returns a string that identifies the files from which scene `key` is scored: checksums of the splat or the images, if these are
    /// evaluated, and `photos`, the checksum of the photos and cameras.
    fn files_checksum(&self, key: &str, photos: u32) -> Result<String> {
        let names = self.index.scenes[key].render_names();
        let checksum = self.method.of_scene(key).checksum(&names)?.map(|checksum| format!("{checksum:08x} "));
        Ok(format!("{}{photos:08x}", checksum.unwrap_or_default()))
    }

    /// Scores the scenes `own` of this rank. `kept` is the number of scenes that have been scored before.
    fn score_scenes(
        &self,
        mut own: BTreeSet<&String>,
        kept: usize,
        on_progress: &mut impl FnMut(usize, usize) -> bool,
    ) -> Result<RankResults> {
        let total = kept + own.len();
        let groups = self.dataset.groups.iter().map(|group| {
            let keys: Vec<&String> = group.keys.iter().filter_map(|key| own.take(key)).collect();
            (group, keys)
        });
        let groups: Vec<(&SceneGroup, _)> = groups.filter(|(_, keys)| !keys.is_empty()).collect();
        let error = "the rank that it was assigned to doesn't have it";
        let failures = own.into_iter().map(|key| Failure { scene: key.clone(), error: error.into() });
        let mut results = RankResults { failures: failures.collect(), ..Default::default() };
        let perceptual = Perceptual::new(self.device);
        let (index, photo_size, target_size) = (self.index, self.method.photo_size(), self.target_size);
        let load = move |open: &OpenGroup, key: &str| {
            let capture = open.capture(key)?;
            let scene = EvalScene::indexed(key, &capture, index, photo_size, target_size)?;
            let checksum = scene.frames.checksum(&capture)?;
            Ok((scene, checksum))
        };
        std::thread::scope(|scope| {
            let (sender, receiver) = sync_channel(LOADED_AHEAD);
            scope.spawn(move || {
                for (group, keys) in groups {
                    // A chunk is read once for all of its scenes.
                    let open = group.open().map_err(|e| e.to_string());
                    for key in keys {
                        let loaded = open.as_ref().map_err(Error::failed).and_then(|open| load(open, key));
                        // There is no receiver any more if the evaluation has ended.
                        if sender.send((key, loaded)).is_err() {
                            return;
                        }
                    }
                }
            });
            loop {
                let done = kept + results.scenes.len() + results.failures.len();
                if !on_progress(done, total) {
                    results.stopped = true;
                    return Ok(results);
                }
                let Ok((key, loaded)) = receiver.recv() else { return Ok(results) };
                let is_first = results.scenes.is_empty();
                match loaded
                    .and_then(|(scene, photos)| self.score_scene(&scene, photos, &perceptual, is_first))
                {
                    Ok(scores) => results.scenes.push(scores),
                    // If this file can't be written, the next scene's can't either.
                    Err(e) if e.is_failed_write() => return Err(e),
                    Err(e) => {
                        // Broken weights of LPIPS aren't a problem of this scene.
                        if perceptual.peak_memory().is_some() {
                            perceptual.load()?;
                        }
                        results.failures.push(Failure { scene: key.clone(), error: e.to_string() });
                    }
                }
            }
        })
    }

    /// Scores the scene, whose photos have the checksum `photos`, and writes its scores and the comparison image of its worst view.
    /// `is_first` is `true` until a scene has been scored.
    fn score_scene(
        &self,
        scene: &EvalScene,
        photos: u32,
        perceptual: &Perceptual,
        is_first: bool,
    ) -> Result<SceneScores> {
        let method = self.method.of_scene(&scene.name);
        let files = Some(self.files_checksum(&scene.name, photos)?);
        let (is_warm_up, mut worst) = (perceptual.peak_memory().is_none(), None::<(f64, Tensor)>);
        let mut scores =
            method.score(scene, self.device, Some(perceptual), |view, rgb, rendered, score| {
                let psnr = score.scores.psnr;
                if worst.as_ref().is_none_or(|(lowest, _)| psnr.total_cmp(lowest).is_lt()) {
                    worst = Some((psnr, comparison_image(&view.image.to_float(), rgb, rendered)));
                }
                Ok(())
            })?;
        if let (Method::Model(_), Some(peak)) = (&method, perceptual.peak_memory()) {
            scores.warm_up = is_warm_up;
            // Later peaks include the networks of LPIPS.
            scores.peak_memory_bytes = is_first.then_some(peak.host);
            scores.peak_device_memory_bytes = peak.device.filter(|_| is_first);
        }
        let (_, image) = worst.expect("a target view");
        write_jpeg(&comparison_path(self.out, &scene.name), &image)?;
        let stored = StoredScores { scores, files };
        write_json(&scores_path(self.out, &scene.name), &stored)?;
        Ok(stored.scores)
    }
}

/// Returns the name of the folder of the dataset at `root`. If that is a split (`test` or `train`), returns the name of the folder above
/// it.
fn dataset_folder_name(root: &Path) -> String {
    let root = root.canonicalize().unwrap_or(root.to_owned());
    let folders = root.ancestors().take(3).filter_map(|folder| folder.file_name());
    let names: Vec<_> = folders.map(|name| name.to_string_lossy().into_owned()).collect();
    let own = names.iter().find(|name| !["train", "test"].contains(&name.as_str()));
    own.or(names.first()).cloned().unwrap_or_default()
}

/// Name of the file that an evaluation writes first.
const IDENTITY: &str = "evaluation.json";

/// Settings that must be equal for an evaluation to resume.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Identity {
    #[serde(rename = "subject")]
    method: String,
    dataset: String,
    index: String,
    image_size: [u32; 2],
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Identity { method, dataset, index, image_size: [height, width] } = self;
        write!(f, "{method} on {dataset} by {index}, {width}×{height} pixels")
    }
}

/// Scores of a scene as they are stored on disk.
#[derive(Serialize, Deserialize)]
struct StoredScores {
    #[serde(flatten)]
    scores: SceneScores,
    /// Checksums of the files that were scored, by which replaced files are detected.
    files: Option<String>,
}

/// Returns the path of a scene's scores in the folder `out` of an evaluation.
fn scores_path(out: &Path, key: &str) -> PathBuf {
    out.join("scenes").join(format!("{}.json", scene_file_name(key)))
}

/// Returns the paths of the files that an evaluation of the scenes `keys` writes into the folder `out`.
pub fn evaluation_files<'a>(out: &Path, keys: impl IntoIterator<Item = &'a String>) -> Vec<PathBuf> {
    let of_scene = |key: &'a String| [scores_path(out, key), comparison_path(out, key)];
    let of_all = [IDENTITY, SCORES, TABLE].map(|name| out.join(name));
    keys.into_iter().flat_map(of_scene).chain(of_all).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn dataset_name_matches_whole_words() {
        for (root, index, expected) in [
            ("data/re10k", "evaluation_index.json", "re10k"),
            ("data/RealEstate10K-small", "index.json", "re10k"),
            ("data/re10k/test/train", "index.json", "re10k"),
            ("data/DL3DV.960P", "dl3dv_12v.json", "dl3dv"),
            ("data/chunks", "RE10K.acidic.json", "re10k"),
            ("data/acid", "re10k_3v.json", "acid"),
            ("data/placid", "myre10k_3v.json", "placid"),
            // The folders above the dataset's own don't count.
            ("re10k/mine", "index.json", "mine"),
            ("test/test/test", "index.json", "test"),
        ] {
            let index = EvaluationIndex { file: index.into(), scenes: BTreeMap::new() };
            let name = DatasetEvaluation::dataset_name(None, Path::new(root), &index);
            assert_eq!(name, expected, "{root} {}", index.name());
        }
    }
}
