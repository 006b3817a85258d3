//! Optimizers over named tensors in groups: for a network's weights as for Gaussians. tch's own can't save their state.

mod adamw;

pub use adamw::{AdamW, ParameterGroup};
