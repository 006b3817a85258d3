//! Attention on the CPU. Tensors cross the border as addresses of `at::Tensor`, which is what tch's `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("attention.h");

        /// See `csrc/attention.h`.
        fn attention_takes(width: i64, is_bf16: bool) -> Result<bool>;

        /// See `csrc/attention.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn attention(q: usize, k: usize, v: usize, heads: i64) -> Result<usize>;
    }
}
