//! GPU-only functions: the driver, and kernels that are compiled at first use.

pub use globalsplat_csrc::cuda::{
    Driver, Form, Gpu, KernelUse, Nvrtc, Prepared, cache_folder, prepare, usage,
};

pub use globalsplat_csrc::render::{KernelTime, measure_kernels};

/// Returns the total time of each of the rasterizer's kernels since [`measure_kernels`]`(true)`, in the order of their first launches.
/// Waits for the GPU.
///
/// # Errors
/// Fails if the GPU reports an error.
pub fn kernel_times() -> crate::error::Result<Vec<KernelTime>> {
    Ok(globalsplat_csrc::render::kernel_times()?)
}
