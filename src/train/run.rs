//! Training run, from its current state to the last step, with checkpoints on the way.

use super::checkpoint::{
    Validation, add_checkpoints, best_score, check, keep_best, latest_checkpoint, list_checkpoints, lock,
    prune_checkpoints, remove_incomplete,
};
use super::event::Event;
use super::is_due;
use super::logs::RunLog;
use super::step::{Score, StepReport};
use super::trainer::Trainer;
use super::{CONFIG_FILE, METRICS_FILE};
use crate::config::{TrainConfig, changed_keys};
use crate::distributed::is_communication_error;
use crate::error::{Error, Result};
use crate::io::{FolderLock, InputFiles, event_files, write_file};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Starting point of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Resume {
    /// Newest complete checkpoint of the run, or step 0 if the run has no checkpoints.
    Auto,
    /// Step 0. A run that has checkpoints is an error.
    Never,
    /// Checkpoint in the given folder.
    From(PathBuf),
}

/// Result of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// Last checkpoint.
    pub checkpoint: PathBuf,
    /// `true` if all steps are done; `false` if the run was stopped.
    pub complete: bool,
    /// Number of steps that were skipped because loss or gradient wasn't finite.
    pub skipped: u64,
}

/// Evaluation of a model on data that training doesn't use.
pub trait Validator {
    /// Returns the number of scenes. Ranks compare it to check that they evaluate the same scenes.
    fn scenes(&self) -> usize;

    /// Returns the score of the model as it is now, or `None` if `should_continue`, which is called at intervals, returns `false`.
    ///
    /// # Errors
    /// Returns an error if no scene can be used, or if the evaluation fails.
    fn validate(
        &mut self,
        trainer: &Trainer,
        should_continue: &mut dyn FnMut() -> bool,
    ) -> Result<Option<Score>>;
}

/// Trains into the folder `out`, which no other process may use for training at the same time. `on_event` is called with every event and
/// returns whether to continue. If it returns `false`, the run saves a checkpoint and stops. `validator` scores the model at intervals and
/// at the end.
///
/// If several ranks train together, all of them call this. The first rank reads and writes `out`, and the others take over its state.
///
/// # Errors
/// Returns an error if another process uses the run, a checkpoint doesn't fit, too many steps in a row were skipped, another rank is gone,
/// or a step or a write fails. If a validation fails, it is left out.
pub fn run(
    trainer: &mut Trainer,
    out: &Path,
    resume: &Resume,
    validator: Option<&mut dyn Validator>,
    mut on_event: impl FnMut(Event) -> bool,
) -> Result<Outcome> {
    let is_main = trainer.group.is_main_process();
    let opened = is_main.then(|| RunLogger::open(trainer, out, resume, &mut on_event)).transpose()?;
    trainer.broadcast_state()?;
    let held_out = validator.as_ref().map_or(0, |validator| validator.scenes());
    let (logger, start) =
        opened.map(|(logger, validated, saved)| (logger, (held_out, validated, saved))).unzip();
    let (expected, validated, saved) = trainer.group.broadcast_object(start)?;
    if held_out != expected {
        return Err(Error::failed(format!(
            "this rank has {held_out} held-out scenes, expected {expected}, as the first one"
        )));
    }
    Run { trainer, out, validator, on_event, logger, validated, asked_to_stop: false }.train(saved)
}

/// Adds the files of the run in the folder `run` to `inputs`: its checkpoints, and the files beside them.
pub fn add_run_inputs(run: &Path, inputs: &mut InputFiles) {
    add_checkpoints(run, inputs);
    event_files(run).iter().for_each(|file| inputs.add(file));
    [CONFIG_FILE, METRICS_FILE].iter().for_each(|file| inputs.add(&run.join(file)));
}

/// Checks that a run may write into `out`: it has done so before, or the folder has no other files of the names that a run uses.
fn check_output_folder(out: &Path) -> Result<()> {
    if FolderLock::was_ever_taken(out) || !list_checkpoints(out)?.is_empty() {
        return Ok(());
    }
    match [CONFIG_FILE, METRICS_FILE].into_iter().find(|name| out.join(name).exists()) {
        Some(name) => {
            let expected = "a folder of its own (choose another --out)";
            Err(Error::input(
                out,
                "the run's folder",
                format!("one with a {name} that no run wrote"),
                expected,
            ))
        }
        None => Ok(()),
    }
}

/// Files that a run writes beside its checkpoints.
struct RunLogger {
    _lock: FolderLock,
    log: RunLog,
    /// PSNR of the best checkpoint, in dB.
    best: Option<f64>,
    /// Settings that validation scores depend on.
    settings: String,
}

impl RunLogger {
    /// Brings the trainer to the run's starting point, and opens the run's files. Also returns the step before the last validation that was
    /// logged, and the run's own checkpoint of this state.
    fn open(
        trainer: &mut Trainer,
        out: &Path,
        resume: &Resume,
        on_event: &mut impl FnMut(Event) -> bool,
    ) -> Result<(Self, Option<u64>, Option<PathBuf>)> {
        check_output_folder(out)?;
        let lock = lock(out)?;
        remove_incomplete(out)?;
        let saved = begin(trainer, out, resume, on_event)?;
        let config = out.join(CONFIG_FILE);
        let toml = trainer.config.to_toml();
        let changes = match std::fs::read_to_string(&config) {
            Ok(before) if trainer.step > 0 => changed_keys(&before, &toml),
            _ => vec![],
        };
        if !changes.is_empty() {
            let changes = changes.join(", ");
            on_event(Event::Notice(format!("resuming with a changed configuration: {changes}")));
        }
        write_file(&config, &toml)?;
        let (log, validated) = RunLog::open(out, trainer.step, trainer.config.train.log_every)?;
        let settings = trainer.config.data.validation_settings();
        let best = best_score(out, &settings).unwrap_or_else(|e| {
            on_event(Event::Notice(format!("{e}; the best checkpoint is determined again")));
            None
        });
        Ok((RunLogger { _lock: lock, log, best, settings }, validated, saved))
    }
}

/// State of a run in progress. All ranks take the same path through it.
struct Run<'a, 'v, O> {
    trainer: &'a mut Trainer,
    out: &'a Path,
    validator: Option<&'v mut dyn Validator>,
    on_event: O,
    /// Log files, which only the first rank has.
    logger: Option<RunLogger>,
    /// Step before the last validation that was logged.
    validated: Option<u64>,
    /// `true` if this rank was asked to stop. The other ranks learn of it with the next step.
    asked_to_stop: bool,
}

impl<O: FnMut(Event) -> bool> Run<'_, '_, O> {
    /// Trains until all steps are done or the run is stopped. `saved` is the run's own checkpoint of the current state, if there is one.
    fn train(mut self, mut saved: Option<PathBuf>) -> Result<Outcome> {
        let TrainConfig { steps, checkpoint_every, validate_every, max_nonfinite_steps, .. } =
            self.trainer.config.train;
        let batch = self.trainer.batch() as f64;
        let (mut skipped, mut should_continue) = (0, true);
        // Number of steps that were skipped since the last one that wasn't.
        let mut skipped_in_a_row = 0;
        while self.trainer.step < steps {
            let step = self.trainer.step;
            let validates = self.validator.is_some() && step > 0 && is_due(validate_every, step);
            if validates && skipped_in_a_row == 0 && self.validated != Some(step - 1) {
                let checkpoint = saved.take().map_or_else(|| self.save(), Ok)?;
                should_continue = match self.validate(&checkpoint) {
                    // A failed write or a lost rank isn't a problem of the held-out data.
                    Err(e) if e.is_failed_write() || is_communication_error(&e) => return Err(e),
                    Err(e) => self.emit(Event::Notice(format!("a validation is left out: {e}"))),
                    should_continue => should_continue?,
                };
                saved = Some(checkpoint);
            }
            if !should_continue {
                break;
            }

            let start = Instant::now();
            let Run { trainer, on_event, asked_to_stop, .. } = &mut self;
            let report = trainer.step(&mut || {
                *asked_to_stop |= !on_event(Event::Busy);
                !*asked_to_stop
            })?;
            let samples_per_second = batch / start.elapsed().as_secs_f64();
            saved = None;
            if let Some(logger) = &mut self.logger {
                logger.log.log_step(&report, samples_per_second)?;
            }
            should_continue =
                self.emit(Event::Step { report: &report, samples_per_second }) && report.should_continue;
            if report.skipped {
                skipped += 1;
                skipped_in_a_row += 1;
                if skipped_in_a_row == max_nonfinite_steps {
                    return Err(self.not_finite(skipped_in_a_row, &report));
                }
            } else {
                skipped_in_a_row = 0;
                if self.trainer.step.is_multiple_of(checkpoint_every) {
                    saved = Some(self.save()?);
                }
            }
            if !should_continue {
                break;
            }
        }
        let mut complete = self.trainer.step >= steps;
        // Skipped steps changed nothing, so this is the state before them. They are repeated when the run is resumed.
        self.trainer.rewind(skipped_in_a_row);
        let checkpoint = saved.map_or_else(|| self.save(), Ok)?;
        if self.logger.is_some() {
            // Retry to remove checkpoints that an earlier save couldn't remove.
            prune_checkpoints(self.out, &checkpoint, self.trainer.config.train.keep_checkpoints)?;
        }
        if complete && self.validator.is_some() {
            match self.validate(&checkpoint) {
                Err(e) if e.is_failed_write() || is_communication_error(&e) => return Err(e),
                Err(e) => {
                    self.emit(Event::Notice(format!("the last validation is left out: {e}")));
                }
                // If the validation was stopped before its end, the run isn't complete, and the same command repeats the validation.
                Ok(_) => complete = self.validated == Some(self.trainer.step.saturating_sub(1)),
            }
        }
        Ok(Outcome { checkpoint, complete, skipped })
    }

    /// Reports an event and returns whether to continue. If there are several ranks, always returns `true`: a request to stop reaches all
    /// ranks with the next step, so that they stop together.
    fn emit(&mut self, event: Event) -> bool {
        self.asked_to_stop |= !(self.on_event)(event);
        self.trainer.group.world_size() > 1 || !self.asked_to_stop
    }

    /// Saves a checkpoint on the first rank. Returns the checkpoint's folder on all ranks, even if it isn't written yet.
    fn save(&mut self) -> Result<PathBuf> {
        match &self.logger {
            Some(_) => self.trainer.save(self.out),
            None => Ok(self.trainer.checkpoint(self.out)),
        }
    }

    /// Validates the current state, which `checkpoint` holds, and returns whether to continue. The score is logged last, so that a run that
    /// is killed during the validation repeats all of it.
    fn validate(&mut self, checkpoint: &Path) -> Result<bool> {
        let Some(validator) = &mut self.validator else { return Ok(true) };
        let on_event = &mut self.on_event;
        let Some(score) = validator.validate(self.trainer, &mut || on_event(Event::Busy))? else {
            return Ok(false);
        };
        for why in &score.left_out {
            on_event(Event::Notice(format!("a held-out scene is left out: {why}")));
        }
        let step = self.trainer.step.saturating_sub(1);
        if let Some(logger) = &mut self.logger {
            if score.psnr > logger.best.unwrap_or(f64::NEG_INFINITY) {
                let found = Validation { psnr: score.psnr, settings: logger.settings.clone() };
                keep_best(self.out, checkpoint, found)?;
                // The best one until now was kept in addition.
                prune_checkpoints(self.out, checkpoint, self.trainer.config.train.keep_checkpoints)?;
                logger.best = Some(score.psnr);
            }
            if self.validated != Some(step) {
                logger.log.log_validation(step, &score)?;
            }
        }
        self.validated = Some(step);
        Ok(self.emit(Event::Validation(&score)))
    }

    /// Returns the error for too many skipped steps in a row.
    fn not_finite(&self, steps: u64, last: &StepReport) -> Error {
        let before = match latest_checkpoint(self.out) {
            Ok(checkpoint) => format!("{} is from before", checkpoint.display()),
            Err(_) => "no checkpoint was saved before".into(),
        };
        Error::failed(format!(
            "training stops: loss or gradient of the last {steps} steps was not finite (train.max_nonfinite_steps); step {} showed {}; \
             {before}",
            last.step,
            last.scenes.join(", ")
        ))
    }
}

/// Brings the trainer to the run's starting point, and returns the run's own checkpoint of this state.
fn begin(
    trainer: &mut Trainer,
    out: &Path,
    resume: &Resume,
    on_event: &mut impl FnMut(Event) -> bool,
) -> Result<Option<PathBuf>> {
    let checkpoints = list_checkpoints(out)?;
    match resume {
        Resume::From(checkpoint) => {
            let state = check(checkpoint)?;
            let step = state.step;
            // Later checkpoints would be mistaken for newer ones of this training.
            let later = |of: &&PathBuf| check(of).map_or(true, |other| other.step > step);
            if let Some(later) = checkpoints.iter().rev().find(later) {
                let expected = format!(
                    "none after step {step} (choose another --out, or --resume auto to go on from the last one)"
                );
                let found = later.file_name().unwrap_or_default().display();
                return Err(Error::input(out, "the last checkpoint", found, expected));
            }
            trainer.load(checkpoint, &state)?;
            Ok(checkpoints.into_iter().find(|of| of == checkpoint))
        }
        Resume::Auto | Resume::Never if checkpoints.is_empty() => {
            trainer.load_initial_weights().map(|()| None)
        }
        Resume::Never => {
            let expected = "none with --resume never (choose another --out)";
            Err(Error::input(out, "the run", "one with checkpoints", expected))
        }
        Resume::Auto => {
            for checkpoint in checkpoints.iter().rev() {
                match check(checkpoint) {
                    Ok(state) => {
                        trainer.load(checkpoint, &state)?;
                        return Ok(Some(checkpoint.clone()));
                    }
                    Err(e) => {
                        on_event(Event::Notice(format!("{e}; the previous checkpoint is used")));
                    }
                }
            }
            let found = format!("broken, all {} of them", checkpoints.len());
            Err(Error::input(out, "the run's checkpoints", found, "a whole one (choose another --out)"))
        }
    }
}
