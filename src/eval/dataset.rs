//! Evaluation of a method over a dataset, by an index: the paper's protocol (spec 9.1). The scores of every scene are stored as soon as
//! they are computed, so an interrupted evaluation resumes after the last finished scene.

use super::evaluation::{
    Efficiency, Evaluation, Failure, REPORT, SCORES, SceneScores, Summary, TABLE, comparison_path, machine,
    scene_file_name,
};
use super::method::Method;
use super::published::known_dataset;
use super::scene::{EvalScene, EvaluationIndex};
use crate::data::Dataset;
use crate::distributed::ProcessGroup;
use crate::error::{Error, Result};
use crate::io::{WeightsFile, checksum, write_jpeg, write_json};
use crate::metrics::{Perceptual, comparison_image};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

/// Evaluation of a method over a dataset.
///
/// ```no_run
/// use globalsplat::data::{Dataset, Split};
/// use globalsplat::distributed::ProcessGroup;
/// use globalsplat::eval::{
///     DatasetEvaluation, EvaluationIndex, Method, dataset_name, weights_fingerprint, write_evaluation, write_report,
/// };
/// use globalsplat::reconstruct::load_model;
/// use std::path::Path;
/// use tch::Device;
///
/// # fn main() -> globalsplat::Result<()> {
/// let (weights, root, out) = (Path::new("model.safetensors"), Path::new("re10k"), Path::new("results"));
/// let model = load_model(weights, Device::Cpu)?;
/// let index = EvaluationIndex::read("re10k_24v.json".as_ref())?;
/// let evaluation = DatasetEvaluation {
///     method: Method::Model((&model).into()),
///     name: "GlobalSplat".into(),
///     fingerprint: weights_fingerprint(weights)?,
///     dataset: &Dataset::open(root, Split::Test)?,
///     root,
///     dataset_name: dataset_name(root, &index),
///     index: &index,
///     target_size: model.config.data.image_size,
///     device: Device::Cpu,
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
    /// Name of the dataset in the report, such as [`dataset_name`] returns.
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

/// Returns the name of the dataset at `root` for the report: the first known dataset that is a word of the folder's name, or else of the
/// index's name, or else the name of the folder. A folder `test` or `train` goes by the name of the one above it.
pub fn dataset_name(root: &Path, index: &EvaluationIndex) -> String {
    let root = root.canonicalize().unwrap_or(root.to_owned());
    let folders = root.ancestors().take(3).filter_map(|folder| folder.file_name());
    let names: Vec<_> = folders.map(|name| name.to_string_lossy().into_owned()).collect();
    let own = names.iter().find(|name| !["train", "test"].contains(&name.as_str()));
    let folder = own.or(names.first()).cloned().unwrap_or_default();
    let known = |name: &str| name.split(|c: char| !c.is_alphanumeric()).find_map(known_dataset);
    known(&folder).or_else(|| known(&index.name())).map_or(folder, String::from)
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

impl std::fmt::Display for Identity {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Identity { method, dataset, index, image_size: [height, width] } = self;
        write!(f, "{method} on {dataset} by {index}, {width}×{height} pixels")
    }
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

/// Results of a rank for its share of the scenes.
#[derive(Debug, Default, Serialize, Deserialize)]
struct RankResults {
    scenes: Vec<SceneScores>,
    failures: Vec<Failure>,
    /// `true` if the caller asked to stop.
    stopped: bool,
}

impl DatasetEvaluation<'_> {
    /// Scores the scenes that the index and the dataset have in common. `on_progress` is called with the number of finished scenes and the
    /// total, and returns `false` to stop. With several ranks, each scores its share, and all of them return the whole.
    ///
    /// # Errors
    /// Fails if there is no scene in common, if `out` holds scores of another method, if every scene fails, if another rank is gone, or if
    /// `on_progress` asked to stop. A scene that fails is recorded in [`Evaluation::failures`].
    pub fn run(&self, mut on_progress: impl FnMut(usize, usize) -> bool) -> Result<Evaluation> {
        let begun = self.group.is_main_process().then(|| self.begin()).transpose()?;
        let (mut scenes, missing) = self.group.broadcast_object(begun)?;
        let own = missing.iter().skip(self.group.rank()).step_by(self.group.world_size()).cloned().collect();
        let results = self.score_scenes(own, scenes.len(), &mut on_progress)?;
        let (mut failures, mut stopped) = (vec![], false);
        for results in self.group.all_gather_object(results)? {
            scenes.extend(results.scenes);
            failures.extend(results.failures);
            stopped |= results.stopped;
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
            machine: machine(self.device)?,
            scenes,
            failures,
        })
    }

    /// Prepares the output folder. Returns the scores that it holds, and the keys of the other scenes.
    fn begin(&self) -> Result<(Vec<SceneScores>, Vec<String>)> {
        self.claim_folder()?;
        let (mut scored, mut missing) = (vec![], vec![]);
        let keys = self.dataset.groups().iter().flat_map(|group| &group.keys);
        for key in keys.filter(|key| self.index.scenes.contains_key(*key)) {
            match self.read_scores(key) {
                Some(scores) => scored.push(scores),
                None => missing.push(key.clone()),
            }
        }
        if scored.is_empty() && missing.is_empty() {
            let found = format!("none of the {} in the dataset {}", self.dataset.scenes(), self.dataset.name);
            let example = self.index.scenes.keys().next().map_or("", String::as_str);
            let count = self.index.scenes.len();
            let expected = format!("scenes of the dataset; the index has {count} such as {example}");
            return Err(Error::input(&self.index.file, "what the index names", found, expected));
        }
        Ok((scored, missing))
    }

    /// Creates the output folder, or checks that its scores are of this evaluation.
    fn claim_folder(&self) -> Result<()> {
        let index = std::fs::read(&self.index.file).map_err(Error::read(&self.index.file))?;
        // The folder's name alone doesn't identify a dataset, since many folders are called `test`, so use its absolute path. Synthetic
        // videos have no folder, so the path stays as it is.
        let root = self.root.canonicalize().unwrap_or(self.root.to_owned());
        let generator = self.dataset.generator().map_or(String::new(), |of| format!(" of {of}"));
        let identity = Identity {
            method: self.fingerprint.clone(),
            dataset: root.display().to_string() + &generator,
            index: format!("{:08x} {}", crc32fast::hash(&index), self.index.name()),
            image_size: self.target_size.into(),
        };
        let (file, scenes) = (self.out.join(IDENTITY), self.out.join("scenes"));
        // An evaluation writes `file` first, so without it these files belong to something else.
        let others = ["scenes", SCORES, TABLE, REPORT];
        if let (false, Some(name)) =
            (file.exists(), others.into_iter().find(|name| self.out.join(name).exists()))
        {
            let found = format!("a folder with a {name} that no evaluation wrote");
            return Err(Error::input(
                self.out,
                "the output",
                found,
                "a folder of its own (choose another --out)",
            ));
        }
        if let Ok(text) = std::fs::read(&file) {
            let found: Identity = serde_json::from_slice(&text).map_err(|e| {
                Error::input(&file, "the file", format!("broken ({e})"), "what globalsplat eval wrote")
            })?;
            // If no scene has been scored yet, different settings do no harm.
            let has_scores = std::fs::read_dir(&scenes).is_ok_and(|mut entries| entries.next().is_some());
            if found != identity && has_scores {
                let expected = format!("{identity} (choose another --out)");
                return Err(Error::input(&file, "the evaluation", format!("of {found}"), expected));
            }
        }
        std::fs::create_dir_all(self.out).map_err(Error::write(self.out))?;
        write_json(&file, &identity)?;
        std::fs::create_dir_all(&scenes).map_err(Error::write(&scenes))
    }

    /// Returns the stored scores of scene `key`. Returns `None`, so that the scene is scored again, if there are none, if its splat or its
    /// images have changed since, or if they lack an LPIPS whose network is now installed.
    fn read_scores(&self, key: &str) -> Option<SceneScores> {
        let file = scores_path(self.out, key);
        let scores: SceneScores = serde_json::from_slice(&std::fs::read(&file).ok()?).ok()?;
        let time = file.metadata().and_then(|metadata| metadata.modified()).ok()?;
        let is_valid = scores.scores.scene == key
            && !self.method.of_scene(key).has_changed_since(time)
            && !Perceptual::could_add_to(&scores.scores.mean);
        is_valid.then_some(scores)
    }

    /// Scores the scenes `keys`. `done` is the number of scenes that have been scored before.
    fn score_scenes(
        &self,
        mut keys: BTreeSet<String>,
        mut done: usize,
        on_progress: &mut impl FnMut(usize, usize) -> bool,
    ) -> Result<RankResults> {
        let (total, perceptual) = (done + keys.len(), Perceptual::new(self.device));
        let mut results = RankResults::default();
        for group in self.dataset.groups() {
            let own: Vec<_> = group.keys.iter().filter(|key| keys.remove(*key)).collect();
            // A chunk is read once for all of its scenes.
            let Some(open) = (!own.is_empty()).then(|| group.open().map_err(|e| e.to_string())) else {
                continue;
            };
            for key in own {
                if !on_progress(done, total) {
                    return Ok(RankResults { stopped: true, ..results });
                }
                let capture = open.as_ref().map_err(Error::failed).and_then(|open| open.capture(key));
                match capture.and_then(|capture| {
                    let photo_size = self.method.photo_size();
                    let scene = EvalScene::indexed(key, &capture, self.index, photo_size, self.target_size)?;
                    self.score_scene(&scene, &perceptual, results.scenes.is_empty())
                }) {
                    Ok(scores) => results.scenes.push(scores),
                    // If this file can't be written, the next scene's can't either.
                    Err(e) if e.is_failed_write() => return Err(e),
                    Err(e) => results.failures.push(Failure { scene: key.clone(), error: e.to_string() }),
                }
                done += 1;
            }
        }
        let error = "the rank that it was assigned to doesn't have it";
        let absent = keys.into_iter().map(|key| Failure { scene: key, error: error.into() });
        results.failures.extend(absent);
        results.stopped = !on_progress(done, total);
        Ok(results)
    }

    /// Scores the scene, and writes its scores and the comparison image of its worst view.
    fn score_scene(&self, scene: &EvalScene, perceptual: &Perceptual, is_first: bool) -> Result<SceneScores> {
        let mut worst: Option<(f64, Tensor)> = None;
        let method = self.method.of_scene(&scene.name);
        let mut scores =
            method.score(scene, self.device, Some(perceptual), |view, rgb, rendered, score| {
                let psnr = score.scores.psnr;
                if worst.as_ref().is_none_or(|(lowest, _)| psnr.total_cmp(lowest).is_lt()) {
                    worst = Some((psnr, comparison_image(&view.image.to_float(), rgb, rendered)));
                }
                Ok(())
            })?;
        scores.warm_up = is_first && scores.forward_seconds.is_some();
        let (_, image) = worst.expect("a target view");
        write_jpeg(&comparison_path(self.out, &scene.name), &image)?;
        write_json(&scores_path(self.out, &scene.name), &scores)?;
        Ok(scores)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn dataset_name_matches_whole_words() {
        for (root, file, expected) in [
            ("data/re10k", "evaluation_index.json", "re10k"),
            ("data/RealEstate10K-small", "index.json", "re10k"),
            ("data/re10k/test", "index.json", "re10k"),
            ("data/re10k/test/train", "index.json", "re10k"),
            ("data/DL3DV.960P", "dl3dv_12v.json", "dl3dv"),
            ("data/chunks", "re10k_24v.json", "re10k"),
            ("data/chunks", "RE10K.acidic.json", "re10k"),
            ("data/chunks", "acid_from_re10k_3v.json", "acid"),
            // The folder's name comes first.
            ("data/acid", "re10k_3v.json", "acid"),
            ("data/placid", "myre10k_3v.json", "placid"),
            // The folders above the dataset's own don't count.
            ("re10k/mine", "index.json", "mine"),
            ("mine/test", "index.json", "mine"),
            ("test/test/test", "index.json", "test"),
        ] {
            let index = EvaluationIndex { file: file.into(), scenes: BTreeMap::new() };
            assert_eq!(dataset_name(Path::new(root), &index), expected, "{root} {file}");
        }
    }
}
