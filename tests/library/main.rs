//! Tests of the library alone: the model, the splat op, losses and loading.

#[path = "../common/mod.rs"]
mod common;

mod fuzz_seeds;
mod loader;
mod model;
mod perceptual;
mod splat;
