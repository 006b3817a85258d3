//! One training step, and the state that steps change.

use super::curriculum::stage_at;
use super::forward_backward::ForwardBackward;
use super::is_due;
use super::parameter_groups::parameter_groups;
use super::preview::preview;
use super::schedule::learning_rate;
use super::step_report::StepReport;
use super::subsets::subsets;
use crate::config::{Config, changed_keys};
use crate::data::{BadData, Loader, Sample, SceneGroups};
use crate::error::{Error, Result};
use crate::loss::{Losses, PerceptualLoss, Share};
use crate::model::{GlobalSplat, Stage};
use crate::optim::{AdamW, Stopwatch};
use crate::reconstruct::{Input, Model, ModelFile};
use std::path::Path;
use std::sync::Arc;
use tch::{Device, Kind, Tensor, nn};

/// Model, optimizer and data of a run.
#[derive(Debug)]
pub struct Trainer {
    pub(super) config: Config,
    pub(super) vs: nn::VarStore,
    pub(super) model: GlobalSplat,
    pub(super) optimizer: AdamW,
    pub(super) perceptual: Option<PerceptualLoss>,
    /// Steps done.
    pub(super) step: u64,
    /// Samples drawn: the position in the data.
    pub(super) samples: u64,
    scenes: Arc<dyn SceneGroups>,
    /// Begins with the first step that is done, wherever that is.
    loader: Option<Loader>,
}

impl Trainer {
    /// Fresh weights by the configuration's seed. `scenes` are what is learned; views held out aren't shown.
    ///
    /// # Errors
    /// A model that can't be built, or no weights for the perceptual loss.
    pub fn new(config: &Config, scenes: Arc<dyn SceneGroups>, device: Device) -> Result<Self> {
        let perceptual = PerceptualLoss::load(&config.loss, config.data.image_size, device)?
            .map(|network| network.with_precision(config.train.precision));
        tch::manual_seed(config.train.seed as i64);
        let vs = nn::VarStore::new(device);
        let mut model = GlobalSplat::new(&vs.root(), &config.model)?;
        model.set_precision(config.train.precision);
        let optimizer = AdamW::new(parameter_groups(&vs, &config.train));
        let config = config.clone();
        Ok(Trainer { config, vs, model, optimizer, perceptual, step: 0, samples: 0, scenes, loader: None })
    }

    /// Takes the weights in a file that [`ModelFile`] reads in place of the fresh ones. All Gaussians are shown from
    /// the first step on: weights that were trained to the last stage know nothing of the first any more.
    ///
    /// # Errors
    /// A file that can't be read, or whose model has another shape: its keys are named.
    pub fn begin_with(&mut self, path: &Path) -> Result<()> {
        let file = ModelFile::open(path, &[])?;
        if file.assumed.is_none() {
            let ours = Config { model: self.config.model.clone(), ..Default::default() };
            let theirs = Config { model: file.config.model.clone(), ..Default::default() };
            let changed = changed_keys(&theirs.to_toml(), &ours.to_toml());
            if !changed.is_empty() {
                let expected = "the model that the configuration describes";
                return Err(Error::input(path, "the model", changed.join(", "), expected));
            }
        }
        self.config.curriculum.full_capacity = true;
        file.load_into(&self.vs)
    }

    /// Draws a sample and follows its gradient.
    ///
    /// # Errors
    /// A sample or a picture that can't be made.
    pub fn step(&mut self) -> Result<StepReport> {
        let (batch, device) = (self.config.train.batch, self.vs.device());
        let sample = self.loader()?.next_batch(batch, device)?;
        self.samples += batch as u64;
        let stage = stage_at(&self.config.curriculum, self.step);
        let picture = is_due(self.config.train.pictures_every, self.step)
            .then(|| preview(&self.model, &sample, stage))
            .transpose()?;
        Ok(StepReport { picture, ..self.learn(&sample, &mut Stopwatch::default())? })
    }

    /// Renders what the model makes of `sample`, which isn't paired yet, and follows the gradient. `watch` hears of
    /// every part of the step.
    ///
    /// # Errors
    /// A picture that can't be made.
    pub(crate) fn learn(&mut self, sample: &Sample, watch: &mut Stopwatch) -> Result<StepReport> {
        let stage = stage_at(&self.config.curriculum, self.step);
        let learning_rate = learning_rate(&self.config.train, self.step);
        let losses = self.gradients(sample, stage, watch)?;
        // A GPU is still busy with that, and the next samples are on their way when it is done.
        if let (Some(loader), device @ Device::Cuda(_)) = (&mut self.loader, self.vs.device()) {
            loader.send_ahead(self.config.train.batch, device);
        }
        let (losses, gradient_norm, skipped) = watch.time("optimizer", || {
            let (losses, gradient_norm) = read(&losses, &self.optimizer.gradient_norm());
            let skipped = !(losses.total.is_finite() && gradient_norm.is_finite());
            if !skipped {
                self.optimizer.clip_gradients(gradient_norm, self.config.train.gradient_clip);
                self.optimizer.set_learning_rate(learning_rate);
                self.optimizer.step();
            }
            (losses, gradient_norm, skipped)
        });
        let report = StepReport {
            step: self.step,
            stage,
            learning_rate,
            losses,
            gradient_norm,
            skipped,
            scenes: sample.names.clone(),
            picture: None,
        };
        self.step += 1;
        Ok(report)
    }

    /// Leaves the gradient of the sample's loss in the variables, and returns the loss, packed.
    pub(super) fn gradients(
        &mut self,
        sample: &Sample,
        stage: Stage,
        watch: &mut Stopwatch,
    ) -> Result<Tensor> {
        let perceptual = self.perceptual.as_ref();
        let part = ForwardBackward { config: &self.config, model: &self.model, perceptual, stage };
        let pair = self.config.loss.has_consistency() && sample.context_views() >= 2;
        let halves = pair.then(|| subsets(sample.context_views(), self.step));
        let scenes = sample.scenes();
        let count = match self.config.train.micro_batch {
            0 => scenes,
            count => count,
        };
        let slice = |first: usize| {
            let slice = sample.slice(first, count);
            match &halves {
                Some(halves) => slice.paired(halves),
                None => slice,
            }
        };
        let mut share = Share::WHOLE;
        if pair && self.config.loss.consistency_depth > 0. && count < scenes {
            let pixels = (0..scenes).step_by(count).map(|first| {
                let slice = watch.time("data", || slice(first));
                watch.time("depth pixels", || part.depth_pixels(&slice))
            });
            share.depth_pixels =
                Some(Tensor::stack(&pixels.collect::<Result<Vec<_>>>()?, 0).sum(None::<Kind>));
        }
        watch.time("zero gradients", || self.optimizer.zero_grad());
        let mut losses = Tensor::zeros([Losses::COUNT as i64], (Kind::Double, self.vs.device()));
        for first in (0..scenes).step_by(count) {
            share.scenes = count.min(scenes - first) as f64 / scenes as f64;
            let slice = watch.time("data", || slice(first));
            losses += part.gradients(&slice, &share, watch)?;
        }
        Ok(losses)
    }

    /// Where the next step's samples come from.
    fn loader(&mut self) -> Result<&mut Loader> {
        let first = self.samples;
        let loader = match self.loader.take() {
            Some(loader) if loader.position() == first => loader,
            _ => Loader::start(
                &self.config.data,
                self.config.train.seed,
                self.scenes.clone(),
                self.config.train.batch,
                first,
            )?,
        };
        Ok(self.loader.insert(loader))
    }

    /// Takes back the last `steps` steps, which were all skipped and so changed nothing but where the run stands.
    pub(super) fn take_back(&mut self, steps: u64) {
        self.step -= steps;
        self.samples -= steps * self.config.train.batch as u64;
    }

    /// Scenes that were skipped since the run was begun or resumed.
    pub fn bad_data(&self) -> BadData {
        self.loader.as_ref().map(Loader::bad_data).unwrap_or_default()
    }

    /// What it was made from.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The model as it is now.
    pub fn model(&self) -> &GlobalSplat {
        &self.model
    }

    /// The stage that the weights were trained to: that of the last step, or, once all are done, the final one (spec 8.7).
    pub fn stage(&self) -> Stage {
        match self.step < self.config.train.steps {
            true => stage_at(&self.config.curriculum, self.step.saturating_sub(1)),
            false => self.config.curriculum.final_stage(),
        }
    }

    /// Where the weights are.
    pub fn device(&self) -> Device {
        self.vs.device()
    }

    /// The model as it is now, to reconstruct with.
    pub fn as_model(&self) -> Model<'_> {
        let stage = self.stage();
        let (network, config, device) = (&self.model, &self.config, self.vs.device());
        Model { network, config, stage, device, input: Input::PLAIN }
    }
}

/// A step's packed losses and its gradient's norm, a scalar, as numbers. They come from a GPU together, as each time it is waited for
/// until all that it was given is done: this is the only one of a step.
fn read(losses: &Tensor, gradient_norm: &Tensor) -> (Losses<f64>, f64) {
    let both = Tensor::cat(&[losses, &gradient_norm.to_kind(Kind::Double).view([1])], 0);
    let numbers = Vec::<f64>::try_from(both.to_device(Device::Cpu)).expect("float64");
    let (losses, norm) = numbers.split_first_chunk().expect("all terms");
    (Losses::unpacked(losses), norm[0])
}
