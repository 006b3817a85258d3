//! Rust bindings of GlobalSplat's C++ code. They form a crate without a dependency on tch, so that the two compile in parallel.

pub mod cuda;
pub mod distributed;
pub mod render;
pub mod runtime;
pub mod tensor_ops;
