//! A whole run: from where it stands to the last step, with checkpoints on the way.

use super::checkpoint::{check, list_checkpoints};
use super::lock::RunLock;
use super::trainer::{StepReport, Trainer};
use crate::error::{Error, Result};
use crate::io::write_atomically;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Where a run begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Resume {
    /// At the run's newest checkpoint that is whole; at step 0 where there is none at all.
    Auto,
    /// At step 0; a run that has checkpoints is refused.
    Never,
    /// At this checkpoint.
    From(PathBuf),
}

/// What a run tells while it goes on.
#[derive(Debug)]
pub enum Event<'a> {
    /// A step was done.
    Step(&'a StepReport),
    /// Something a person should know, in one sentence.
    Notice(String),
    /// Nothing has changed: the run waits for room on the disk.
    Waiting,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// The last checkpoint.
    pub checkpoint: PathBuf,
    /// Whether all steps are done; else it was stopped.
    pub complete: bool,
    /// Steps that were skipped because loss or gradient wasn't finite.
    pub skipped: u64,
}

/// Trains into the folder `out`, which nobody else may train into meanwhile. `observe` hears what happens and says whether to
/// go on: a stopped run is saved first.
///
/// # Errors
/// A run that is in use, a checkpoint that doesn't fit, or whatever a step or a save fails with. A full disk is waited for.
pub fn run(
    trainer: &mut Trainer,
    out: &Path,
    resume: &Resume,
    mut observe: impl FnMut(Event) -> bool,
) -> Result<Outcome> {
    let _lock = RunLock::take(out)?;
    begin(trainer, out, resume, &mut observe)?;
    let config = out.join("config.toml");
    let toml = trainer.config.to_toml();
    write_atomically(&config, |writer| writer.write_all(toml.as_bytes()).map_err(Error::write(&config)))?;
    let mut metrics = Metrics::open(&out.join("metrics.jsonl"), trainer.step)?;
    let (steps, every) = (trainer.config.train.steps, trainer.config.train.checkpoint_every);
    let (mut skipped, mut saved) = (0, None);
    while trainer.step < steps {
        let report = trainer.step()?;
        skipped += u64::from(report.skipped);
        let line = format!("{}\n", to_json(&report));
        patiently(&mut observe, || metrics.append(&line))?;
        let go_on = observe(Event::Step(&report));
        saved = None;
        if !go_on || trainer.step.is_multiple_of(every) {
            saved = Some(patiently(&mut observe, || trainer.save(out))?);
        }
        if !go_on {
            break;
        }
    }
    let checkpoint = match saved {
        Some(path) => path,
        None => patiently(&mut observe, || trainer.save(out))?,
    };
    Ok(Outcome { checkpoint, complete: trainer.step >= steps, skipped })
}

/// Brings the trainer to where the run begins.
fn begin(
    trainer: &mut Trainer,
    out: &Path,
    resume: &Resume,
    observe: &mut impl FnMut(Event) -> bool,
) -> Result<()> {
    let checkpoints = list_checkpoints(out)?;
    match resume {
        Resume::From(checkpoint) => trainer.load(checkpoint),
        Resume::Never if checkpoints.is_empty() => Ok(()),
        Resume::Never => {
            let expected = "none with --resume never (choose another --out)";
            Err(Error::input(out, "the run", "one with checkpoints", expected))
        }
        Resume::Auto => {
            for checkpoint in checkpoints.iter().rev() {
                match check(checkpoint) {
                    Ok(_) => return trainer.load(checkpoint),
                    Err(e) => {
                        observe(Event::Notice(format!("{e}; the checkpoint before it is taken")));
                    }
                }
            }
            match checkpoints.len() {
                0 => Ok(()),
                count => {
                    let found = format!("broken, all {count} of them");
                    Err(Error::input(
                        out,
                        "the run's checkpoints",
                        found,
                        "a whole one (choose another --out)",
                    ))
                }
            }
        }
    }
}

/// How long a full disk is left alone.
const PATIENCE: Duration = Duration::from_millis(500);

/// Does `write`, and again as long as there is no room on the disk and `observe` wants to go on.
fn patiently<T>(observe: &mut impl FnMut(Event) -> bool, mut write: impl FnMut() -> Result<T>) -> Result<T> {
    let mut waited = false;
    loop {
        match write() {
            Err(e) if e.is_disk_full() => {
                if !waited {
                    observe(Event::Notice(format!("training pauses: {e}; it goes on when there is room")));
                    waited = true;
                }
                if !observe(Event::Waiting) {
                    return Err(e);
                }
                std::thread::sleep(PATIENCE);
            }
            result => {
                if waited && result.is_ok() {
                    observe(Event::Notice("there is room again: training goes on".into()));
                }
                return result;
            }
        }
    }
}

/// `metrics.jsonl`: a line for every step.
struct Metrics {
    path: PathBuf,
    file: File,
    /// Of whole lines, in bytes.
    length: u64,
}

impl Metrics {
    /// Opens the file and takes away what a run that was stopped wrote after the checkpoint it goes on from.
    fn open(path: &Path, step: u64) -> Result<Self> {
        if path.is_file() {
            let text = std::fs::read_to_string(path).map_err(Error::read(path))?;
            let before = |line: &&str| {
                let step_of: Option<u64> = serde_json::from_str::<serde_json::Value>(line)
                    .ok()
                    .and_then(|json| json["step"].as_u64());
                step_of.is_some_and(|of| of < step)
            };
            let kept: String = text.lines().filter(before).flat_map(|line| [line, "\n"]).collect();
            if kept != text {
                write_atomically(path, |writer| {
                    writer.write_all(kept.as_bytes()).map_err(Error::write(path))
                })?;
            }
        }
        let file = OpenOptions::new().create(true).append(true).open(path).map_err(Error::write(path))?;
        let length = file.metadata().map_err(Error::read(path))?.len();
        Ok(Metrics { path: path.to_owned(), file, length })
    }

    /// A line that can't be written leaves no part of itself.
    fn append(&mut self, line: &str) -> Result<()> {
        let written = self.file.set_len(self.length).and_then(|()| self.file.write_all(line.as_bytes()));
        written.map_err(Error::write(&self.path))?;
        self.length += line.len() as u64;
        Ok(())
    }
}

fn to_json(report: &StepReport) -> serde_json::Value {
    serde_json::json!({
        "step": report.step,
        "stage": report.stage.index,
        "mix": report.stage.mix,
        "learning_rate": report.learning_rate,
        "loss": report.loss,
        "mse": report.mse,
        "perceptual": report.perceptual,
        "consistency": report.consistency,
        "frustum": report.frustum,
        "decoder": report.decoder,
        "gradient_norm": report.gradient_norm,
        "skipped": report.skipped,
    })
}
