//! Logs of a run: `metrics.jsonl`, with one line for every step and for every validation, and `RUN/tensorboard`, with one event file for
//! every time that the run was started or resumed.

use super::step::{Score, StepReport};
use super::{METRICS_FILE, is_due};
use crate::error::{Error, Result};
use crate::io::{AppendFile, EventFile, write_file};
use crate::loss::Term;
use serde_json::{Value, json};
use std::path::Path;

/// Writer of the logs.
#[derive(Debug)]
pub(super) struct RunLog {
    metrics: AppendFile,
    events: EventFile,
    /// Number of steps between scalars in the event file.
    every: u64,
}

impl RunLog {
    /// Opens the logs in the folder `run` of a run that continues after `step` steps. Also returns the last step before the latest
    /// validation in the metrics.
    pub fn open(run: &Path, step: u64, every: u64) -> Result<(Self, Option<u64>)> {
        let (metrics, validated) = open_metrics(&run.join(METRICS_FILE), step)?;
        let mut events = EventFile::create_for(run)?;
        // Earlier events of this step and of later ones become void.
        events.start(step)?;
        Ok((RunLog { metrics, events, every }, validated))
    }

    /// Logs a step.
    pub fn log_step(&mut self, report: &StepReport, samples_per_second: f64) -> Result<()> {
        let values = [
            ("loss", report.losses.total),
            ("psnr", report.psnr()),
            ("learning_rate", report.learning_rate),
            ("gradient_norm", report.gradient_norm),
            ("stage", f64::from(report.stage.index)),
            ("mix", report.stage.mix),
            ("samples_per_second", samples_per_second),
        ];
        let terms = Term::ALL.map(|term| (term.name(), report.losses[term]));
        let mut line = json!({ "step": report.step, "skipped": report.skipped });
        for (name, value) in values.into_iter().chain(terms) {
            line[name] = value.into();
        }
        line["stage"] = report.stage.index.into();
        if report.skipped {
            line["scenes"] = report.scenes.clone().into();
        }
        self.append(&line)?;
        if is_due(self.every, report.step) {
            let tagged = |group: &'static str| move |(name, value)| (format!("{group}/{name}"), value);
            let scalars = values.into_iter().map(tagged("train")).chain(terms.map(tagged("loss")));
            let scalars: Vec<_> = scalars.collect();
            self.events.write_scalars(report.step, &scalars)?;
        }
        let Some(picture) = &report.picture else { return Ok(()) };
        self.events.write_image(report.step, "train/views", picture)
    }

    /// Logs the validation after step `step`. Its line in the metrics comes last, so that a run that was killed before repeats it.
    pub fn log_validation(&mut self, step: u64, score: &Score) -> Result<()> {
        let Score { psnr, ssim, scenes, stage, .. } = score;
        let scalars = [("psnr", *psnr), ("ssim", *ssim), ("stage", f64::from(stage.index))];
        let scalars = scalars.map(|(name, value)| (format!("validation/{name}"), value));
        self.events.write_scalars(step, &scalars)?;
        let validation = json!({
            "psnr": psnr, "ssim": ssim, "scenes": scenes, "stage": stage.index, "mix": stage.mix,
        });
        self.append(&json!({ "step": step, "validation": validation }))
    }

    fn append(&mut self, line: &Value) -> Result<()> {
        self.metrics.append(format!("{line}\n").as_bytes())
    }
}

/// Opens the metrics of a run that continues after `step` steps. Removes the lines of later steps, which a stopped run wrote after the
/// checkpoint that it continues from. Also returns the last step before the latest validation in the file.
fn open_metrics(path: &Path, step: u64) -> Result<(AppendFile, Option<u64>)> {
    let mut validated = None;
    if path.is_file() {
        let text = std::fs::read_to_string(path).map_err(Error::read(path))?;
        let mut kept = String::new();
        for line in text.lines() {
            let record: Value = serde_json::from_str(line).unwrap_or_default();
            if let Some(line_step) = record["step"].as_u64().filter(|line_step| *line_step < step) {
                kept.extend([line, "\n"]);
                if record["validation"].is_object() {
                    validated = validated.max(Some(line_step));
                }
            }
        }
        if kept != text {
            write_file(path, kept)?;
        }
    }
    Ok((AppendFile::open(path)?, validated))
}
