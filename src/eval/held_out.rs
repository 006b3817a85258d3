//! Validation: what training never shows is asked for while it goes on.

use super::protocol::{CaptureScores, ask, colours, load_split, nearest_context_baseline, score};
use crate::config::DataConfig;
use crate::data::{Capture, Dataset, Holdout, SceneGroup, Split, View, spread_over_path};
use crate::error::{Error, Result};
use crate::train::{Score, Trainer, Validator};

/// Views held out of the training captures, and scenes that are held out as a whole.
#[derive(Debug)]
pub struct HeldOut {
    config: DataConfig,
    captures: Vec<Capture>,
    /// Groups, and which of their scenes. They are opened when they are needed: a chunk is large.
    scenes: Vec<(SceneGroup, String)>,
    scores: Vec<HeldOutScores>,
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
    /// What `config` holds out: of `training`, which it is trained on, and of `config.validation`.
    ///
    /// # Errors
    /// Nothing known at one of the paths, or a scene that is broken or has too few views.
    pub fn find(config: &DataConfig, training: &[Capture]) -> Result<Self> {
        let mut scenes = vec![];
        for path in config.validation_paths()? {
            for group in Dataset::open(&path, Split::Test)?.groups() {
                scenes.extend(group.keys.iter().map(|key| (group.clone(), key.clone())));
            }
        }
        let count = config.validation_scenes.min(scenes.len());
        let scenes: Vec<_> = (0..count).map(|i| scenes[i * scenes.len() / count].clone()).collect();
        for (group, key) in &scenes {
            split_scene(&group.open()?.capture(key)?, config)?;
        }
        let captures = if config.holdout == Holdout::None { vec![] } else { training.to_vec() };
        Ok(HeldOut { config: config.clone(), captures, scenes, scores: vec![] })
    }

    /// Whether nothing is held out.
    pub fn is_empty(&self) -> bool {
        self.captures.is_empty() && self.scenes.is_empty()
    }

    /// What the last validation found.
    pub fn scores(&self) -> &[HeldOutScores] {
        &self.scores
    }

    /// The views to show and those to ask for, of scene number `i`, and its name.
    fn load(&self, i: usize) -> Result<(String, Vec<View>, Vec<View>)> {
        let size = self.config.image_size;
        if let Some(capture) = self.captures.get(i) {
            let (context, target) = load_split(capture, self.config.holdout, None, size)?;
            return Ok((capture.name.clone(), context, target));
        }
        let (group, key) = &self.scenes[i - self.captures.len()];
        let capture = group.open()?.capture(key)?;
        let (context, target) = split_scene(&capture, &self.config)?;
        Ok((capture.name.clone(), capture.load(&context, Some(size))?, capture.load(&target, Some(size))?))
    }
}

impl Validator for HeldOut {
    fn validate(&mut self, trainer: &Trainer, go_on: &mut dyn FnMut() -> bool) -> Result<Option<Score>> {
        self.scores.clear();
        let mut scores = vec![];
        for i in 0..self.captures.len() + self.scenes.len() {
            if !go_on() {
                return Ok(None);
            }
            let (name, context, target) = self.load(i)?;
            let (reconstruction, rendered) = ask(trainer, &context, &target)?;
            let count = reconstruction.gaussians.count();
            scores.push(HeldOutScores {
                ours: score(&name, &colours(&rendered), &target, Some(count))?,
                nearest: nearest_context_baseline(&name, &context, &target)?,
            });
        }
        self.scores = scores;
        let mean = |value: fn(&HeldOutScores) -> f64| {
            self.scores.iter().map(value).sum::<f64>() / self.scores.len() as f64
        };
        let (psnr, ssim) = (mean(|s| s.ours.psnr), mean(|s| s.ours.ssim));
        Ok(Some(Score { psnr, ssim, scenes: self.scores.len() }))
    }
}

/// The views of a held-out scene that a model is shown and those that it is asked for, always the same: as many as in
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
