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

/// Returns the instruction set of libtorch's own kernels, such as "AVX2".
pub fn libtorch_simd_level() -> String {
    globalsplat_csrc::processor::libtorch_simd_level()
}

/// Floating-point operations per second that multiply-adds alone reach here, measured for so many seconds on every thread.
pub fn multiply_add_peak(seconds: f64) -> f64 {
    ffi::multiply_add_peak(seconds)
}

/// While it lives, libtorch works on one thread, and the kernels of this program on as many as libtorch did before. Where kernels and
/// small tensor operations take turns this is much faster: libtorch's threads don't sleep after an operation, but wait for the next
/// one, and take the cores that the kernels need.
#[derive(Debug)]
pub struct KernelThreads {
    libtorch: i32,
    own: i32,
}

impl KernelThreads {
    /// Begins.
    pub fn take() -> Self {
        let (libtorch, own) = (tch::get_num_threads(), ffi::threads());
        ffi::set_threads(own);
        tch::set_num_threads(1);
        KernelThreads { libtorch, own }
    }
}

impl Drop for KernelThreads {
    fn drop(&mut self) {
        tch::set_num_threads(self.libtorch);
        ffi::set_threads(if self.own == self.libtorch { 0 } else { self.own });
    }
}
