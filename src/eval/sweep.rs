//! A method over a data set, by an index: the paper's protocol (spec 9.1). Every scene's scores are kept on disk as they
//! come, so a sweep that was stopped goes on where it was.

use super::comparison_image::comparison_image;
use super::evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary};
use super::index::EvaluationIndex;
use super::journal::{Identity, Journal};
use super::method::{Method, Synthesis, judge};
use super::perceptual::Perceptual;
use super::published::known_dataset;
use super::scene::SceneLoader;
use super::scores_file::comparison_path;
use crate::data::{Dataset, OpenGroup, SceneGroup};
use crate::error::{Error, Result};
use crate::io::write_jpeg;
use crate::ranks::Group;
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::mpsc::sync_channel;
use tch::{Device, Tensor};

/// What to evaluate, and where to.
#[derive(Debug)]
pub struct Sweep<'a> {
    /// What is judged; of splats and pictures the folder that has those of every scene.
    pub method: Method<'a>,
    /// How the report calls it.
    pub name: String,
    /// What tells this method from others, so that a stopped sweep doesn't go on with another one's scores.
    pub fingerprint: String,
    /// The scenes.
    pub dataset: &'a Dataset,
    /// The folder that they were found in.
    pub root: &'a Path,
    /// How the report calls them, as [`Sweep::dataset_name`] tells.
    pub dataset_name: String,
    /// Their frames.
    pub index: &'a EvaluationIndex,
    /// Of pictures, and of the photos that they have to match.
    pub picture_size: ImageSize,
    /// Processor, cores and device.
    pub machine: String,
    /// What splats are rendered on.
    pub device: Device,
    /// The folder for `scenes/`.
    pub out: &'a Path,
    /// The processes that share the scenes out. All of them see `out`.
    pub group: &'a Group,
}

/// What a rank did of its share.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Share {
    scenes: Vec<SceneScores>,
    failures: Vec<Failure>,
    /// Whether somebody asked to stop.
    stopped: bool,
}

/// Scenes that are loaded while others are judged.
const LOADED_AHEAD: usize = 1;

impl Sweep<'_> {
    /// How the report calls the data set at `root`: as `said`, else by the name of a known one that is a word of its folder's
    /// name, else of the index's, else as its folder.
    ///
    /// # Errors
    /// Two known names in the one that decides, or another in the index than in the folder.
    pub fn dataset_name(said: Option<&str>, root: &Path, index: &EvaluationIndex) -> Result<String> {
        if let Some(name) = said {
            return Ok(known_dataset(name).unwrap_or(name).to_string());
        }
        let folder = own_folder(root);
        let (of_folder, of_index) = (known_words(&folder), known_words(&index.name()));
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
        Err(Error::input(&index.file, "the data set", found, "a single one, as --dataset names"))
    }

    /// Runs over the scenes that the index and the data set share. `observe` hears how many of how many are done, and says
    /// whether to go on. Of several ranks each does its share, and is told the whole.
    ///
    /// # Errors
    /// No scene in common, scores of another method in `out`, every scene failing, another rank that is gone, or having been told to
    /// stop. A scene that fails is kept in [`Evaluation::failures`].
    pub fn run(
        &self,
        judges: impl FnOnce() -> Result<Perceptual>,
        mut observe: impl FnMut(usize, usize) -> bool,
    ) -> Result<Evaluation> {
        let begun = self.group.is_first().then(|| self.begin()).transpose()?;
        let (kept, missing) = self.group.from_first(begun)?;
        let share = self.run_share(self.share(&missing), kept.len(), judges, &mut observe)?;
        let (mut scenes, mut failures, mut stopped) = (kept, vec![], false);
        for share in self.group.gather(share)? {
            scenes.extend(share.scenes);
            failures.extend(share.failures);
            stopped |= share.stopped;
        }
        if stopped {
            let (done, total) = (scenes.len(), missing.len() + scenes.len());
            return Err(Error::Failed(format!(
                "stopped after {done} of {total} scenes; {} holds their scores, and the same command goes on",
                self.out.display()
            )));
        }
        for key in &missing {
            let is_it = |scene: &String| scene == key;
            if !scenes.iter().any(|scene| is_it(&scene.scores.scene))
                && !failures.iter().any(|of| is_it(&of.scene))
            {
                let error = "the process whose turn it was doesn't have it".into();
                failures.push(Failure { scene: key.clone(), error });
            }
        }
        failures.sort_by_key(|failure| missing.iter().position(|key| *key == failure.scene));
        if let (Some(failure), true) = (failures.first(), scenes.is_empty()) {
            let count = failures.len();
            return Err(Error::Failed(format!(
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
            input: self.method.input(),
            image_size: self.picture_size.into(),
            indexed_scenes: self.index.scenes.len(),
            summary: Summary::of(&scenes),
            efficiency: Efficiency::of(&scenes),
            machine: self.machine.clone(),
            scenes,
            failures,
        })
    }

    /// Opens the journal: scores that are in it, and the scenes that have none, group after group.
    fn begin(&self) -> Result<(Vec<SceneScores>, Vec<String>)> {
        let journal = Journal::open(self.out, &self.identity()?)?;
        let (mut kept, mut missing) = (vec![], vec![]);
        for (group, keys) in self.wanted()? {
            let open = OnceCell::new();
            let open = || open.get_or_init(|| group.open().ok()).as_ref();
            for key in keys {
                match self.kept(&journal, &key, open) {
                    Some(scores) => kept.push(scores),
                    None => missing.push(key),
                }
            }
        }
        Ok((kept, missing))
    }

    /// This rank's of the scenes `missing`, with the groups that hold them.
    fn share(&self, missing: &[String]) -> Vec<(&SceneGroup, Vec<String>)> {
        let own: BTreeSet<&String> =
            missing.iter().skip(self.group.rank()).step_by(self.group.ranks()).collect();
        let of_group =
            |group: &SceneGroup| group.keys.iter().filter(|key| own.contains(key)).cloned().collect();
        self.dataset.groups().iter().map(|group| (group, of_group(group))).collect()
    }

    /// Scores `own` scenes; `kept` ones have been.
    fn run_share(
        &self,
        own: Vec<(&SceneGroup, Vec<String>)>,
        kept: usize,
        judges: impl FnOnce() -> Result<Perceptual>,
        observe: &mut impl FnMut(usize, usize) -> bool,
    ) -> Result<Share> {
        let journal = Journal::of(self.out);
        let total = kept + own.iter().map(|(_, keys)| keys.len()).sum::<usize>();
        let mut share = Share::default();
        let mut go_on = observe(kept, total);
        // Loading the judges' networks would count as the method's memory, so they come after the first scene of which pictures
        // were made, whatever failed before it.
        let (mut judges, mut perceptual, mut memory) = (Some(judges), None, None);
        let (picture_size, photo_size) = (self.picture_size, self.method.photo_size());
        let loader = SceneLoader { index: self.index, picture_size, photo_size };
        std::thread::scope(|scope| -> Result<()> {
            let (sender, receiver) = sync_channel(LOADED_AHEAD);
            scope.spawn(move || loader.send(own, &sender));
            while go_on && let Ok((key, loaded)) = receiver.recv() {
                let method = self.method.of_scene(&key);
                let made = loaded.and_then(|scene| method.synthesize(scene, self.device));
                let first = made.is_ok().then(|| judges.take()).flatten();
                let warm_up = first.is_some();
                if let Some(judges) = first {
                    memory = method.memory();
                    perceptual = Some(judges()?);
                }
                let judged = made.and_then(|made| {
                    let perceptual = perceptual.as_ref().expect("loaded for the first scene");
                    let content = self.content(&key, made.scene.checksum)?;
                    let mut scores = self.judge(made, perceptual)?;
                    scores.warm_up = warm_up && scores.forward_seconds.is_some();
                    scores.peak_memory_bytes = memory.map(|memory| memory.host);
                    scores.peak_device_memory_bytes = memory.and_then(|memory| memory.device);
                    journal.keep(&key, &scores, content)?;
                    Ok(scores)
                });
                match judged {
                    Ok(scene) => {
                        memory = None;
                        share.scenes.push(scene);
                    }
                    // What can't be written now can't be written for the next scene.
                    Err(e @ Error::Write { .. }) => return Err(e),
                    Err(e) => share.failures.push(Failure { scene: key, error: e.to_string() }),
                }
                go_on = observe(kept + share.scenes.len() + share.failures.len(), total);
            }
            Ok(())
        })?;
        share.stopped = !go_on;
        Ok(share)
    }

    /// By which a sweep that goes on is recognized.
    fn identity(&self) -> Result<Identity> {
        let index = std::fs::read(&self.index.file).map_err(Error::read(&self.index.file))?;
        // Its name alone doesn't tell, many a folder is called `test`: but that of made-up videos, which lie nowhere.
        let root = self.root.canonicalize().unwrap_or(self.root.to_owned());
        let made_by = self.dataset.made_by().map_or(String::new(), |made_by| format!(" of {made_by}"));
        Ok(Identity {
            method: self.fingerprint.clone(),
            dataset: root.display().to_string() + &made_by,
            index: format!("{:08x} {}", crc32fast::hash(&index), self.index.name()),
            image_size: self.picture_size.into(),
        })
    }

    /// Returns scores from before of scene `key`, which is one of those that `open` opens. What is of other files, or lacks a score
    /// that could be had now, is scored again.
    fn kept<'a>(
        &self,
        journal: &Journal,
        key: &str,
        open: impl FnOnce() -> Option<&'a OpenGroup>,
    ) -> Option<SceneScores> {
        let kept = journal.kept(key)?;
        if Perceptual::could_add_to(&kept.scores.scores, self.picture_size) {
            return None;
        }
        let capture = open()?.capture(key).ok()?;
        let frames = self.index.frames(key, capture.len()).ok()?;
        let content = self.content(key, frames.checksum(&capture).ok()?).ok()?;
        (kept.files.as_ref() == Some(&content)).then_some(kept.scores)
    }

    /// Returns what tells the files of which scene `key` was scored from others in their place: checksums of the splat or pictures, if
    /// these are judged, and of the photos and cameras, which is `photos`.
    fn content(&self, key: &str, photos: u32) -> Result<String> {
        let names = self.index.scenes[key].picture_names();
        let made = self.method.of_scene(key).checksum(&names)?.map(|made| format!("{made:08x} "));
        Ok(format!("{}{photos:08x}", made.unwrap_or_default()))
    }

    /// The groups that hold indexed scenes, with these.
    fn wanted(&self) -> Result<Vec<(&SceneGroup, Vec<String>)>> {
        let indexed = |group: &SceneGroup| -> Vec<String> {
            group.keys.iter().filter(|key| self.index.scenes.contains_key(*key)).cloned().collect()
        };
        let wanted: Vec<_> = self.dataset.groups().iter().map(|group| (group, indexed(group))).collect();
        if wanted.iter().any(|(_, keys)| !keys.is_empty()) {
            return Ok(wanted);
        }
        let found = format!("none of the {} in the data set {}", self.dataset.scenes(), self.dataset.name);
        let example = self.index.scenes.keys().next().map_or("", String::as_str);
        let expected =
            format!("scenes of the data set; the index has {} such as {example}", self.index.scenes.len());
        Err(Error::input(&self.index.file, "what the index names", found, expected))
    }

    /// The scene's scores; its worst view is drawn.
    fn judge(&self, mut made: Synthesis, perceptual: &Perceptual) -> Result<SceneScores> {
        let mut worst: Option<(f64, Tensor)> = None;
        let scores = judge(&mut made, perceptual, |truth, picture, score| {
            if worst.as_ref().is_none_or(|(psnr, _)| score.psnr.total_cmp(psnr).is_lt()) {
                let image = comparison_image(&truth.image, &picture.rgb, picture.rendered.as_ref());
                worst = Some((score.psnr, image));
            }
            Ok(())
        })?;
        let Synthesis { scene, splat_bytes, forward_seconds, warnings, .. } = made;
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

/// What the folder of the data set at `root` is called; of a part, `test` or `train`, the folder that it is a part of.
fn own_folder(root: &Path) -> String {
    let root = root.canonicalize().unwrap_or(root.to_owned());
    let folders = root.ancestors().take(3).filter_map(|folder| folder.file_name());
    let names: Vec<_> = folders.map(|name| name.to_string_lossy().into_owned()).collect();
    let own = names.iter().find(|name| !["train", "test"].contains(&name.as_str()));
    own.or(names.first()).cloned().unwrap_or_default()
}

/// The known data sets that words of `name` name.
fn known_words(name: &str) -> Vec<&'static str> {
    let words = name.split(|c: char| !c.is_alphanumeric());
    let known: BTreeSet<_> = words.filter_map(known_dataset).collect();
    known.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn name(root: &str, index: &str) -> Result<String> {
        let index = EvaluationIndex { file: index.into(), scenes: BTreeMap::new() };
        Sweep::dataset_name(None, Path::new(root), &index)
    }

    #[test]
    fn data_sets_are_called_by_whole_words() {
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
            // What is above isn't the data's own.
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
            assert!(error.contains(&format!("{index}: the data set is {found}")), "{error}");
            assert!(error.ends_with("expected a single one, as --dataset names"), "{error}");
        }
    }
}
