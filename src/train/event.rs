//! Events that a run reports, and writing that waits for disk space and reports that.

use super::step::{Score, StepReport};
use crate::error::Result;
use std::time::Duration;

/// Event that a run reports.
#[derive(Debug)]
pub enum Event<'a> {
    /// Completed step.
    Step {
        /// Report of the step.
        report: &'a StepReport,
        /// Speed of the step, in samples per second.
        samples_per_second: f64,
    },
    /// Score of a completed validation.
    Validation(&'a Score),
    /// Message for the user, in one sentence.
    Notice(String),
    /// No progress to report: the run waits for disk space, or is inside of a step or a validation.
    Waiting,
}

/// Time between attempts to write to a full disk.
const PAUSE: Duration = Duration::from_millis(500);

/// Calls `write`, and repeats it as long as the disk is full and `on_event` returns `true`.
///
/// # Errors
/// Returns the errors of `write`.
pub fn retry_on_disk_full<T>(
    on_event: &mut impl FnMut(Event) -> bool,
    mut write: impl FnMut() -> Result<T>,
) -> Result<T> {
    let mut waited = false;
    loop {
        match write() {
            Err(e) if e.is_out_of_space() => {
                if !waited {
                    on_event(Event::Notice(format!(
                        "training paused: {e}; it resumes when there is disk space"
                    )));
                    waited = true;
                }
                if !on_event(Event::Waiting) {
                    return Err(e);
                }
                std::thread::sleep(PAUSE);
            }
            result => {
                if waited && result.is_ok() {
                    on_event(Event::Notice("disk space is available again: training resumes".into()));
                }
                return result;
            }
        }
    }
}
