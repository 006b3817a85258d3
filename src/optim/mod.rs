//! Optimizers over named tensors in groups: for a network's weights as for Gaussians (tch's own can't save their state); and where
//! their time goes.

mod adamw;
mod stopwatch;

pub use adamw::{AdamW, ParameterGroup};

// For benchmarks.
pub use stopwatch::Stopwatch;

pub(crate) use adamw::forget_gradients;
