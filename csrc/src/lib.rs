//! Rust bindings of GlobalSplat's C++ code. They form a crate without a dependency on tch, so that the two compile in parallel.

pub mod attention;
pub mod chunk;
pub mod cuda;
pub mod depth_search;
pub mod device;
pub mod distributed;
pub mod image_losses;
pub mod linear;
pub mod ops;
pub mod optim;
pub mod processor;
pub mod render;
pub mod tensor_memory;
