//! One training step, and the state that steps change.

use super::optimizer::AdamW;
use super::schedule::learning_rate;
use super::{stage_at, subsets};
use crate::config::Config;
use crate::data::{BadData, Loader, SceneGroups};
use crate::error::Result;
use crate::loss::{PerceptualLoss, losses};
use crate::model::{GlobalSplat, Stage};
use crate::render::{Cameras, DEFAULT_EPS2D, render};
use std::sync::Arc;
use tch::{Device, nn};

/// Model, optimizer and data of a run.
#[derive(Debug)]
pub struct Trainer {
    pub(super) config: Config,
    pub(super) vs: nn::VarStore,
    pub(super) model: GlobalSplat,
    pub(super) optimizer: AdamW,
    perceptual: Option<PerceptualLoss>,
    /// Steps done.
    pub(super) step: u64,
    scenes: Arc<dyn SceneGroups>,
    /// Begins with the first step that is done, wherever that is.
    loader: Option<Loader>,
}

/// What a step did.
#[derive(Debug, Clone, Copy)]
pub struct StepReport {
    /// Counted from 0.
    pub step: u64,
    /// Where the curriculum stood.
    pub stage: Stage,
    /// The learning rate used.
    pub learning_rate: f64,
    /// The weighted sum.
    pub loss: f64,
    /// Mean squared error of colours.
    pub mse: f64,
    /// L_perc before its factor; 0 where it is left out.
    pub perceptual: f64,
    /// L_con with its factors; 0 without subsets.
    pub consistency: f64,
    /// L_fru before its factor.
    pub frustum: f64,
    /// L_dec before its factor.
    pub decoder: f64,
    /// Of the gradient, before clipping.
    pub gradient_norm: f64,
    /// Loss or gradient wasn't finite, so nothing was changed.
    pub skipped: bool,
}

impl Trainer {
    /// Fresh weights by the configuration's seed. `scenes` are what is learned; views held out aren't shown.
    ///
    /// # Errors
    /// A model that can't be built, or no weights for the perceptual loss.
    pub fn new(config: &Config, scenes: Arc<dyn SceneGroups>, device: Device) -> Result<Self> {
        let perceptual = PerceptualLoss::load(&config.loss, config.data.image_size, device)?;
        tch::manual_seed(config.train.seed as i64);
        let vs = nn::VarStore::new(device);
        let model = GlobalSplat::new(&vs.root(), &config.model)?;
        let optimizer = AdamW::new(&vs, config.train.weight_decay);
        let config = config.clone();
        Ok(Trainer { config, vs, model, optimizer, perceptual, step: 0, scenes, loader: None })
    }

    /// Draws a sample, renders what the model makes of it, and follows the gradient.
    ///
    /// # Errors
    /// A sample or a picture that can't be made.
    pub fn step(&mut self) -> Result<StepReport> {
        let config = &self.config;
        let stage = stage_at(&config.curriculum, self.step);
        let learning_rate = learning_rate(&config.train, self.step);
        let (batch, device) = (config.train.batch, self.vs.device());
        let mut sample = self.loader()?.next_batch(batch, device)?;
        let config = &self.config;
        if config.loss.has_consistency() && sample.context_views() >= 2 {
            sample = sample.paired(&subsets(sample.context_views(), self.step));
        }

        let context = &sample.context;
        let decoded = self.model.forward(&context.images, &context.c2w, &context.intrinsics, stage);
        let pictures = render(&decoded.gaussians, &Cameras::of(&sample.target), DEFAULT_EPS2D)?;
        let losses = losses(&config.loss, self.perceptual.as_ref(), &sample, &decoded, &pictures);
        let loss = losses.total.double_value(&[]);

        self.optimizer.zero_grad();
        losses.total.backward();
        let gradient_norm = self.optimizer.clip_gradients(config.train.gradient_clip);
        let skipped = !(loss.is_finite() && gradient_norm.is_finite());
        if !skipped {
            self.optimizer.step(learning_rate);
        }
        let report = StepReport {
            step: self.step,
            stage,
            learning_rate,
            loss,
            mse: losses.mse.double_value(&[]),
            perceptual: losses.perceptual.double_value(&[]),
            consistency: losses.consistency.double_value(&[]),
            frustum: losses.frustum.double_value(&[]),
            decoder: losses.decoder.double_value(&[]),
            gradient_norm,
            skipped,
        };
        self.step += 1;
        Ok(report)
    }

    /// Where the next step's samples come from.
    fn loader(&mut self) -> Result<&mut Loader> {
        let first = self.step * self.config.train.batch as u64;
        let loader = match self.loader.take() {
            Some(loader) if loader.position() == first => loader,
            _ => Loader::start(&self.config.data, self.config.train.seed, self.scenes.clone(), first)?,
        };
        Ok(self.loader.insert(loader))
    }

    /// Scenes that were skipped since the run was begun or resumed.
    pub fn bad_data(&self) -> BadData {
        self.loader.as_ref().map(Loader::bad_data).unwrap_or_default()
    }

    /// The model as it is now.
    pub fn model(&self) -> &GlobalSplat {
        &self.model
    }

    /// Where the weights are.
    pub fn device(&self) -> Device {
        self.vs.device()
    }
}
