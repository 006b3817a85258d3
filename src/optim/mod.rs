//! Optimizers over groups of named tensors, used for network weights and for Gaussians (tch's own optimizers can't save their state), and
//! a stopwatch for the sections of a step.

mod address;
mod muon;
mod optimizer;
mod stopwatch;

pub use optimizer::{Optimizer, ParameterGroup, Rule};

// For benchmarks.
pub use stopwatch::Stopwatch;

pub(crate) use optimizer::zero_grad;
