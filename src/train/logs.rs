//! Logs of a run: `metrics.jsonl`, with one line for every step and for every validation, and `RUN/tensorboard`, with one event file for
//! every time that the run was started or resumed.

use super::step::{Score, StepReport};
use super::{METRICS_FILE, is_due};
use crate::error::{Error, Result};
use crate::io::{AppendFile, EventFile, write_atomically};
use crate::loss::Term;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;

/// Returns the values that describe a step, with their names, except the terms of its loss.
pub(super) fn step_values(report: &StepReport, samples_per_second: f64) -> [(&'static str, f64); 7] {
    [
        ("loss", report.losses.total),
        ("psnr", report.psnr()),
        ("learning_rate", report.learning_rate),
        ("gradient_norm", report.gradient_norm),
        ("stage", f64::from(report.stage.index)),
        ("mix", report.stage.mix),
        ("samples_per_second", samples_per_second),
    ]
}

/// Returns the terms of a step's loss, with their names.
pub(super) fn loss_terms(report: &StepReport) -> [(&'static str, f64); Term::ALL.len()] {
    Term::ALL.map(|term| (term.name(), report.losses[term]))
}

/// Record read from one line of `metrics.jsonl`: a training step, or a validation if `validation` is set; `step` is then the last step
/// before it. Values that weren't finite are `None`.
#[derive(Debug, Deserialize)]
struct MetricsRecord {
    step: u64,
    #[serde(default)]
    skipped: bool,
    psnr: Option<f64>,
    validation: Option<ValidationRecord>,
}

/// Scores of a validation.
#[derive(Debug, Deserialize)]
struct ValidationRecord {
    psnr: Option<f64>,
}

/// Writer of `metrics.jsonl`.
#[derive(Debug)]
pub(super) struct MetricsWriter {
    file: AppendFile,
    /// Last step before the latest validation in the file.
    last_validated_step: Option<u64>,
}

impl MetricsWriter {
    /// Opens the file of a run that continues after `step` steps. Removes the lines of later steps, which a stopped run wrote after the
    /// checkpoint that it continues from.
    pub fn open(path: &Path, step: u64) -> Result<Self> {
        let mut last_validated_step = None;
        if path.is_file() {
            let text = std::fs::read_to_string(path).map_err(Error::read(path))?;
            let mut kept = String::new();
            for line in text.lines() {
                let line_value: Value = serde_json::from_str(line).unwrap_or_default();
                if let Some(line_step) = line_value["step"].as_u64().filter(|line_step| *line_step < step) {
                    kept.extend([line, "\n"]);
                    if line_value["validation"].is_object() {
                        last_validated_step = last_validated_step.max(Some(line_step));
                    }
                }
            }
            if kept != text {
                write_atomically(path, |writer| {
                    writer.write_all(kept.as_bytes()).map_err(Error::write(path))
                })?;
            }
        }
        Ok(MetricsWriter { file: AppendFile::open(path)?, last_validated_step })
    }

    /// Appends the record of a step.
    pub fn log_step(&mut self, report: &StepReport, samples_per_second: f64) -> Result<()> {
        let mut line = json!({ "step": report.step, "skipped": report.skipped });
        for (name, value) in step_values(report, samples_per_second).into_iter().chain(loss_terms(report)) {
            line[name] = value.into();
        }
        line["stage"] = report.stage.index.into();
        if report.skipped {
            line["scenes"] = report.scenes.clone().into();
        }
        self.append(&line)
    }

    /// Appends the record of a validation after step `step`.
    pub fn log_validation(&mut self, step: u64, score: &Score) -> Result<()> {
        let Score { psnr, ssim, scenes, stage, .. } = score;
        let validation = json!({
            "psnr": psnr, "ssim": ssim, "scenes": scenes, "stage": stage.index, "mix": stage.mix,
        });
        self.append(&json!({ "step": step, "validation": validation }))?;
        self.last_validated_step = Some(step);
        Ok(())
    }

    /// Returns the last step before the latest validation in the file.
    pub fn last_validated_step(&self) -> Option<u64> {
        self.last_validated_step
    }

    fn append(&mut self, line: &Value) -> Result<()> {
        Ok(self.file.append(format!("{line}\n").as_bytes())?)
    }
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
        let records = text.lines().filter_map(|line| serde_json::from_str::<MetricsRecord>(line).ok());
        let (mut steps, mut held_out) = (vec![], vec![]);
        for record in records {
            match record.validation {
                Some(validation) => held_out.extend(validation.psnr.map(|psnr| (record.step, psnr))),
                None if record.skipped => {}
                None => steps.extend(record.psnr.map(|psnr| (record.step, psnr))),
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

/// Event file of the current start of the run.
#[derive(Debug)]
pub(super) struct TensorBoard {
    file: EventFile,
    /// Number of steps between scalars.
    every: u64,
}

impl TensorBoard {
    /// Creates a new file in the run's folder. Call [`TensorBoard::start`] next.
    pub fn create(run: &Path, every: u64) -> Result<Self> {
        Ok(TensorBoard { file: EventFile::create_for(run)?, every })
    }

    /// Records that the run continues with `step`. Earlier events of this step and of later ones become void.
    pub fn start(&mut self, step: u64) -> Result<()> {
        self.file.start(step)
    }

    pub fn log_step(&mut self, report: &StepReport, samples_per_second: f64) -> Result<()> {
        if !is_due(self.every, report.step) {
            return Ok(());
        }
        let tagged = |group: &'static str| move |(name, value)| (format!("{group}/{name}"), value);
        let values = step_values(report, samples_per_second).map(tagged("train"));
        let terms = loss_terms(report).map(tagged("loss"));
        self.file.write_scalars(report.step, &[&values[..], &terms].concat())
    }

    pub fn log_picture(&mut self, report: &StepReport) -> Result<()> {
        match &report.picture {
            Some(picture) => self.file.write_image(report.step, "train/views", picture),
            None => Ok(()),
        }
    }

    /// Logs the validation scores after step `step`.
    pub fn log_validation(&mut self, step: u64, score: &Score) -> Result<()> {
        let values = [
            ("validation/psnr", score.psnr),
            ("validation/ssim", score.ssim),
            ("validation/stage", f64::from(score.stage.index)),
        ];
        self.file.write_scalars(step, &values.map(|(tag, value)| (tag.to_string(), value)))
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
