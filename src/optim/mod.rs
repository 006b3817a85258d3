//! Optimizers over named tensors in groups: for a network's weights as for Gaussians (tch's own can't save their state); and where
//! their time goes.

mod address;
mod muon;
mod optimizer;
mod stopwatch;

pub use optimizer::{Optimizer, ParameterGroup, Rule};

// For benchmarks.
pub use stopwatch::Stopwatch;

pub(crate) use optimizer::forget_gradients;
