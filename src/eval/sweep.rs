//! One subject over a data set, by an index: the paper's protocol (SPEC section 9). Every scene's scores are kept on disk as
//! they come, so a sweep that was stopped goes on where it was.

use super::evaluation::{Efficiency, Evaluation, Failure, SceneScores, Summary, scene_file_name};
use super::index::{EvaluationIndex, SceneFrames};
use super::memory::{device_memory_bytes, peak_memory_bytes};
use super::perceptual::Perceptual;
use super::protocol::{Rendered, ask, colours, read_picture, render_views, score};
use super::scores_file::strip_path;
use super::strip::strip;
use crate::data::{Capture, Dataset, ImageSize, SceneGroup, View};
use crate::error::{Error, Result};
use crate::io::{LoadedModel, ply_size, read_ply, write_atomically, write_jpeg};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::UNIX_EPOCH;
use tch::Tensor;

/// Who is judged.
#[derive(Debug)]
pub enum Subject<'a> {
    /// A model, which sees the context frames.
    Model(&'a LoadedModel),
    /// A folder of splats in the scenes' own worlds: `SCENE.ply`.
    Splats(PathBuf),
    /// A folder of pictures of the target frames: `SCENE/FRAME.png`, or `SCENE/color/FRAME.png`, or `.jpg`, frames by six
    /// digits.
    Renders(PathBuf),
}

/// What to evaluate, and where to.
#[derive(Debug)]
pub struct Sweep<'a> {
    /// Who is judged.
    pub subject: Subject<'a>,
    /// How the report calls it.
    pub method: String,
    /// What tells this subject from others, so that a stopped sweep doesn't go on with another one's scores.
    pub fingerprint: String,
    /// The scenes.
    pub dataset: &'a Dataset,
    /// Their frames.
    pub index: &'a EvaluationIndex,
    /// To which photos are fitted, and which pictures have.
    pub image_size: ImageSize,
    /// Processor, cores and device.
    pub machine: String,
    /// The folder for `scenes/`.
    pub out: &'a Path,
}

/// Scenes that are loaded while others are judged.
const LOADED_AHEAD: usize = 1;

/// By which a sweep that goes on is recognized.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Identity {
    subject: String,
    dataset: String,
    index: String,
    image_size: [u32; 2],
}

/// A scene's photos.
struct LoadedScene {
    frames: SceneFrames,
    context: Vec<View>,
    target: Vec<View>,
}

/// A subject's answer to a scene.
struct Answer {
    /// Of the target views, [3, H, W].
    pictures: Vec<Tensor>,
    /// The same with depth, where a splat was rendered here.
    rendered: Vec<Rendered>,
    gaussians: Option<i64>,
    /// As a PLY.
    splat_bytes: Option<u64>,
    forward_seconds: Option<f64>,
}

impl Sweep<'_> {
    /// Runs over the scenes that the index and the data set share. `observe` hears how many of how many are done, and says
    /// whether to go on.
    ///
    /// # Errors
    /// No scene in common, scores of another subject in `out`, every scene failing, or having been told to stop. A scene that
    /// fails is kept in [`Evaluation::failures`].
    pub fn run(
        &self,
        judges: impl FnOnce() -> Result<Perceptual>,
        mut observe: impl FnMut(usize, usize) -> bool,
    ) -> Result<Evaluation> {
        self.check_identity()?;
        let wanted = self.wanted()?;
        let total: usize = wanted.iter().map(|(_, keys)| keys.len()).sum();
        let (mut scenes, mut missing) = (vec![], vec![]);
        for (group, keys) in wanted {
            let (done, rest): (Vec<_>, Vec<_>) =
                keys.into_iter().map(|key| (self.kept(&key), key)).partition(|(kept, _)| kept.is_some());
            scenes.extend(done.into_iter().filter_map(|(kept, _)| kept));
            missing.push((group, rest.into_iter().map(|(_, key)| key).collect::<Vec<_>>()));
        }
        let mut failures = vec![];
        let mut go_on = observe(scenes.len(), total);
        // Loading the judges' networks would count as the subject's memory.
        let (mut judges, mut perceptual) = (Some(judges), None);
        let with_context = matches!(self.subject, Subject::Model(_));
        let loader = SceneLoader { index: self.index, image_size: self.image_size, with_context };
        std::thread::scope(|scope| -> Result<()> {
            let (sender, receiver) = sync_channel(LOADED_AHEAD);
            scope.spawn(move || loader.send(missing, &sender));
            let receiver: Receiver<(String, Result<LoadedScene>)> = receiver;
            while go_on && let Ok((key, loaded)) = receiver.recv() {
                let answered = loaded.and_then(|scene| Ok((self.answer(&key, &scene)?, scene)));
                let first = judges.take();
                let memory = first.is_some().then(|| self.memory()).flatten();
                if let Some(judges) = first {
                    perceptual = Some(judges()?);
                }
                let judged = answered.and_then(|(answer, scene)| {
                    let perceptual = perceptual.as_ref().expect("loaded for the first scene");
                    self.judge(&key, &scene, answer, memory, perceptual)
                });
                match judged {
                    Ok(scene) => scenes.push(scene),
                    // What can't be written now can't be written for the next scene.
                    Err(e @ Error::Write { .. }) => return Err(e),
                    Err(e) => failures.push(Failure { scene: key, error: e.to_string() }),
                }
                go_on = observe(scenes.len() + failures.len(), total);
            }
            Ok(())
        })?;
        if !go_on {
            let done = scenes.len();
            return Err(Error::Failed(format!(
                "stopped after {done} of {total} scenes; {} holds their scores, and the same command goes on",
                self.out.display()
            )));
        }
        if let (Some(failure), true) = (failures.first(), scenes.is_empty()) {
            let count = failures.len();
            return Err(Error::Failed(format!(
                "none of {count} scenes could be scored; {}: {}",
                failure.scene, failure.error
            )));
        }
        scenes.sort_by(|a, b| a.scores.scene.cmp(&b.scores.scene));
        Ok(Evaluation {
            method: self.method.clone(),
            dataset: self.dataset_name(),
            index: self.index.name(),
            context_views: self.index.context_views(),
            image_size: self.image_size.into(),
            indexed_scenes: self.index.scenes.len(),
            summary: Summary::of(&scenes),
            efficiency: Efficiency::of(&scenes),
            machine: self.machine.clone(),
            scenes,
            failures,
        })
    }

    /// The name by which the paper's tables know the data set, if the index or the data set bears it.
    fn dataset_name(&self) -> String {
        let known = |name: &str| {
            ["re10k", "acid", "dl3dv"].into_iter().find(|known| name.to_lowercase().contains(known))
        };
        let found = known(&self.index.name()).or_else(|| known(&self.dataset.name));
        found.map_or(self.dataset.name.clone(), String::from)
    }

    fn check_identity(&self) -> Result<()> {
        let file = self.out.join("evaluation.json");
        let identity = Identity {
            subject: self.fingerprint.clone(),
            dataset: self.dataset.name.clone(),
            index: format!(
                "{:08x} {}",
                crc32fast::hash(&std::fs::read(&self.index.file).map_err(Error::read(&self.index.file))?),
                self.index.name()
            ),
            image_size: self.image_size.into(),
        };
        let scenes = self.out.join("scenes");
        std::fs::create_dir_all(&scenes).map_err(Error::write(&scenes))?;
        // Where nothing was scored yet, there is nothing to mix up.
        let mut entries = std::fs::read_dir(&scenes).map_err(Error::read(&scenes))?;
        if entries.next().is_some()
            && let Ok(text) = std::fs::read(&file)
        {
            let wanted = |of: &Identity| format!("{} on {} by {}", of.subject, of.dataset, of.index);
            return match serde_json::from_slice::<Identity>(&text) {
                Ok(found) if found == identity => Ok(()),
                Ok(found) => {
                    let expected = format!("{} (choose another --out)", wanted(&identity));
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
        write_json(&file, &identity)
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

    fn kept_file(&self, key: &str) -> PathBuf {
        self.out.join("scenes").join(format!("{}.json", scene_file_name(key)))
    }

    /// Scores from before. What can't be read, is of other files, or lacks a score that could be had now, is scored again.
    fn kept(&self, key: &str) -> Option<SceneScores> {
        let Kept { scores, files } =
            serde_json::from_slice(&std::fs::read(self.kept_file(key)).ok()?).ok()?;
        let is_whole = !Perceptual::could_add_to(&scores.scores, self.image_size);
        (scores.scores.scene == key && files == self.files(key) && is_whole).then_some(scores)
    }

    /// What tells a scene's splat or pictures from others in their place: names, sizes, times. Of a model it is nothing, as
    /// its fingerprint tells it from others.
    fn files(&self, key: &str) -> Option<String> {
        let files: Vec<PathBuf> = match &self.subject {
            Subject::Model(_) => return None,
            Subject::Splats(folder) => vec![splat_file(folder, key)],
            Subject::Renders(folder) => {
                let pictures = std::fs::read_dir(pictures_folder(folder, key)).ok()?;
                pictures.filter_map(|entry| Some(entry.ok()?.path())).collect()
            }
        };
        let describe = |file: &PathBuf| {
            let metadata = file.metadata().ok()?;
            let since = metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
            Some(format!("{} {} {}", file.file_name()?.display(), metadata.len(), since.as_nanos()))
        };
        let mut described: Vec<_> = files.iter().filter_map(describe).collect();
        described.sort();
        Some(format!("{:08x}", crc32fast::hash(described.join("\n").as_bytes())))
    }

    fn answer(&self, key: &str, scene: &LoadedScene) -> Result<Answer> {
        match &self.subject {
            Subject::Model(loaded) => {
                let (reconstruction, rendered) = ask(*loaded, &scene.context, &scene.target)?;
                let gaussians = &reconstruction.gaussians;
                Ok(Answer {
                    pictures: colours(&rendered),
                    rendered,
                    gaussians: Some(gaussians.count()),
                    splat_bytes: Some(ply_size(gaussians)),
                    forward_seconds: Some(reconstruction.forward_time.as_secs_f64()),
                })
            }
            Subject::Splats(folder) => {
                let file = splat_file(folder, key);
                let gaussians = read_ply(&file)?.gaussians;
                let cameras: Vec<_> = scene.target.iter().map(|view| view.camera).collect();
                let rendered = render_views(&gaussians, &cameras)?;
                Ok(Answer {
                    pictures: colours(&rendered),
                    rendered,
                    gaussians: Some(gaussians.count()),
                    splat_bytes: Some(file.metadata().map_err(Error::read(&file))?.len()),
                    forward_seconds: None,
                })
            }
            Subject::Renders(folder) => {
                let folder = pictures_folder(folder, key);
                let picture = |frame: &usize| read_picture(&folder, &frame_name(*frame));
                let pictures = scene.frames.target.iter().map(picture).collect::<Result<_>>()?;
                Ok(Answer {
                    pictures,
                    rendered: vec![],
                    gaussians: None,
                    splat_bytes: None,
                    forward_seconds: None,
                })
            }
        }
    }

    /// So far; none where no model is judged.
    fn memory(&self) -> Option<Memory> {
        match self.subject {
            Subject::Model(loaded) => {
                let device = device_memory_bytes(loaded.vs.device());
                Some(Memory { host: peak_memory_bytes(), device })
            }
            _ => None,
        }
    }

    fn judge(
        &self,
        key: &str,
        scene: &LoadedScene,
        answer: Answer,
        memory: Option<Memory>,
        perceptual: &Perceptual,
    ) -> Result<SceneScores> {
        let Answer { pictures, rendered, gaussians, splat_bytes, forward_seconds } = answer;
        let mut scores = score(key, &pictures, &scene.target, gaussians)?;
        perceptual.add_to(&mut scores, &pictures, &scene.target);
        for (view, &frame) in scores.views.iter_mut().zip(&scene.frames.target) {
            view.image = frame_name(frame);
        }
        let psnr = |&view: &usize| scores.views[view].psnr;
        let worst = (0..pictures.len()).min_by(|a, b| psnr(a).total_cmp(&psnr(b))).expect("a target view");
        let strip = strip(&scene.target[worst].image, &pictures[worst], rendered.get(worst));
        write_jpeg(&strip_path(self.out, key), &strip)?;
        let scores = SceneScores {
            scores,
            context: scene.frames.context.clone(),
            target: scene.frames.target.clone(),
            splat_bytes,
            forward_seconds,
            warm_up: memory.is_some(),
            peak_memory_bytes: memory.map(|memory| memory.host),
            peak_device_memory_bytes: memory.and_then(|memory| memory.device),
        };
        let kept = Kept { scores, files: self.files(key) };
        write_json(&self.kept_file(key), &kept)?;
        Ok(kept.scores)
    }
}

/// Where a folder of splats has that of scene `key`.
fn splat_file(folder: &Path, key: &str) -> PathBuf {
    folder.join(format!("{key}.ply"))
}

/// Where a folder of pictures has those of scene `key`.
fn pictures_folder(folder: &Path, key: &str) -> PathBuf {
    let plain = folder.join(key);
    Some(plain.join("color")).filter(|color| color.is_dir()).unwrap_or(plain)
}

/// A scene's scores on disk.
#[derive(Serialize, Deserialize)]
struct Kept {
    #[serde(flatten)]
    scores: SceneScores,
    /// As [`Sweep::files`] says.
    files: Option<String>,
}

/// What a model took, in bytes.
#[derive(Clone, Copy)]
struct Memory {
    host: u64,
    device: Option<u64>,
}

/// Reads scenes, beside the thread that judges them.
struct SceneLoader<'a> {
    index: &'a EvaluationIndex,
    image_size: ImageSize,
    /// Only a model looks at it.
    with_context: bool,
}

impl SceneLoader<'_> {
    /// Sends the scenes of `groups` one by one, each chunk read once, until nobody listens.
    fn send(
        &self,
        groups: Vec<(&SceneGroup, Vec<String>)>,
        sender: &SyncSender<(String, Result<LoadedScene>)>,
    ) {
        for (group, keys) in groups.into_iter().filter(|(_, keys)| !keys.is_empty()) {
            let open = group.open().map_err(|e| e.to_string());
            for key in keys {
                let scene = match &open {
                    Ok(open) => open.capture(&key).and_then(|capture| self.load_scene(&key, &capture)),
                    Err(e) => Err(Error::Failed(e.clone())),
                };
                if sender.send((key, scene)).is_err() {
                    return;
                }
            }
        }
    }

    fn load_scene(&self, key: &str, capture: &Capture) -> Result<LoadedScene> {
        let frames = self.index.frames(key, capture.len())?.clone();
        let size = Some(self.image_size);
        let context = if self.with_context { capture.load(&frames.context, size)? } else { vec![] };
        Ok(LoadedScene { context, target: capture.load(&frames.target, size)?, frames })
    }
}

impl Efficiency {
    /// Of scenes that a model was run on; none where it wasn't.
    fn of(scenes: &[SceneScores]) -> Option<Self> {
        let time = |scene: &SceneScores| scene.forward_seconds;
        let mut times: Vec<f64> = scenes.iter().filter(|scene| !scene.warm_up).filter_map(time).collect();
        if times.is_empty() {
            times = scenes.iter().filter_map(time).collect();
        }
        let bytes: Vec<f64> = scenes.iter().filter_map(|scene| Some(scene.splat_bytes? as f64)).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        (!times.is_empty()).then(|| Efficiency {
            forward_seconds: mean(&times),
            timed_scenes: times.len(),
            peak_memory_bytes: scenes.iter().filter_map(|scene| scene.peak_memory_bytes).max().unwrap_or(0),
            peak_device_memory_bytes: scenes.iter().filter_map(|scene| scene.peak_device_memory_bytes).max(),
            splat_bytes: mean(&bytes),
        })
    }
}

/// As chunks name a frame.
fn frame_name(frame: usize) -> String {
    format!("{frame:06}")
}

fn write_json(file: &Path, value: &impl Serialize) -> Result<()> {
    let json = serde_json::to_vec_pretty(value).expect("numbers and strings");
    write_atomically(file, |writer| writer.write_all(&json).map_err(Error::write(file)))
}
