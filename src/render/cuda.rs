//! What only GPUs have: a driver, and kernels that are compiled when they are first needed.

pub use globalsplat_csrc::cuda::{
    Driver, Form, Gpu, KernelUse, Nvrtc, Prepared, cache_folder, prepare, usage,
};
