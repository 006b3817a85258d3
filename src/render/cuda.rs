//! GPU-only functions: the driver, and kernels that are compiled at first use.

pub use globalsplat_csrc::cuda::{
    CodeFormat, Driver, Gpu, KernelOrigin, KernelResources, Nvrtc, cache_folder, load_kernels,
    parse_resources,
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
