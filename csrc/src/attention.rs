//! Attention on the CPU. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("attention.h");

        /// Returns `true` if `attention` supports heads of this width and kind; see `csrc/attention.h`.
        fn supports_attention(width: i64, is_bf16: bool) -> Result<bool>;

        /// Computes attention; see `csrc/attention.h`.
        ///
        /// # Safety
        /// `q`, `k` and `v` must be addresses of live tensors.
        unsafe fn attention(q: usize, k: usize, v: usize, heads: i64) -> Result<usize>;
    }
}
