//! Compilation, caching and launching of the kernels in `cuda/`, without a CUDA toolkit: NVRTC, which comes with torch, compiles them and
//! the driver launches them.

mod cache;
mod compile;
mod gpu;
mod libraries;

pub use cache::cache_folder;
pub use compile::{CodeFormat, Compiled, MIN_ARCHITECTURE, Nvrtc};
pub use gpu::{Driver, Gpu, KernelOrigin, load_kernels};

use gpu::launch_kernel;

/// Result whose error is a message of one sentence.
pub type Result<T> = std::result::Result<T, String>;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat::cuda")]
mod ffi {
    extern "Rust" {
        /// Launches a kernel on the device of this index, in a stream, a `CUstream`. `arguments` is a `void**`, as in cuLaunchKernel.
        unsafe fn launch_kernel(
            device: i32,
            stream: usize,
            kernel: &str,
            blocks: [u32; 2],
            threads_per_block: u32,
            arguments: usize,
        ) -> Result<()>;
    }
}
