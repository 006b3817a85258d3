//! Linear layers on the CPU. Tensors cross the border as addresses of `at::Tensor`, which is what tch's `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("linear.h");

        /// See `csrc/linear.h`.
        ///
        /// # Safety
        /// Addresses of live tensors; 0 for a bias that isn't there.
        unsafe fn linear(xs: usize, weights: usize, bias: usize) -> Result<usize>;
    }
}
