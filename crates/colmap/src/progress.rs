//! Progress of the work, and its end when the caller stops it.

use globalsplat_files::{Error, Result};
use serde::{Deserialize, Serialize};

/// Steps of making a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Step {
    /// Another process uses the capture.
    Wait,
    /// Sharpness and motion of the frames of a video are measured.
    Measure,
    /// The chosen frames of a video are written.
    Frames,
    /// Photos are checked and copied.
    Photos,
    /// Features are detected in photos.
    Features,
    /// Features of pairs of photos are matched.
    Pairs,
    /// The mapper registers photos.
    Poses,
}

impl Step {
    /// Returns what the step counts.
    pub fn unit(self) -> &'static str {
        match self {
            Step::Wait => "waiting for another process that uses the capture",
            Step::Measure => "frames measured",
            Step::Frames => "frames written",
            Step::Photos => "photos checked",
            Step::Features => "photos with features",
            Step::Pairs => "pairs matched",
            Step::Poses => "photos registered",
        }
    }
}

/// Progress of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Current step.
    pub step: Step,
    /// Number of frames, photos or pairs that the step is finished with.
    pub done: usize,
    /// Number of frames, photos or pairs in all, as far as it is known.
    pub total: usize,
}

/// The function that receives the progress, and returns `false` to stop the work.
pub(crate) struct Reporter<'a> {
    on_progress: &'a mut dyn FnMut(Progress) -> bool,
    is_stopped: bool,
}

impl Reporter<'_> {
    /// Does `work` with a reporter to `on_progress`. Returns `None` if the work was stopped.
    pub fn run<T>(
        on_progress: &mut dyn FnMut(Progress) -> bool,
        work: impl FnOnce(&mut Reporter) -> Result<T>,
    ) -> Result<Option<T>> {
        let mut reporter = Reporter { on_progress, is_stopped: false };
        match work(&mut reporter) {
            Err(_) if reporter.is_stopped => Ok(None),
            result => result.map(Some),
        }
    }

    /// Reports progress.
    ///
    /// # Errors
    /// Returns the error of [`Reporter::stop`] if the work is to be stopped.
    pub fn report(&mut self, progress: Progress) -> Result<()> {
        if (self.on_progress)(progress) { Ok(()) } else { self.stop() }
    }

    /// Stops the work.
    ///
    /// # Errors
    /// Returns an error, which ends the work and which [`Reporter::run`] doesn't return.
    pub fn stop(&mut self) -> Result<()> {
        self.is_stopped = true;
        Err(Error::failed("stopped"))
    }
}
