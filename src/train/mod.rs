//! Training: what a step does, how the run goes on, and how it survives being stopped.

mod checkpoint;
mod curriculum;
mod lock;
mod optimizer;
mod pass;
mod run;
mod schedule;
#[cfg(test)]
mod step_tests;
mod stopwatch;
mod subsets;
mod trainer;

pub use checkpoint::{latest_checkpoint, list_checkpoints};
pub use curriculum::stage_at;
pub use optimizer::AdamW;
pub use run::{Event, Outcome, Resume, run};
pub use schedule::learning_rate;
pub use stopwatch::Stopwatch;
pub use subsets::subsets;
pub use trainer::{StepReport, Trainer};
