//! Training: the step, the run with its checkpoints and logs, and resumption.

mod checkpoint;
mod event;
mod gradients;
mod logs;
mod memory_estimate;
mod run;
mod schedule;
mod step;
#[cfg(test)]
mod tests;
mod trainer;

pub use crate::io::{CONFIG_FILE, METRICS_FILE};
pub use checkpoint::{MODEL_FILE, best_checkpoint, latest_checkpoint, list_checkpoints};
pub use event::Event;
pub use memory_estimate::MemoryEstimate;
pub use run::{Outcome, Resume, Validator, add_run_inputs, run};
pub use step::{Score, StepReport};
pub use trainer::Trainer;

// The parity checks run this function by itself.
pub(crate) use schedule::parameter_groups;
// Benchmarks read the time of this span.
pub(crate) use trainer::COMMUNICATION;

/// Returns `true` if an action that is taken every `every` steps (0: never) is due at `step`.
fn is_due(every: u64, step: u64) -> bool {
    every > 0 && step.is_multiple_of(every)
}
