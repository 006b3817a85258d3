//! TensorBoard log of a run in `RUN/tensorboard`, with one file for every time that the run was started or resumed.

use super::is_due;
use super::metrics::{loss_terms, progress};
use super::step_report::StepReport;
use super::validator::Score;
use crate::error::{Error, Result};
use crate::io::EventFile;
use std::path::{Path, PathBuf};

const FOLDER: &str = "tensorboard";
/// Prefix of the names of our files. A number follows, because TensorBoard reads the files of a folder in the order of their names.
const PREFIX: &str = "events.out.tfevents.";

/// Returns the number in the name of one of our files.
fn number_of(file: &Path) -> Option<u64> {
    file.file_name()?.to_str()?.strip_prefix(PREFIX)?.parse().ok()
}

/// Returns the event files of the folder `run`, oldest first. The list is empty if there are none or if they can't be listed.
pub(super) fn event_files(run: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(run.join(FOLDER)).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        entries.filter_map(|entry| Some((number_of(&entry.path())?, entry.path()))).collect();
    files.sort();
    files.into_iter().map(|(_, file)| file).collect()
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
        let folder = run.join(FOLDER);
        std::fs::create_dir_all(&folder).map_err(Error::write(&folder))?;
        let mut number = 0;
        for entry in std::fs::read_dir(&folder).map_err(Error::read(&folder))? {
            let of = number_of(&entry.map_err(Error::read(&folder))?.path());
            number = number.max(of.map_or(0, |of| of + 1));
        }
        Ok(TensorBoard { file: EventFile::create(&folder.join(format!("{PREFIX}{number:010}")))?, every })
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
        let progress = progress(report, samples_per_second).map(tagged("train"));
        let terms = loss_terms(report).map(tagged("loss"));
        self.file.write_scalars(report.step, &[&progress[..], &terms].concat())
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
