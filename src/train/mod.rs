//! Training: what a step does, how the run goes on, and how it survives being stopped.

mod board;
mod checkpoint;
mod curriculum;
mod glance;
mod lock;
mod metrics;
mod optimizer;
mod pass;
mod run;
mod schedule;
#[cfg(test)]
mod step_tests;
mod stopwatch;
mod subsets;
mod trainer;
mod validator;

pub use checkpoint::{MODEL_FILE, best_checkpoint, latest_checkpoint, list_checkpoints};
pub use curriculum::stage_at;
pub use optimizer::AdamW;
pub use pass::LossValues;
pub use run::{Event, Outcome, Resume, run};
pub use schedule::learning_rate;
pub use stopwatch::Stopwatch;
pub use subsets::subsets;
pub use trainer::{StepReport, Trainer};
pub use validator::{Score, Validator};

/// Whether something that is done every so many steps, or never (0), is done at `step`.
fn is_due(every: u64, step: u64) -> bool {
    every > 0 && step.is_multiple_of(every)
}
