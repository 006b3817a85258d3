//! Progress of the work, and its end when the caller stops it.

use globalsplat_files::{Error, Result};
use serde::{Deserialize, Serialize};
use std::process::Child;

/// Steps of making a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Step {
    /// Sharpness and motion of the frames of a video are measured.
    Measure,
    /// The chosen frames of a video are written.
    Frames,
    /// Photos are checked and linked.
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

/// Reason why work ended early.
#[derive(Debug)]
pub(crate) enum Interrupt {
    /// The caller stopped it.
    Stopped,
    /// It failed.
    Failed(Error),
}

impl From<Error> for Interrupt {
    fn from(error: Error) -> Self {
        Interrupt::Failed(error)
    }
}

/// A process that is killed on drop unless it has ended.
pub(crate) struct KillOnDrop(pub Child);

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns `None` if the work was stopped.
pub(crate) fn unless_stopped<T>(result: Result<T, Interrupt>) -> Result<Option<T>> {
    match result {
        Ok(value) => Ok(Some(value)),
        Err(Interrupt::Stopped) => Ok(None),
        Err(Interrupt::Failed(error)) => Err(error),
    }
}

/// The function that receives the progress, and returns `false` to stop the work.
pub(crate) struct Reporter<'a>(pub &'a mut dyn FnMut(Progress) -> bool);

impl Reporter<'_> {
    /// Reports progress.
    ///
    /// # Errors
    /// Returns [`Interrupt::Stopped`] if the work is to be stopped.
    pub fn report(&mut self, step: Step, done: usize, total: usize) -> Result<(), Interrupt> {
        if (self.0)(Progress { step, done, total }) { Ok(()) } else { Err(Interrupt::Stopped) }
    }
}
