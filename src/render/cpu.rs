//! What only a CPU has: measurements of its rasterizer, and its instruction set.

use super::{Cameras, arguments};
use crate::error::Result;
use crate::scene::Gaussians;
use globalsplat_csrc::render as ffi;

pub use ffi::{PairCounts, StageTimes};

/// The instruction set of the rasterizer's kernels: `avx512`, `avx2`, `neon` or `portable`.
///
/// # Errors
/// A `GLOBALSPLAT_SIMD` that names one which this machine doesn't have.
pub fn simd_level() -> Result<String> {
    Ok(ffi::simd_level()?)
}

/// How long the stages of this thread's last [`render()`](super::render()) on the CPU and of its backward pass took.
pub fn stage_times() -> StageTimes {
    ffi::stage_times()
}

/// How much a call of [`render()`](super::render()) with float32 Gaussians has to blend.
///
/// # Errors
/// As [`render()`](super::render()).
pub fn count_pairs(gaussians: &Gaussians, cameras: &Cameras, eps2d: f64) -> Result<PairCounts> {
    // SAFETY: the tensors outlive the call.
    Ok(unsafe { ffi::count_pairs(&arguments(gaussians, cameras, eps2d)) }?)
}

/// Floating-point operations per second that multiply-adds alone reach here, measured for so many seconds on every thread.
pub fn multiply_add_peak(seconds: f64) -> f64 {
    ffi::multiply_add_peak(seconds)
}
