//! TensorBoard log of a run in `RUN/tensorboard`, with one file for every time that the run was started or resumed.

use super::is_due;
use super::metrics::{loss_terms, step_values};
use super::step_report::StepReport;
use super::validator::Score;
use crate::error::Result;
use crate::io::EventFile;
use std::path::Path;

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
