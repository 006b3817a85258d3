//! Events that a run reports.

use super::step::{Score, StepReport};

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
    /// No progress to report: the run is inside of a step or a validation.
    Busy,
}
