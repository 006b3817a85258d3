//! Evaluation of a method over a dataset, by an index: the paper's protocol (spec 9.1). The scores of every scene are stored as soon as
//! they are computed, so an interrupted evaluation resumes after the last finished scene.

use super::evaluation::{
    Efficiency, Evaluation, Failure, REPORT, SCORES, SceneScores, Summary, TABLE, comparison_path,
    scene_file_name,
};
use super::method::{Method, MethodOutput, score_output};
use super::published::known_dataset;
use super::scene::{EvaluationIndex, SceneLoader};
use crate::data::{Dataset, OpenGroup, SceneGroup};
use crate::distributed::ProcessGroup;
use crate::error::{Error, Result};
use crate::io::{WeightsFile, checksum, write_jpeg, write_json};
use crate::metrics::{Perceptual, comparison_image};
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;
use tch::{Device, Tensor};

/// Evaluation of a method over a dataset.
///
/// ```no_run
/// use globalsplat::data::{Dataset, Split};
/// use globalsplat::eval::{
///     DatasetEvaluation, EvaluationIndex, Method, machine, weights_fingerprint, write_evaluation, write_report,
/// };
/// use globalsplat::metrics::Perceptual;
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
///     dataset_name: DatasetEvaluation::dataset_name(None, root, &index)?,
///     index: &index,
///     target_size: model.config.data.image_size,
///     machine: machine(device)?,
///     device,
///     out,
///     group: &ProcessGroup::single(),
/// }
/// .run(
///     || Perceptual::find(device),
///     |done, total| {
///         println!("{done} of {total} scenes");
///         // `false` would stop; the next evaluation into the same folder resumes.
///         true
///     },
/// )?;
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
    /// Processor, cores and device.
    pub machine: String,
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
    /// Returns the name of the dataset at `root` for the report. This is `said` if given; else the known dataset that is a word of the
    /// folder's name; else the known dataset that is a word of the index's name; else the name of the folder.
    ///
    /// # Errors
    /// Fails if the name that decides contains two known datasets, or if the index names another one than the folder.
    pub fn dataset_name(said: Option<&str>, root: &Path, index: &EvaluationIndex) -> Result<String> {
        if let Some(name) = said {
            return Ok(known_dataset(name).unwrap_or(name).to_string());
        }
        let folder = dataset_folder_name(root);
        let (of_folder, of_index) = (known_datasets_in(&folder), known_datasets_in(&index.name()));
        let found = match (of_folder.as_slice(), of_index.as_slice()) {
            ([], []) => return Ok(folder),
            ([one], []) | ([], [one]) => return Ok(one.to_string()),
            ([one], of_index) if of_index.contains(one) => return Ok(one.to_string()),
            ([], _) => format!("{} by its name", of_index.join(" or ")),
            ([..], []) => format!("{} by the name of {}", of_folder.join(" or "), root.display()),
            ([..], [..]) => {
                let (ours, theirs) = (of_index.join(" or "), of_folder.join(" or "));
                format!("{ours} by its name and {theirs} by that of {}", root.display())
            }
        };
        Err(Error::input(&index.file, "the dataset", found, "a single one, as --dataset names"))
    }

    /// Scores the scenes that the index and the dataset have in common. `on_progress` is called with the number of finished scenes and the
    /// total, and returns `false` to stop. `load_perceptual` loads the networks of LPIPS. With several ranks, each scores its share, and
    /// all of them return the whole.
    ///
    /// # Errors
    /// Fails if there is no scene in common, if `out` holds scores of another method, if every scene fails, if another rank is gone, or if
    /// `on_progress` asked to stop. A scene that fails is recorded in [`Evaluation::failures`].
    pub fn run(
        &self,
        load_perceptual: impl FnOnce() -> Result<Perceptual>,
        mut on_progress: impl FnMut(usize, usize) -> bool,
    ) -> Result<Evaluation> {
        let begun = self.group.is_main_process().then(|| self.begin()).transpose()?;
        let (kept, missing) = self.group.broadcast_object(begun)?;
        let share =
            self.score_own_scenes(self.share(&missing), kept.len(), load_perceptual, &mut on_progress)?;
        let (mut scenes, mut failures, mut stopped) = (kept, vec![], false);
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
        for key in &missing {
            let is_it = |scene: &String| scene == key;
            if !scenes.iter().any(|scene| is_it(&scene.scores.scene))
                && !failures.iter().any(|of| is_it(&of.scene))
            {
                let error = "the rank that it was assigned to doesn't have it".into();
                failures.push(Failure { scene: key.clone(), error });
            }
        }
        failures.sort_by_key(|failure| missing.iter().position(|key| *key == failure.scene));
        if let (Some(failure), true) = (failures.first(), scenes.is_empty()) {
            let count = failures.len();
            return Err(Error::failed(format!(
                "none of {count} scenes could be scored; {}: {}",
                failure.scene, failure.error
            )));
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
            machine: self.machine.clone(),
            scenes,
            failures,
        })
    }

    /// Opens the store. Returns the scores that it holds, and the keys of the scenes that it has no scores of, group after group.
    fn begin(&self) -> Result<(Vec<SceneScores>, Vec<String>)> {
        let store = ScoreStore::open(self.out, &self.identity()?)?;
        let (mut kept, mut missing) = (vec![], vec![]);
        for (group, keys) in self.wanted()? {
            let open = OnceCell::new();
            let open = || open.get_or_init(|| group.open().ok()).as_ref();
            for key in keys {
                match self.find_valid_scores(&store, &key, open) {
                    Some(scores) => kept.push(scores),
                    None => missing.push(key),
                }
            }
        }
        Ok((kept, missing))
    }

    /// Returns this rank's share of the scenes `missing`, with the groups that hold them.
    fn share(&self, missing: &[String]) -> Vec<(&SceneGroup, Vec<String>)> {
        let own: BTreeSet<&String> =
            missing.iter().skip(self.group.rank()).step_by(self.group.world_size()).collect();
        let of_group =
            |group: &SceneGroup| group.keys.iter().filter(|key| own.contains(key)).cloned().collect();
        self.dataset.groups().iter().map(|group| (group, of_group(group))).collect()
    }

    /// Scores the scenes `own`. `kept` is the number of scenes that have been scored before.
    fn score_own_scenes(
        &self,
        own: Vec<(&SceneGroup, Vec<String>)>,
        kept: usize,
        load_perceptual: impl FnOnce() -> Result<Perceptual>,
        on_progress: &mut impl FnMut(usize, usize) -> bool,
    ) -> Result<RankResults> {
        let store = ScoreStore::new(self.out);
        let total = kept + own.iter().map(|(_, keys)| keys.len()).sum::<usize>();
        let mut share = RankResults::default();
        let mut should_continue = on_progress(kept, total);
        // The networks of LPIPS would count towards the method's memory. Load them after the first scene that images were rendered of, even
        // if scenes before it failed.
        let (mut load_perceptual, mut perceptual, mut memory) = (Some(load_perceptual), None, None);
        let (target_size, photo_size) = (self.target_size, self.method.photo_size());
        let loader = SceneLoader { index: self.index, target_size, photo_size };
        std::thread::scope(|scope| -> Result<()> {
            let (sender, receiver) = sync_channel(LOADED_AHEAD);
            scope.spawn(move || loader.send(own, &sender));
            while should_continue && let Ok((key, loaded)) = receiver.recv() {
                let method = self.method.of_scene(&key);
                let output = loaded.and_then(|scene| method.render_targets(scene, self.device));
                let first = output.is_ok().then(|| load_perceptual.take()).flatten();
                let warm_up = first.is_some();
                if let Some(load_perceptual) = first {
                    memory = method.memory();
                    perceptual = Some(load_perceptual()?);
                }
                let scored = output.and_then(|output| {
                    let perceptual = perceptual.as_ref().expect("loaded for the first scene");
                    let content = self.content(&key, output.scene.checksum)?;
                    let mut scores = self.score_output(output, perceptual)?;
                    scores.warm_up = warm_up && scores.forward_seconds.is_some();
                    scores.peak_memory_bytes = memory.map(|memory| memory.host);
                    scores.peak_device_memory_bytes = memory.and_then(|memory| memory.device);
                    store.write_scores(&key, &scores, content)?;
                    Ok(scores)
                });
                match scored {
                    Ok(scene) => {
                        memory = None;
                        share.scenes.push(scene);
                    }
                    // If this file can't be written, the next scene's can't either.
                    Err(e) if e.is_failed_write() => return Err(e),
                    Err(e) => share.failures.push(Failure { scene: key, error: e.to_string() }),
                }
                should_continue = on_progress(kept + share.scenes.len() + share.failures.len(), total);
            }
            Ok(())
        })?;
        share.stopped = !should_continue;
        Ok(share)
    }

    /// Returns the settings that must be equal for the evaluation to resume.
    fn identity(&self) -> Result<Identity> {
        let index = std::fs::read(&self.index.file).map_err(Error::read(&self.index.file))?;
        // The folder's name alone doesn't identify a dataset, since many folders are called `test`, so use its absolute path. Synthetic
        // videos have no folder, so the path stays as it is.
        let root = self.root.canonicalize().unwrap_or(self.root.to_owned());
        let generator =
            self.dataset.generator().map_or(String::new(), |generator| format!(" of {generator}"));
        Ok(Identity {
            method: self.fingerprint.clone(),
            dataset: root.display().to_string() + &generator,
            index: format!("{:08x} {}", crc32fast::hash(&index), self.index.name()),
            image_size: self.target_size.into(),
        })
    }

    /// Returns the stored scores of scene `key`, which is in the group that `open` opens. Returns `None`, so that the scene is scored
    /// again, if they are of other files or lack a score that can be computed now.
    fn find_valid_scores<'a>(
        &self,
        store: &ScoreStore,
        key: &str,
        open: impl FnOnce() -> Option<&'a OpenGroup>,
    ) -> Option<SceneScores> {
        let kept = store.read_scores(key)?;
        if Perceptual::could_add_to(&kept.scores.scores.mean, self.target_size) {
            return None;
        }
        let capture = open()?.capture(key).ok()?;
        let frames = self.index.frames(key, capture.len()).ok()?;
        let content = self.content(key, frames.checksum(&capture).ok()?).ok()?;
        (kept.files.as_ref() == Some(&content)).then_some(kept.scores)
    }

    /// Returns a string that identifies the files from which scene `key` is scored: checksums of the splat or the images, if these are
    /// evaluated, and `photos`, the checksum of the photos and cameras.
    fn content(&self, key: &str, photos: u32) -> Result<String> {
        let names = self.index.scenes[key].render_names();
        let checksum = self.method.of_scene(key).checksum(&names)?.map(|checksum| format!("{checksum:08x} "));
        Ok(format!("{}{photos:08x}", checksum.unwrap_or_default()))
    }

    /// Returns the groups of the dataset, each with the keys of its scenes that are in the index.
    fn wanted(&self) -> Result<Vec<(&SceneGroup, Vec<String>)>> {
        let indexed = |group: &SceneGroup| -> Vec<String> {
            group.keys.iter().filter(|key| self.index.scenes.contains_key(*key)).cloned().collect()
        };
        let wanted: Vec<_> = self.dataset.groups().iter().map(|group| (group, indexed(group))).collect();
        if wanted.iter().any(|(_, keys)| !keys.is_empty()) {
            return Ok(wanted);
        }
        let found = format!("none of the {} in the dataset {}", self.dataset.scenes(), self.dataset.name);
        let example = self.index.scenes.keys().next().map_or("", String::as_str);
        let expected =
            format!("scenes of the dataset; the index has {} such as {example}", self.index.scenes.len());
        Err(Error::input(&self.index.file, "what the index names", found, expected))
    }

    /// Scores the scene, and writes the comparison image of its worst view.
    fn score_output(&self, mut output: MethodOutput, perceptual: &Perceptual) -> Result<SceneScores> {
        let mut worst: Option<(f64, Tensor)> = None;
        let scores = score_output(&mut output, perceptual, |ground_truth, picture, score| {
            if worst.as_ref().is_none_or(|(psnr, _)| score.scores.psnr.total_cmp(psnr).is_lt()) {
                let photo = ground_truth.image.to_float();
                let image = comparison_image(&photo, &picture.rgb, picture.rendered.as_ref());
                worst = Some((score.scores.psnr, image));
            }
            Ok(())
        })?;
        let MethodOutput { scene, splat_bytes, forward_seconds, warnings, .. } = output;
        let (_, image) = worst.expect("a target view");
        write_jpeg(&comparison_path(self.out, &scene.name), &image)?;
        let frames = scene.frames.expect("an indexed scene");
        Ok(SceneScores {
            scores,
            context: frames.context,
            target: frames.target,
            enlarged: scene.enlarged,
            splat_bytes,
            warnings,
            forward_seconds,
            warm_up: false,
            peak_memory_bytes: None,
            peak_device_memory_bytes: None,
        })
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

/// Returns the known datasets that are words of `name`.
fn known_datasets_in(name: &str) -> Vec<&'static str> {
    let words = name.split(|c: char| !c.is_alphanumeric());
    let known: BTreeSet<_> = words.filter_map(known_dataset).collect();
    known.into_iter().collect()
}

/// Name of the file that an evaluation writes first.
const IDENTITY: &str = "evaluation.json";

/// Settings that must be equal for an evaluation to resume.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Identity {
    #[serde(rename = "subject")]
    pub method: String,
    pub dataset: String,
    pub index: String,
    pub image_size: [u32; 2],
}

/// Scores of a scene as they are stored on disk.
#[derive(Serialize, Deserialize)]
pub(super) struct StoredScores {
    #[serde(flatten)]
    pub scores: SceneScores,
    /// Checksums of the files that were scored, by which replaced files are detected.
    pub files: Option<String>,
}

/// Returns the paths of the files that an evaluation of the scenes `keys` writes into the folder `out`.
pub fn evaluation_files<'a>(out: &Path, keys: impl IntoIterator<Item = &'a String>) -> Vec<PathBuf> {
    let store = ScoreStore::new(out);
    let of_scene = |key: &'a String| [store.file(key), comparison_path(out, key)];
    let of_all = [IDENTITY, SCORES, TABLE].map(|name| out.join(name));
    keys.into_iter().flat_map(of_scene).chain(of_all).collect()
}

/// The folder `scenes` of an evaluation, which holds a file of scores per scene.
pub(super) struct ScoreStore {
    scenes: PathBuf,
}

impl ScoreStore {
    /// Opens the store in the folder `out`, or creates it.
    ///
    /// # Errors
    /// Fails if `out` holds files of another evaluation or a broken store, or if it can't be written.
    pub fn open(out: &Path, identity: &Identity) -> Result<Self> {
        let file = out.join(IDENTITY);
        // An evaluation writes `file` first, so without it these files belong to something else.
        let others = [SCORES, TABLE, REPORT];
        if let (false, Some(name)) = (file.exists(), others.into_iter().find(|name| out.join(name).exists()))
        {
            let found = format!("a folder with a {name} that no evaluation wrote");
            return Err(Error::input(out, "the output", found, "a folder of its own (choose another --out)"));
        }
        let store = ScoreStore::new(out);
        std::fs::create_dir_all(&store.scenes).map_err(Error::write(&store.scenes))?;
        // If no scene has been scored yet, different settings do no harm.
        let mut entries = std::fs::read_dir(&store.scenes).map_err(Error::read(&store.scenes))?;
        if entries.next().is_some()
            && let Ok(text) = std::fs::read(&file)
        {
            let wanted = |of: &Identity| {
                let [height, width] = of.image_size;
                format!("{} on {} by {}, {width}×{height} pixels", of.method, of.dataset, of.index)
            };
            return match serde_json::from_slice::<Identity>(&text) {
                Ok(found) if found == *identity => Ok(store),
                Ok(found) => {
                    let expected = format!("{} (choose another --out)", wanted(identity));
                    Err(Error::input(&file, "the evaluation", format!("of {}", wanted(&found)), expected))
                }
                Err(e) => Err(Error::input(
                    &file,
                    "the file",
                    format!("broken ({e})"),
                    "what globalsplat eval wrote",
                )),
            };
        }
        write_json(&file, identity)?;
        Ok(store)
    }

    /// Returns the store in the folder `out`, without accessing the disk.
    pub fn new(out: &Path) -> Self {
        ScoreStore { scenes: out.join("scenes") }
    }

    /// Returns the stored scores of scene `key`. Returns `None` if there are none, or if they can't be read.
    pub fn read_scores(&self, key: &str) -> Option<StoredScores> {
        let kept: StoredScores = serde_json::from_slice(&std::fs::read(self.file(key)).ok()?).ok()?;
        (kept.scores.scores.scene == key).then_some(kept)
    }

    /// Stores the scores of scene `key`. `files` identifies the files that were scored.
    ///
    /// # Errors
    /// Fails if the file can't be written.
    pub fn write_scores(&self, key: &str, scores: &SceneScores, files: String) -> Result<()> {
        Ok(write_json(&self.file(key), &StoredScores { scores: scores.clone(), files: Some(files) })?)
    }

    fn file(&self, key: &str) -> PathBuf {
        self.scenes.join(format!("{}.json", scene_file_name(key)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn name(root: &str, index: &str) -> Result<String> {
        let index = EvaluationIndex { file: index.into(), scenes: BTreeMap::new() };
        DatasetEvaluation::dataset_name(None, Path::new(root), &index)
    }

    #[test]
    fn dataset_name_matches_whole_words() {
        for (root, index, expected) in [
            ("data/re10k", "evaluation_index.json", "re10k"),
            ("data/RealEstate10K-small", "index.json", "re10k"),
            ("data/re10k/test", "index.json", "re10k"),
            ("data/re10k/test/train", "index.json", "re10k"),
            ("data/DL3DV.960P", "dl3dv_12v.json", "dl3dv"),
            ("data/chunks", "re10k_24v.json", "re10k"),
            ("data/chunks", "RE10K.acidic.json", "re10k"),
            ("data/acid", "acid_from_re10k_3v.json", "acid"),
            ("data/re10k", "acid_from_re10k_3v.json", "re10k"),
            ("data/placid", "myre10k_3v.json", "placid"),
            // The folders above the dataset's own don't count.
            ("re10k/mine", "index.json", "mine"),
            ("mine/test", "index.json", "mine"),
            ("test/test/test", "index.json", "test"),
        ] {
            assert_eq!(name(root, index).unwrap(), expected, "{root} {index}");
        }
    }

    #[test]
    fn two_names_are_refused() {
        for (root, index, found) in [
            ("chunks", "acid_from_re10k_3v.json", "acid or re10k by its name,"),
            ("acid", "re10k_3v.json", "re10k by its name and acid by that of acid,"),
            ("dl3dv/test", "acid_re10k.json", "acid or re10k by its name and dl3dv by that of dl3dv/test,"),
            ("acid_and_re10k", "index.json", "acid or re10k by the name of acid_and_re10k,"),
            ("acid_re10k", "acid.json", "acid by its name and acid or re10k by that of acid_re10k,"),
        ] {
            let error = name(root, index).unwrap_err().to_string();
            assert!(error.contains(&format!("{index}: the dataset is {found}")), "{error}");
            assert!(error.ends_with("expected a single one, as --dataset names"), "{error}");
        }
    }
}
