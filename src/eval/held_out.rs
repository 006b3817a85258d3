//! Validation: what training never shows is rendered and scored while it goes on (spec 8.8).

use super::method::{colours, synthesize_views};
use super::scene::split_views;
use super::scores::{CaptureScores, nearest_context_baseline, score};
use crate::data::{Capture, DataConfig, Dataset, Holdout, SceneGroup, Split, TrainingScenes, View};
use crate::error::{Error, Result};
use crate::reconstruct::spread_over_path;
use crate::train::{Score, Trainer, Validator};

/// Views held out of the training scenes, and scenes that are held out as a whole.
#[derive(Debug)]
pub struct HeldOut {
    config: DataConfig,
    scenes: Vec<HeldOutScene>,
    scores: Vec<HeldOutScores>,
}

/// Where target views come from.
#[derive(Debug)]
enum HeldOutScene {
    /// The views that are held out of a capture.
    Views(Capture),
    /// The views that are held out of a scene in a chunk. It is opened when it is needed: a chunk is large.
    ViewsInChunk(SceneGroup, String),
    /// A scene that is held out as a whole.
    Whole(SceneGroup, String),
}

/// A scene's scores.
#[derive(Debug, Clone)]
pub struct HeldOutScores {
    /// The model's.
    pub ours: CaptureScores,
    /// Of the photo that was taken nearest, among those that the model saw.
    pub nearest: CaptureScores,
}

impl HeldOut {
    /// What `config` holds out: of `training`, which it is trained on (all captures, and at most `config.validation_scenes`
    /// scenes in chunks), and of `config.validation`.
    ///
    /// # Errors
    /// Nothing known at one of the paths, a capture that `config.holdout` leaves too few views, or a held-out scene that is
    /// broken or has too few.
    pub fn find(config: &DataConfig, training: &TrainingScenes) -> Result<Self> {
        let mut scenes = vec![];
        if config.holdout != Holdout::None {
            for capture in training.captures() {
                split_views(capture, config.holdout)?;
                scenes.push(HeldOutScene::Views(capture.clone()));
            }
            let in_chunks = spread(training.chunks(), config.validation_scenes);
            scenes.extend(in_chunks.into_iter().map(|(group, key)| HeldOutScene::ViewsInChunk(group, key)));
        }
        let mut groups = vec![];
        for path in config.validation_paths()? {
            groups.extend_from_slice(Dataset::open(&path, Split::Test)?.groups());
        }
        for (group, key) in spread(&groups, config.validation_scenes) {
            split_scene(&group.open()?.capture(&key)?, config)?;
            scenes.push(HeldOutScene::Whole(group, key));
        }
        Ok(HeldOut { config: config.clone(), scenes, scores: vec![] })
    }

    /// Whether nothing is held out.
    pub fn is_empty(&self) -> bool {
        self.scenes.is_empty()
    }

    /// What the last validation found.
    pub fn scores(&self) -> &[HeldOutScores] {
        &self.scores
    }
}

impl HeldOutScene {
    /// Its name, context and target views.
    fn load(&self, config: &DataConfig) -> Result<(String, Vec<View>, Vec<View>)> {
        let size = Some(config.image_size);
        let (capture, (context, target)) = match self {
            HeldOutScene::Views(capture) => (capture.clone(), split_views(capture, config.holdout)?),
            HeldOutScene::ViewsInChunk(group, key) => {
                let capture = group.open()?.capture(key)?;
                let (shown, held_out) = split_views(&capture, config.holdout)?;
                let cameras = capture.cameras();
                let context = spread_over_path(&cameras, &shown, config.context_views.max(2));
                let target = spread_over_path(&cameras, &held_out, config.target_views);
                (capture, (context, target))
            }
            HeldOutScene::Whole(group, key) => {
                let capture = group.open()?.capture(key)?;
                let split = split_scene(&capture, config)?;
                (capture, split)
            }
        };
        Ok((capture.name.clone(), capture.load(&context, size)?, capture.load(&target, size)?))
    }
}

impl Validator for HeldOut {
    fn validate(&mut self, trainer: &Trainer, go_on: &mut dyn FnMut() -> bool) -> Result<Option<Score>> {
        self.scores.clear();
        let (mut scores, mut left_out, mut unusable) = (vec![], vec![], vec![]);
        for (i, scene) in self.scenes.iter().enumerate() {
            if !go_on() {
                return Ok(None);
            }
            let (name, context, target) = match scene.load(&self.config) {
                Ok(views) => views,
                Err(e) => {
                    left_out.push(e.to_string());
                    unusable.push(i);
                    continue;
                }
            };
            let (reconstruction, rendered) = synthesize_views(trainer.as_model(), &context, &target)?;
            let count = reconstruction.gaussians.count();
            scores.push(HeldOutScores {
                ours: score(&name, &colours(&rendered), &target, Some(count))?,
                nearest: nearest_context_baseline(&name, &context, &target)?,
            });
        }
        for i in unusable.into_iter().rev() {
            self.scenes.remove(i);
        }
        if scores.is_empty() {
            let why = left_out.first().map(|why| format!(": {why}")).unwrap_or_default();
            return Err(Error::Failed(format!("no held-out scene can be used{why}")));
        }
        let mean =
            |value: fn(&HeldOutScores) -> f64| scores.iter().map(value).sum::<f64>() / scores.len() as f64;
        let (psnr, ssim) = (mean(|s| s.ours.psnr), mean(|s| s.ours.ssim));
        let score = Score { psnr, ssim, scenes: scores.len(), left_out };
        self.scores = scores;
        Ok(Some(score))
    }
}

/// At most so many scenes of `groups`, spread evenly over all of them.
fn spread(groups: &[SceneGroup], most: usize) -> Vec<(SceneGroup, String)> {
    let scenes: Vec<_> =
        groups.iter().flat_map(|group| group.keys.iter().map(move |key| (group, key))).collect();
    let count = most.min(scenes.len());
    let chosen = (0..count).map(|i| scenes[i * scenes.len() / count]);
    chosen.map(|(group, key)| (group.clone(), key.clone())).collect()
}

/// The context and target views of a held-out scene, always the same: as many as in
/// training, at even distances along the camera's path, from the middle of a video that is longer than training's.
fn split_scene(capture: &Capture, config: &DataConfig) -> Result<(Vec<usize>, Vec<usize>)> {
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
    Ok((context, target))
}
