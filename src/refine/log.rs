//! Log of a refinement, for TensorBoard.

use super::session::{EvalPoint, RefineMetrics};
use crate::error::{Error, Result};
use crate::io::{AppendFile, CONFIG_FILE, EventFile, METRICS_FILE, write_atomically};
use serde_json::{Value, json};
use std::path::Path;

/// Log in the folder of a run: `metrics.jsonl`, with a line for some of the steps and one for each score, and event files in `tensorboard`.
#[derive(Debug)]
pub struct RefineLog {
    metrics: AppendFile,
    events: EventFile,
}

impl RefineLog {
    /// Creates the log of a refinement that continues after `steps` steps in the folder `run`. The log of an earlier refinement is replaced if
    /// `steps` is 0, and continued otherwise.
    ///
    /// # Errors
    /// Returns an error if the folder has the log of a training, or if a file can't be written.
    pub fn create(run: &Path, steps: u64) -> Result<Self> {
        if run.join(CONFIG_FILE).exists() {
            return Err(Error::input(run, "the log", "a folder of a training run", "another folder"));
        }
        std::fs::create_dir_all(run).map_err(Error::write(run))?;
        let file = run.join(METRICS_FILE);
        if steps == 0 {
            write_atomically(&file, |_| Ok::<_, Error>(()))?;
        }
        let (metrics, mut events) = (AppendFile::open(&file)?, EventFile::create_for(run)?);
        events.start(steps)?;
        Ok(RefineLog { metrics, events })
    }

    /// Writes the metrics of a step.
    ///
    /// # Errors
    /// Returns an error if a file can't be written.
    pub fn log_step(&mut self, metrics: &RefineMetrics) -> Result<()> {
        let RefineMetrics { step, seconds, loss, gaussians, learning_rate } = *metrics;
        let values = [
            ("loss", loss),
            ("gaussians", gaussians as f64),
            ("learning_rate", learning_rate),
            ("seconds", seconds),
        ];
        self.write(step, "refine", &values, |object| object)
    }

    /// Writes scores of the held-out views.
    ///
    /// # Errors
    /// Returns an error if a file can't be written.
    pub fn log_scores(&mut self, point: &EvalPoint) -> Result<()> {
        let values = [("psnr", point.scores.psnr), ("ssim", point.scores.ssim)];
        self.write(point.steps, "validation", &values, |object| json!({ "validation": object }))
    }

    /// Writes `values` after `steps` steps to both files. `line_of` returns the line of the metrics from the object of the values. As in a log
    /// of training, the step is the index of the last one.
    fn write(
        &mut self,
        steps: u64,
        group: &str,
        values: &[(&str, f64)],
        line_of: impl Fn(Value) -> Value,
    ) -> Result<()> {
        let step = steps.saturating_sub(1);
        let object: serde_json::Map<String, Value> =
            values.iter().map(|&(name, value)| (name.to_string(), value.into())).collect();
        let mut line = line_of(object.into());
        line["step"] = step.into();
        self.metrics.append(format!("{line}\n").as_bytes())?;
        let tagged: Vec<_> = values.iter().map(|&(name, value)| (format!("{group}/{name}"), value)).collect();
        self.events.write_scalars(step, &tagged)
    }
}
