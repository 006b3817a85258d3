//! The C++ of GlobalSplat as Rust sees it. A crate of its own, without tch, so that both compile side by side.

pub mod attention;
pub mod chunk;
pub mod cuda;
pub mod device;
pub mod fit;
pub mod linear;
pub mod ops;
pub mod optim;
pub mod processor;
pub mod ranks;
pub mod render;
pub mod room;
pub mod tensor_memory;
