//! Validation: renders and scores held-out views and scenes during training (spec 8.8).

use super::method::Method;
use super::scene::{EvalScene, SceneFrames, split_views};
use crate::data::{
    Capture, DataConfig, Dataset, Holdout, PhotoSize, SceneGroup, Split, TrainingScenes, load_views,
};
use crate::error::{Error, Result};
use crate::io::real_path;
use crate::metrics::{CaptureScores, score_view};
use crate::reconstruct::spread_over_path;
use crate::train::{Score, Trainer, Validator};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Views held out of the training scenes, and scenes that are held out as a whole.
#[derive(Debug)]
pub struct HeldOut {
    config: DataConfig,
    scenes: Vec<HeldOutScene>,
    /// Names of the scenes that are held out as a whole although they are also trained on. Their scores say nothing about unseen scenes.
    pub trained_on: Vec<String>,
    /// Warnings about the scenes held out as a whole: a line for each kind of data that was left out or changed.
    pub warnings: Vec<String>,
    /// Scores of the last validation.
    pub scores: Vec<HeldOutScores>,
}

/// Source of the context and target views of a validation scene.
#[derive(Debug)]
enum HeldOutScene {
    /// Views that are held out of a capture.
    Views(Capture),
    /// Views that are held out of a scene in a chunk, or of a synthetic scene. Chunks and synthetic scenes are large, so it is opened only
    /// when it is needed.
    ViewsInGroup(SceneGroup, String),
    /// A scene that is held out as a whole.
    Whole(SceneGroup, String),
}

/// Validation scores of a scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct HeldOutScores {
    /// Scores of the model.
    pub ours: CaptureScores,
    /// Scores of the nearest context photo, which each target is compared with.
    #[serde(rename = "nearest_photo")]
    pub nearest: CaptureScores,
}

impl HeldOut {
    /// Finds the validation scenes that `config` asks for: views held out of `training` (of all captures, and of at most
    /// `config.validation_scenes` scenes in chunks), and the scenes of `config.validation`.
    ///
    /// # Errors
    /// Fails if one of the paths holds no known dataset, if `config.holdout` leaves a capture too few views, or if a held-out scene is
    /// broken or has too few views.
    pub fn find(config: &DataConfig, training: &TrainingScenes) -> Result<Self> {
        let mut scenes = vec![];
        let holds_out = |capture: &&Capture| config.holdout != Holdout::None || capture.has_test_part();
        for capture in training.captures.iter().filter(holds_out) {
            split_views(capture, config.holdout)?;
            scenes.push(HeldOutScene::Views(capture.clone()));
        }
        if config.holdout != Holdout::None {
            let others = spread(&training.others, config.validation_scenes);
            scenes.extend(others.into_iter().map(|(group, key)| HeldOutScene::ViewsInGroup(group, key)));
        }
        let (mut groups, mut warnings) = (vec![], vec![]);
        for path in config.validation_paths()? {
            let dataset = Dataset::open(&path, Split::Test)?;
            groups.extend(dataset.groups);
            warnings.extend(dataset.warnings);
        }
        let (trained, mut trained_on) = (scene_ids(training), vec![]);
        for (group, key) in spread(&groups, config.validation_scenes) {
            let capture = group.open()?.capture(&key)?;
            split_scene(&capture, config)?;
            warnings.extend_from_slice(capture.warnings());
            let scene_id = match group.is_folder() {
                true => scene_id(capture.file(), None),
                false => scene_id(group.path(), Some(&key)),
            };
            if trained.contains(&scene_id) {
                trained_on.push(capture.name.clone());
            }
            scenes.push(HeldOutScene::Whole(group, key));
        }
        Ok(HeldOut { config: config.clone(), scenes, trained_on, warnings, scores: vec![] })
    }

    /// Returns `true` if nothing is held out.
    pub fn is_empty(&self) -> bool {
        self.scenes.is_empty()
    }
}

impl HeldOutScene {
    /// Loads the scene.
    fn load(&self, config: &DataConfig) -> Result<EvalScene> {
        let capture = match self {
            HeldOutScene::Views(capture) => capture.clone(),
            HeldOutScene::ViewsInGroup(group, key) | HeldOutScene::Whole(group, key) => {
                group.open()?.capture(key)?
            }
        };
        let frames = match self {
            HeldOutScene::Views(_) => split_and_spread(&capture, config, config.holdout, usize::MAX)?,
            HeldOutScene::ViewsInGroup(..) => {
                split_and_spread(&capture, config, config.holdout, config.target_views)?
            }
            HeldOutScene::Whole(..) => split_scene(&capture, config)?,
        };
        let context = load_views(&capture, &frames.context, Some(config.image_size))?;
        Ok(EvalScene::new(&capture, frames, context, PhotoSize::Exactly(config.image_size)))
    }

    /// Scores the model on the scene.
    fn score(&self, trainer: &Trainer, config: &DataConfig) -> Result<HeldOutScores> {
        let (scene, model) = (self.load(config)?, trainer.as_model());
        let mut nearest = vec![];
        let ours = Method::Model(model).score(&scene, model.device, None, |view, _, _, _| {
            nearest.push(score_view(&scene.nearest_photo(view)?, view, None)?);
            Ok(())
        })?;
        let nearest = CaptureScores::from_views(&scene.name, nearest, None);
        Ok(HeldOutScores { ours: ours.scores, nearest })
    }
}

/// Results of a rank for its share of the scenes, each with the index of its scene.
#[derive(Debug, Default, Serialize, Deserialize)]
struct RankResults {
    scores: Vec<(usize, HeldOutScores)>,
    /// Error messages of the scenes that can't be used.
    unusable: Vec<(usize, String)>,
    /// Error message if the model can't be evaluated.
    failed: Option<String>,
    /// `true` if the caller asked to stop.
    stopped: bool,
}

impl HeldOut {
    /// Evaluates this rank's share of the scenes: every n-th of them for n ranks.
    fn score_assigned_scenes(
        &self,
        trainer: &Trainer,
        should_continue: &mut dyn FnMut() -> bool,
    ) -> RankResults {
        let (mut found, group) = (RankResults::default(), trainer.group());
        for (i, scene) in self.scenes.iter().enumerate().skip(group.rank()).step_by(group.world_size()) {
            if !should_continue() {
                found.stopped = true;
                break;
            }
            match scene.score(trainer, &self.config) {
                Ok(scores) => found.scores.push((i, scores)),
                // Files that can't be used are a problem of the scene alone.
                Err(e) if e.is_invalid_request() => found.unusable.push((i, e.to_string())),
                Err(e) => {
                    found.failed = Some(e.to_string());
                    break;
                }
            }
        }
        found
    }
}

impl Validator for HeldOut {
    fn scenes(&self) -> usize {
        self.scenes.len()
    }

    fn validate(
        &mut self,
        trainer: &Trainer,
        should_continue: &mut dyn FnMut() -> bool,
    ) -> Result<Option<Score>> {
        self.scores.clear();
        let (mut scores, mut unusable) = (vec![], vec![]);
        for found in
            trainer.group().all_gather_object(self.score_assigned_scenes(trainer, should_continue))?
        {
            if let Some(why) = found.failed {
                return Err(Error::failed(why));
            }
            if found.stopped {
                return Ok(None);
            }
            scores.extend(found.scores);
            unusable.extend(found.unusable);
        }
        scores.sort_by_key(|(i, _)| *i);
        unusable.sort_by_key(|(i, _)| *i);
        let scores: Vec<HeldOutScores> = scores.into_iter().map(|(_, scores)| scores).collect();
        for (i, _) in unusable.iter().rev() {
            self.scenes.remove(*i);
        }
        let left_out: Vec<String> = unusable.into_iter().map(|(_, why)| why).collect();
        if scores.is_empty() {
            let why = left_out.first().map(|why| format!(": {why}")).unwrap_or_default();
            return Err(Error::failed(format!("no held-out scene can be used{why}")));
        }
        let mean =
            |value: fn(&HeldOutScores) -> f64| scores.iter().map(value).sum::<f64>() / scores.len() as f64;
        let (psnr, ssim) = (mean(|s| s.ours.mean.psnr), mean(|s| s.ours.mean.ssim));
        let score = Score { psnr, ssim, scenes: scores.len(), stage: trainer.stage(), left_out };
        self.scores = scores;
        Ok(Some(score))
    }
}

/// Identity of a scene: its file, and its key in that file.
type SceneId = (PathBuf, Option<String>);

fn scene_id(file: &Path, key: Option<&String>) -> SceneId {
    (real_path(file), key.cloned())
}

/// Returns the identities of all scenes of `training`.
fn scene_ids(training: &TrainingScenes) -> BTreeSet<SceneId> {
    let captures = training.captures.iter().map(|capture| scene_id(capture.file(), None));
    let others = training.others.iter();
    let others = others.flat_map(|group| group.keys.iter().map(|key| scene_id(group.path(), Some(key))));
    captures.chain(others).collect()
}

/// Returns at most `most` scenes of `groups`, spread evenly over all of them.
fn spread(groups: &[SceneGroup], most: usize) -> Vec<(SceneGroup, String)> {
    let scenes: Vec<_> =
        groups.iter().flat_map(|group| group.keys.iter().map(move |key| (group, key))).collect();
    let count = most.min(scenes.len());
    let chosen = (0..count).map(|i| scenes[i * scenes.len() / count]);
    chosen.map(|(group, key)| (group.clone(), key.clone())).collect()
}

/// Splits the views of `capture` by `holdout`. The context has at most as many views as in training, since a model trained on a few need
/// not fit in memory with hundreds; there are at most `target_views` targets. Both are spread along the camera's path.
fn split_and_spread(
    capture: &Capture,
    config: &DataConfig,
    holdout: Holdout,
    target_views: usize,
) -> Result<SceneFrames> {
    let (cameras, SceneFrames { context, target }) = (capture.cameras(), split_views(capture, holdout)?);
    let context = spread_over_path(&cameras, &context, config.context_views.max(2));
    Ok(SceneFrames { context, target: spread_over_path(&cameras, &target, target_views) })
}

/// Returns the context and target views of a scene that is held out as a whole. The choice is deterministic: as many views as in training,
/// at even distances along the camera's path, from the middle of a video that is longer than the training window. A capture with a test
/// part of its own takes its targets from that part.
fn split_scene(capture: &Capture, config: &DataConfig) -> Result<SceneFrames> {
    if capture.has_test_part() {
        return split_and_spread(capture, config, Holdout::None, config.target_views);
    }
    let cameras = capture.cameras();
    if cameras.len() < 3 {
        return Err(Error::input(capture.file(), "the number of views", cameras.len(), "three or more"));
    }
    let length = cameras.len().min(config.window[1].max(3));
    let first = (cameras.len() - length) / 2;
    let window: Vec<usize> = (first..first + length).collect();
    let context = spread_over_path(&cameras, &window, config.context_views.clamp(2, length - 1));
    let between: Vec<usize> = window.into_iter().filter(|view| !context.contains(view)).collect();
    let target = spread_over_path(&cameras, &between, config.target_views);
    Ok(SceneFrames { context, target })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::SyntheticDataset;
    use globalsplat_synth::VideoSettings;

    #[test]
    fn the_model_sees_as_many_views_as_in_training() {
        let settings = VideoSettings { frames: 12, off_path: 0, is_object: false, size: [16, 16].into() };
        let capture = SyntheticDataset::new(0, 0, 1, settings).capture(0).unwrap();
        let config = DataConfig {
            image_size: [16, 16].into(),
            context_views: 4,
            target_views: 2,
            holdout: "every:3+1".parse().unwrap(),
            ..Default::default()
        };
        let scene = HeldOutScene::Views(capture).load(&config).unwrap();
        // The context views are chosen among views 0, 2, 3, 5, 6, 8, 9 and 11, along the path; the targets are all the others.
        let SceneFrames { context, target } = &scene.frames;
        assert_eq!((context.len(), scene.context.len(), target.as_slice()), (4, 4, &[1, 4, 7, 10][..]));
        assert_eq!((context[0], context[3]), (0, 11));
        let mut names = vec![];
        scene
            .for_each_target(|_, view| {
                names.push(view.name.clone());
                Ok(())
            })
            .unwrap();
        assert_eq!(names, ["000001", "000004", "000007", "000010"]);
    }
}
