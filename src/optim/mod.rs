//! Optimizers over groups of named tensors, used for network weights and for Gaussians (tch's own optimizers can't save their state).

mod address;
mod muon;
mod optimizer;

pub use optimizer::{Optimizer, ParameterGroup, UpdateRule};

pub(crate) use optimizer::zero_grad;
