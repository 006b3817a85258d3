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

/// Training curves of a run, read from its metrics.
#[derive(Debug, Clone, PartialEq)]
pub struct Curves {
    /// PSNR of training views: (step, PSNR in dB) pairs, each the mean over consecutive steps, at the last of them. Skipped steps are left
    /// out.
    pub training: Vec<(u64, f64)>,
    /// PSNR of held-out views: (step, PSNR in dB) pairs; the step is the last one before the validation.
    pub held_out: Vec<(u64, f64)>,
}

impl Curves {
    /// Reads the curves of the run in the folder `run`. The training curve has at most `max_points` points; `max_points` is above 0.
    ///
    /// # Errors
    /// Returns an error if the metrics can't be read or have no step.
    pub fn read(run: &Path, max_points: u64) -> Result<Self> {
        let path = run.join(METRICS_FILE);
        let text = std::fs::read_to_string(&path).map_err(Error::read(&path))?;
        let (mut steps, mut held_out) = (vec![], vec![]);
        // The last line may be incomplete, and values that weren't finite are null.
        for record in text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()) {
            let Some(step) = record["step"].as_u64() else { continue };
            held_out.extend(record["validation"]["psnr"].as_f64().map(|psnr| (step, psnr)));
            if record["skipped"] != true {
                steps.extend(record["psnr"].as_f64().map(|psnr| (step, psnr)));
            }
        }
        if steps.is_empty() {
            return Err(Error::input(&path, "the number of steps with a PSNR", 0, "1 or more"));
        }
        let mean = |part: &[(u64, f64)]| {
            (part[part.len() - 1].0, part.iter().map(|step| step.1).sum::<f64>() / part.len() as f64)
        };
        let training = steps.chunks(steps.len().div_ceil(max_points as usize)).map(mean).collect();
        Ok(Curves { training, held_out })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_read_from_the_files_of_a_run() {
        let run = tempfile::tempdir().unwrap();
        let step = |step: u64| format!("{{\"step\": {step}, \"psnr\": {}.0}}\n", 10 + step);
        let mut text: String = (0..5).map(step).collect();
        // A skipped step is left out, even if only its gradient wasn't finite. The last line may be incomplete.
        text += "{\"step\": 5, \"skipped\": true, \"psnr\": 99.0}\n{\"step\": 6, \"skipped\": true, \"psnr\": null}\n";
        text += "{\"step\": 4, \"validation\": {\"psnr\": 8.5}}\n{\"step\": 7, \"ps";
        std::fs::write(run.path().join(METRICS_FILE), text).unwrap();
        let curves = Curves::read(run.path(), 2).unwrap();
        assert_eq!(curves.training, [(2, 11.), (4, 13.5)]);
        assert_eq!(curves.held_out, [(4, 8.5)]);
        std::fs::write(run.path().join(METRICS_FILE), "").unwrap();
        let error = Curves::read(run.path(), 2).unwrap_err().to_string();
        assert!(error.ends_with("the number of steps with a PSNR is 0, expected 1 or more"), "{error}");
    }
}
