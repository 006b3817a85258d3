//! Linear layers on the CPU. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("linear.h");

        /// Applies a linear layer; see `csrc/linear.h`.
        ///
        /// # Safety
        /// All arguments must be addresses of live tensors; `bias` may be 0 for none.
        unsafe fn linear(xs: usize, weights: usize, bias: usize) -> Result<usize>;
    }
}
