//! A whole run: from where it stands to the last step, with checkpoints on the way.

use super::checkpoint::{latest_checkpoint, list_checkpoints};
use super::trainer::{StepReport, Trainer};
use crate::error::{Error, Result};
use crate::io::write_atomically;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Where a run begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Resume {
    /// At the run's newest checkpoint, else at step 0.
    Auto,
    /// At step 0; a run that has checkpoints is refused.
    Never,
    /// At this checkpoint.
    From(PathBuf),
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

/// Trains into the folder `out`. `observe` hears of every step and says whether to go on: a stopped run is saved first.
///
/// # Errors
/// A checkpoint that doesn't fit, or whatever a step or a save fails with.
pub fn run(
    trainer: &mut Trainer,
    out: &Path,
    resume: &Resume,
    mut observe: impl FnMut(&StepReport) -> bool,
) -> Result<Outcome> {
    match resume {
        Resume::From(checkpoint) => trainer.load(checkpoint)?,
        Resume::Auto if !list_checkpoints(out)?.is_empty() => trainer.load(&latest_checkpoint(out)?)?,
        Resume::Never if !list_checkpoints(out)?.is_empty() => {
            let expected = "none with --resume never (choose another --out)";
            return Err(Error::input(out, "the run", "one with checkpoints", expected));
        }
        _ => {}
    }
    let config = out.join("config.toml");
    let toml = trainer.config.to_toml();
    write_atomically(&config, |writer| writer.write_all(toml.as_bytes()).map_err(Error::write(&config)))?;
    let metrics = out.join("metrics.jsonl");
    let mut log =
        OpenOptions::new().create(true).append(true).open(&metrics).map_err(Error::write(&metrics))?;

    let (steps, every) = (trainer.config.train.steps, trainer.config.train.checkpoint_every);
    let (mut skipped, mut saved) = (0, None);
    while trainer.step < steps {
        let report = trainer.step()?;
        skipped += u64::from(report.skipped);
        writeln!(log, "{}", to_json(&report)).map_err(Error::write(&metrics))?;
        let go_on = observe(&report);
        saved = None;
        if !go_on || trainer.step.is_multiple_of(every) {
            saved = Some(trainer.save(out)?);
        }
        if !go_on {
            break;
        }
    }
    let checkpoint = match saved {
        Some(path) => path,
        None => trainer.save(out)?,
    };
    Ok(Outcome { checkpoint, complete: trainer.step >= steps, skipped })
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
