//! Training step, and the state that it changes.

use super::gradients::{ForwardBackward, ModelReplica, gradients_in_parallel};
use super::is_due;
use super::schedule::{learning_rate, parameter_groups, stage_at, subsets};
use super::step::{StepReport, StepSums, preview, to_summed_tensor};
use crate::config::{Config, changed_keys};
use crate::data::{BadData, BadSceneReport, Batch, BatchShard, DataLoader, SceneGroups};
use crate::device::Stopwatch;
use crate::distributed::ProcessGroup;
use crate::error::{Error, Result};
use crate::loss::{Losses, PerceptualNetwork, StepFraction};
use crate::model::{GlobalSplat, Growth, Precision, Stage};
use crate::optim::Optimizer;
use crate::reconstruct::{Model, ModelFile};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tch::{Device, Kind, Tensor, nn, no_grad};

/// Name of the section of a step in which ranks wait for each other.
pub(crate) const COMMUNICATION: &str = "communication";

/// Model, optimizer and data of a run.
///
/// ```no_run
/// use globalsplat::config::Config;
/// use globalsplat::data::TrainingScenes;
/// use globalsplat::train::{Event, Resume, Trainer, run};
/// use std::sync::Arc;
///
/// # fn main() -> globalsplat::Result<()> {
/// let config = Config::read("configs/tiny.toml".as_ref(), &["train.steps=100".into()])?;
/// let scenes = Arc::new(TrainingScenes::find(&config.data.capture_paths()?)?);
/// let mut trainer = Trainer::new(&config, scenes, tch::Device::Cpu)?;
/// // The folder gets the checkpoints and the logs; training resumes from its newest checkpoint.
/// let outcome = run(&mut trainer, "runs/tiny".as_ref(), &Resume::Auto, None, |event| {
///     if let Event::Step { report, .. } = event {
///         println!("step {}: {:.2} dB", report.step, report.psnr());
///     }
///     // `false` would save a checkpoint and stop.
///     true
/// })?;
/// println!("{}", outcome.checkpoint.display());
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Trainer {
    pub(super) config: Config,
    pub(super) vs: nn::VarStore,
    pub(super) model: GlobalSplat,
    /// Copies of the model for additional threads, created when they are first needed.
    pub(super) replicas: Vec<ModelReplica>,
    pub(super) optimizer: Optimizer,
    pub(super) perceptual: Option<PerceptualNetwork>,
    /// File that has the initial weights, if they aren't drawn at random.
    weights: Option<PathBuf>,
    /// Number of steps done.
    pub(super) step: u64,
    /// Number of samples drawn, which is the position in the data.
    pub(super) samples: u64,
    scenes: Arc<dyn SceneGroups>,
    /// Loader of the samples, started by the first step that is done.
    loader: Option<DataLoader>,
    /// Process group of the ranks that make every step together, each with its own samples.
    pub(super) group: ProcessGroup,
}

impl Trainer {
    /// Creates a trainer with initial weights drawn from the configuration's seed. It trains on `scenes`, but never on held-out views.
    ///
    /// # Errors
    /// Returns an error if the model can't be built, or if the weights of the perceptual loss are missing.
    pub fn new(config: &Config, scenes: Arc<dyn SceneGroups>, device: Device) -> Result<Self> {
        let perceptual = PerceptualNetwork::from_config(&config.loss, config.data.image_size, device)?
            .map(|network| network.with_precision(config.train.precision));
        tch::manual_seed(config.train.seed as i64);
        let vs = nn::VarStore::new(device);
        let mut model = GlobalSplat::new(&vs.root(), &config.model)?;
        model.set_precision(config.train.precision);
        let optimizer = Optimizer::new(parameter_groups(&vs, &config.train));
        Ok(Trainer {
            config: config.clone(),
            vs,
            model,
            replicas: vec![],
            optimizer,
            perceptual,
            weights: None,
            step: 0,
            samples: 0,
            scenes,
            loader: None,
            group: ProcessGroup::single(),
        })
    }

    /// Makes this trainer a rank of `group`. `train.batch_size` is the batch size of each rank. A step equals that of a single process with
    /// the samples of all ranks.
    pub fn with_group(self, group: ProcessGroup) -> Self {
        Trainer { group, ..self }
    }

    /// Makes [`run`](super::run) start from the weights in the file `path`, which [`ModelFile`] reads, if it has no checkpoint yet. They
    /// may be those of a smaller model: with larger patches, whose edge is a multiple of this model's, or with fewer scene tokens, of whose
    /// number this model's is a multiple. The curriculum is switched to full capacity from the first step on, because weights that were
    /// trained to the last stage don't fit the first stage any more.
    pub fn with_weights(mut self, path: &Path) -> Self {
        self.config.curriculum.full_capacity = true;
        Trainer { weights: Some(path.into()), ..self }
    }

    /// Loads the initial weights of the run, if they come from a file.
    ///
    /// # Errors
    /// Returns an error if the file can't be read, or if its model has another shape. The error names the keys that differ.
    pub(super) fn load_initial_weights(&mut self) -> Result<()> {
        let Some(path) = &self.weights else { return Ok(()) };
        let file = ModelFile::open(path, &[])?;
        let (ours, mut theirs) = (self.config.model.clone(), file.config.model.clone());
        if file.assumed.is_some() {
            // The number of heads can't be inferred from shapes.
            theirs.heads = ours.heads;
        }
        let growth = Growth::from_configs(&theirs, &ours);
        let [found, expected] =
            [growth.result(), ours.clone()].map(|model| Config { model, ..Default::default() });
        let changed = changed_keys(&found.to_toml(), &expected.to_toml());
        if !changed.is_empty() {
            let expected = "the model that the configuration describes";
            return Err(Error::input(path, "the model", changed.join(", "), expected));
        }
        if theirs == ours {
            return file.load_into(&self.vs);
        }
        let mut smaller = nn::VarStore::new(self.vs.device());
        GlobalSplat::uninitialized(&mut smaller, &theirs, Precision::F32)?;
        file.load_into(&smaller)?;
        let smaller = smaller.variables();
        no_grad(|| {
            for (name, mut variable) in self.vs.variables() {
                variable.copy_(&growth.convert(&name, &smaller[&name]));
            }
        });
        Ok(())
    }

    /// Draws a batch and updates the weights by its gradient. Calls `should_continue` once; the report says whether it returned `true` on
    /// all ranks.
    ///
    /// # Errors
    /// Returns an error if loading or rendering fails, or if another rank is gone.
    pub fn step(&mut self, should_continue: &mut dyn FnMut() -> bool) -> Result<StepReport> {
        let (batch, device) = (self.config.train.batch_size, self.vs.device());
        let sample = self.loader()?.next_batch(batch, device)?;
        self.samples += self.batch();
        let stage = stage_at(&self.config.curriculum, self.step);
        let picture = (self.group.is_main_process() && is_due(self.config.train.log_images_every, self.step))
            .then(|| preview(&self.model, &sample, stage))
            .transpose()?;
        Ok(StepReport { picture, ..self.train_step(&sample, &mut Stopwatch::default(), should_continue)? })
    }

    /// Returns the number of samples in a step, on all ranks together.
    pub fn batch(&self) -> u64 {
        self.batch_shard().global_batch_size()
    }

    fn batch_shard(&self) -> BatchShard {
        BatchShard {
            batch_size: self.config.train.batch_size,
            rank: self.group.rank(),
            world_size: self.group.world_size(),
        }
    }

    /// Computes the loss and gradient of `sample`, which isn't paired yet, and updates the weights. Records the time of each section of the
    /// step in `stopwatch`.
    pub(crate) fn train_step(
        &mut self,
        sample: &Batch,
        stopwatch: &mut Stopwatch,
        should_continue: &mut dyn FnMut() -> bool,
    ) -> Result<StepReport> {
        let stage = stage_at(&self.config.curriculum, self.step);
        let learning_rate = learning_rate(&self.config.train, self.step);
        let losses = self.gradients(sample, stage, stopwatch)?;
        let sums = match self.group.world_size() {
            1 => self.all_reduce(losses, should_continue)?,
            _ => stopwatch.time(COMMUNICATION, || self.all_reduce(losses, should_continue))?,
        };
        // The GPU is still busy with this step. The next samples are copied meanwhile.
        if let (Some(loader), device @ Device::Cuda(_)) = (&mut self.loader, self.vs.device()) {
            loader.prefetch_to_device(self.config.train.batch_size, device);
        }
        let (sums, skipped) = stopwatch.time("optimizer", || -> Result<_> {
            let sums = StepSums::from_tensors(&sums, &self.optimizer.gradient_norm()?);
            let skipped = !(sums.losses.total.is_finite() && sums.gradient_norm.is_finite());
            if !skipped {
                self.optimizer.clip_gradients(sums.gradient_norm, self.config.train.gradient_clip)?;
                self.optimizer.set_learning_rate(learning_rate);
                self.optimizer.step()?;
            }
            Ok((sums, skipped))
        })?;
        if !sums.has_equal_gradients(self.group.world_size()) {
            return Err(Error::failed(
                "ranks have different parameters: were they started with the same program?",
            ));
        }
        if sums.has_bad_data {
            self.exchange_bad_data()?;
        }
        let scenes = match skipped {
            true => self.group.all_gather_object(sample.names.clone())?.concat(),
            false => sample.names.clone(),
        };
        let report = StepReport {
            step: self.step,
            stage,
            learning_rate,
            losses: sums.losses,
            gradient_norm: sums.gradient_norm,
            skipped,
            scenes,
            picture: None,
            should_continue: !sums.is_asked_to_stop,
        };
        self.step += 1;
        Ok(report)
    }

    /// Sums the gradients over all ranks. Returns the sums of the tensors of [`to_summed_tensor`].
    fn all_reduce(&self, losses: Tensor, should_continue: &mut dyn FnMut() -> bool) -> Result<Tensor> {
        let gradients = self.add_gradients_up()?;
        let is_asked_to_stop = !should_continue();
        let has_bad_data =
            self.loader.as_ref().is_some_and(|loader| loader.bad_data_log().has_bad_scene_reports());
        let sums = to_summed_tensor(losses, is_asked_to_stop, has_bad_data, gradients);
        self.group.all_reduce(&sums)?;
        Ok(sums)
    }

    /// Exchanges the bad data that the ranks found, so that every rank counts all of it.
    fn exchange_bad_data(&self) -> Result<()> {
        let Some(log) = self.loader.as_ref().map(DataLoader::bad_data_log) else { return Ok(()) };
        if self.group.world_size() > 1 {
            let reports: Vec<Vec<BadSceneReport>> =
                self.group.all_gather_object(log.take_bad_scene_reports())?;
            let others = reports.into_iter().enumerate().filter(|(rank, _)| *rank != self.group.rank());
            others.flat_map(|(_, reports)| reports).try_for_each(|report| log.record_report(report))?;
        }
        Ok(())
    }

    /// Sums the gradients over all ranks, and returns their number.
    pub(crate) fn add_gradients_up(&self) -> Result<usize> {
        self.group.all_reduce_gradients(&self.vs.trainable_variables())
    }

    /// Returns the size of the gradients that the last step left, in bytes.
    pub(crate) fn gradient_bytes(&self) -> u64 {
        self.optimizer.gradients().map(|(_, t)| (t.numel() * t.kind().elt_size_in_bytes()) as u64).sum()
    }

    /// Copies the state of the first rank to all ranks: its weights, moments, step and position in the data.
    ///
    /// # Errors
    /// Returns an error if this rank's configuration or scenes differ from the first rank's, or if another rank is gone.
    pub(crate) fn broadcast_state(&mut self) -> Result<()> {
        self.check_same_as_first_rank()?;
        let position =
            self.group.is_main_process().then(|| (self.step, self.samples, self.optimizer.steps()));
        let (step, samples, updates) = self.group.broadcast_object(position)?;
        (self.step, self.samples) = (step, samples);
        self.optimizer.set_steps(updates);
        // Variables that aren't trained are copied, too.
        let variables: BTreeMap<String, Tensor> = self.vs.variables().into_iter().collect();
        let moments = self.optimizer.moments();
        variables.values().chain(moments).try_for_each(|t| self.group.broadcast(t))?;
        Ok(())
    }

    /// Checks that this rank has the configuration and scenes of the first one. The locations of the data may differ between machines.
    fn check_same_as_first_rank(&self) -> Result<()> {
        let own = (self.config.to_toml(), self.scenes.sizes());
        let (config, scenes) =
            self.group.broadcast_object(self.group.is_main_process().then(|| own.clone()))?;
        let mut changed = changed_keys(&config, &own.0);
        // A change has the form `key first → own`.
        changed.retain(|change| {
            !["data.captures ", "data.validation "].iter().any(|key| change.starts_with(key))
        });
        if !changed.is_empty() {
            let changed = changed.join(", ");
            return Err(Error::failed(format!(
                "this rank's configuration differs from the first rank's: {changed}"
            )));
        }
        if scenes != own.1 {
            let count = |sizes: &[usize]| sizes.iter().sum::<usize>();
            let (own, first) = (count(&own.1), count(&scenes));
            return Err(Error::failed(format!(
                "this rank's training scenes differ from the first rank's: {own} of {} groups, expected {first} of {}",
                self.scenes.sizes().len(),
                scenes.len()
            )));
        }
        Ok(())
    }

    /// Computes the gradient of the sample's loss, stores it in the variables, and returns the loss, packed.
    pub(super) fn gradients(
        &mut self,
        sample: &Batch,
        stage: Stage,
        stopwatch: &mut Stopwatch,
    ) -> Result<Tensor> {
        let pair = self.config.loss.has_consistency() && sample.context_views() >= 2;
        let halves = pair.then(|| subsets(sample.context_views(), self.step));
        let scenes = sample.scenes();
        let at_once = self.slices_at_once(scenes);
        while self.replicas.len() + 1 < at_once {
            self.replicas.push(ModelReplica::new(&self.model, &self.vs)?);
        }
        let perceptual = self.perceptual.as_ref();
        let group = &self.group;
        let part = ForwardBackward { config: &self.config, model: &self.model, perceptual, stage, group };
        let count = match self.config.train.micro_batch {
            0 => scenes.div_ceil(at_once),
            count => count,
        };
        let slice = |first: usize| {
            let slice = sample.slice(first, count);
            match &halves {
                Some(halves) => slice.paired(halves),
                None => slice,
            }
        };
        let share = |first: usize| StepFraction {
            scenes: count.min(scenes - first) as f64 / (scenes * group.world_size()) as f64,
            ..StepFraction::WHOLE
        };
        let firsts = (0..scenes).step_by(count);
        if at_once > 1 {
            stopwatch.time("zero gradients", || self.optimizer.zero_grad());
            let slices =
                stopwatch.time("data", || firsts.map(|first| (slice(first), share(first))).collect());
            return gradients_in_parallel(&part, &mut self.replicas, slices, stopwatch);
        }
        let mut depth_pixels = None;
        if pair && self.config.loss.consistency_depth > 0. && count < scenes {
            let pixels = firsts.clone().map(|first| {
                let slice = stopwatch.time("data", || slice(first));
                stopwatch.time("depth pixels", || part.depth_pixels(&slice))
            });
            let pixels = Tensor::stack(&pixels.collect::<Result<Vec<_>>>()?, 0).sum(None::<Kind>);
            group.all_reduce(&pixels)?;
            depth_pixels = Some(pixels);
        }
        stopwatch.time("zero gradients", || self.optimizer.zero_grad());
        let mut losses = Tensor::zeros([Losses::COUNT as i64], (Kind::Double, self.vs.device()));
        for first in firsts {
            let depth_pixels = depth_pixels.as_ref().map(Tensor::shallow_clone);
            let slice = stopwatch.time("data", || slice(first));
            losses += part.gradients(&slice, &StepFraction { depth_pixels, ..share(first) }, stopwatch)?;
        }
        Ok(losses)
    }

    /// Returns the number of slices of a step of `scenes` scenes that are computed in parallel. It is more than 1 only on the CPU: one
    /// slice keeps a GPU busy. Steps with a perceptual loss stay whole because its network has operations that are large enough to be split
    /// among threads, and steps with a depth loss because depths are compared over all scenes. Several ranks already run in parallel.
    pub(crate) fn slices_at_once(&self, scenes: usize) -> usize {
        let apart = self.vs.device() == Device::Cpu
            && self.group.world_size() == 1
            && self.config.train.micro_batch == 0
            && self.perceptual.is_none()
            && self.config.loss.consistency_depth == 0.;
        // The smallest number of slices, each with at least one thread, for which the largest slice has as few scenes as possible.
        if apart { scenes.div_ceil(scenes.div_ceil(tch::get_num_threads() as usize)) } else { 1 }
    }

    /// Returns the loader at the position of the next step's samples. Starts a new one if necessary.
    fn loader(&mut self) -> Result<&mut DataLoader> {
        let first = self.samples;
        let loader = match self.loader.take() {
            // The first samples of a step may belong to another rank.
            Some(loader) if loader.position() == self.batch_shard().sample(first, 0) => loader,
            _ => {
                let mut config = self.config.data.clone();
                if config.threads == 0 {
                    let cores = std::thread::available_parallelism().map_or(1, usize::from);
                    config.threads = (cores / self.group.local_world_size()).max(1);
                }
                let (seed, scenes) = (self.config.train.seed, self.scenes.clone());
                DataLoader::start(&config, seed, scenes, self.batch_shard(), first)?
            }
        };
        Ok(self.loader.insert(loader))
    }

    /// Takes back the last `steps` steps. All of them were skipped, so only the step and the position in the data have changed.
    pub(super) fn rewind(&mut self, steps: u64) {
        self.step -= steps;
        self.samples -= steps * self.batch();
    }

    /// Returns the scenes that were skipped since the run was started or resumed.
    pub fn bad_data(&self) -> BadData {
        self.loader.as_ref().map(DataLoader::bad_data).unwrap_or_default()
    }

    /// Returns the group of ranks that train together.
    pub fn group(&self) -> &ProcessGroup {
        &self.group
    }

    /// Returns the stage that the weights were trained to: that of the last step, or the final stage once all steps are done (spec 8.7).
    pub fn stage(&self) -> Stage {
        match self.step < self.config.train.steps {
            true => stage_at(&self.config.curriculum, self.step.saturating_sub(1)),
            false => self.config.curriculum.final_stage(),
        }
    }

    /// Returns the model in its current state, for reconstruction.
    pub fn as_model(&self) -> Model<'_> {
        let stage = self.stage();
        let (network, config, device) = (&self.model, &self.config, self.vs.device());
        Model { network, config, stage, device }
    }
}
