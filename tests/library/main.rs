//! Tests of the library alone: the model, the splat op, losses and loading, against golden tensors.

#[path = "../common/mod.rs"]
mod common;

mod fuzz_seeds;
mod golden;
mod loader;
mod model;
mod splat;
