//! Training: the step, the run with its checkpoints and logs, and resumption.

mod checkpoint;
mod curriculum;
mod forward_backward;
mod lock;
mod memory_estimate;
mod metrics;
mod parallel_slices;
mod parameter_groups;
mod preview;
#[cfg(test)]
mod rank_tests;
mod run;
mod schedule;
mod step_report;
mod step_sync;
#[cfg(test)]
mod step_tests;
mod subsets;
mod tensorboard;
mod trainer;
mod validator;

pub use crate::io::{CONFIG_FILE, METRICS_FILE};
pub use checkpoint::{MODEL_FILE, best_checkpoint, latest_checkpoint, list_checkpoints};
pub use memory_estimate::{MemoryEstimate, largest_fitting_batch};
pub use metrics::Curves;
pub use run::{Event, Outcome, Resume, add_run_inputs, retry_on_disk_full, run};
pub use step_report::StepReport;
pub use trainer::Trainer;
pub use validator::{Score, Validator};

// The parity checks run each of these functions by itself.
pub(crate) use curriculum::stage_at;
pub(crate) use parameter_groups::parameter_groups;
pub(crate) use schedule::learning_rate;
pub(crate) use subsets::subsets;
// Benchmarks read the time of this span.
pub(crate) use trainer::COMMUNICATION;

/// Returns `true` if an action that is taken every `every` steps (0: never) is due at `step`.
fn is_due(every: u64, step: u64) -> bool {
    every > 0 && step.is_multiple_of(every)
}
