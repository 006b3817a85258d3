//! The kernels of `cuda/` on GPUs, without a CUDA toolkit: compiled by NVRTC, which comes with torch, kept on disk, and launched by the
//! driver.

mod cache;
mod compile;
mod gpu;
mod libraries;
mod usage;

pub use cache::cache_folder;
pub use compile::{Compiled, Form, Nvrtc, OLDEST};
pub use gpu::{Driver, Gpu, Prepared, prepare};
pub use usage::{KernelUse, usage};

use gpu::launch_kernel;

/// What is wrong, in one sentence.
pub type Result<T> = std::result::Result<T, String>;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat::cuda")]
mod ffi {
    /// Of a launch.
    struct BlockCounts {
        x: u32,
        y: u32,
    }
    extern "Rust" {
        /// Has the device, by its number, run a kernel in a stream, a `CUstream`. `arguments` is a `void**`, as cuLaunchKernel takes it.
        unsafe fn launch_kernel(
            device: i32,
            stream: usize,
            kernel: &str,
            blocks: BlockCounts,
            threads: u32,
            arguments: usize,
        ) -> Result<()>;
    }
}
