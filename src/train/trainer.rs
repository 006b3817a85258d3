//! One training step, and the state that steps change.

use super::optimizer::AdamW;
use super::schedule::learning_rate;
use super::{stage_at, subsets};
use crate::config::Config;
use crate::data::{Capture, Sampler, View};
use crate::error::Result;
use crate::loss::{PerceptualLoss, losses};
use crate::model::{GlobalSplat, Stage};
use crate::render::{Cameras, DEFAULT_EPS2D, render};
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
    sampler: Sampler,
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
    /// Fresh weights by the configuration's seed. The captures' views that aren't held out are read into memory.
    ///
    /// # Errors
    /// Images that can't be read, too few views, or no weights for the perceptual loss.
    pub fn new(config: &Config, captures: &[Capture], device: Device) -> Result<Self> {
        let perceptual = PerceptualLoss::load(&config.loss, config.data.image_size, device)?;
        let training_views = |capture: &Capture| -> Result<Vec<View>> {
            let (shown, _) = config.data.holdout.split(capture.len());
            capture.load(&shown, Some(config.data.image_size))
        };
        let views = captures.iter().map(training_views).collect::<Result<Vec<_>>>()?;
        let sampler =
            Sampler::new(views, config.data.context_views, config.data.target_views, config.train.seed)?;
        tch::manual_seed(config.train.seed as i64);
        let vs = nn::VarStore::new(device);
        let model = GlobalSplat::new(&vs.root(), &config.model)?;
        let optimizer = AdamW::new(&vs, config.train.weight_decay);
        Ok(Trainer { config: config.clone(), vs, model, optimizer, perceptual, step: 0, sampler })
    }

    /// Draws a sample, renders what the model makes of it, and follows the gradient.
    ///
    /// # Errors
    /// A sample or a picture that can't be made.
    pub fn step(&mut self) -> Result<StepReport> {
        let config = &self.config;
        let stage = stage_at(&config.curriculum, self.step);
        let learning_rate = learning_rate(&config.train, self.step);
        let mut sample = self.sampler.sample(self.step, config.train.batch, self.vs.device())?;
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

    /// The model as it is now.
    pub fn model(&self) -> &GlobalSplat {
        &self.model
    }

    /// Where the weights are.
    pub fn device(&self) -> Device {
        self.vs.device()
    }
}
