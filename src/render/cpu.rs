//! CPU-only functions: measurements of the CPU rasterizer and its instruction set.

use super::{Cameras, splat_arguments};
use crate::error::{Error, Result};
use crate::scene::Gaussians;
use globalsplat_csrc::{render as ffi, runtime};

pub use ffi::{PairCounts, StageTimes, multiply_add_peak, stage_times};
pub use globalsplat_csrc::runtime::libtorch_simd_level;

/// Returns the instruction set of the rasterizer's kernels: `avx512`, `avx2`, `neon` or `portable`.
///
/// # Errors
/// Fails if `GLOBALSPLAT_SIMD` names an instruction set that this machine doesn't have.
pub fn simd_level() -> Result<String> {
    ffi::simd_level().map_err(Error::external)
}

/// Counts the tile entries and (pixel, splat) pairs that [`render()`](super::render()) blends for float32 Gaussians on the CPU.
///
/// # Errors
/// Fails like [`render()`](super::render()), and if the Gaussians aren't float32 or not on the CPU.
pub fn count_pairs(gaussians: &Gaussians, cameras: &Cameras, eps2d: f64) -> Result<PairCounts> {
    // SAFETY: the tensors outlive the call.
    unsafe { ffi::count_pairs(&splat_arguments(gaussians, cameras, eps2d)) }.map_err(Error::external)
}

/// Guard that limits libtorch to one thread while it lives. The kernels of this program use as many threads as libtorch did before. This is
/// much faster where kernels and small tensor operations alternate: after an operation, libtorch's threads don't sleep but spin until the
/// next one, and so occupy the cores that the kernels need.
#[derive(Debug)]
pub struct KernelThreads {
    libtorch: i32,
    own: i32,
}

impl KernelThreads {
    /// Limits libtorch to one thread until the guard is dropped.
    pub fn take() -> Self {
        let (libtorch, own) = (tch::get_num_threads(), runtime::get_num_threads());
        runtime::set_num_threads(own);
        tch::set_num_threads(1);
        KernelThreads { libtorch, own }
    }
}

impl Drop for KernelThreads {
    fn drop(&mut self) {
        tch::set_num_threads(self.libtorch);
        runtime::set_num_threads(if self.own == self.libtorch { 0 } else { self.own });
    }
}
