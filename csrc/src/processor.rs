//! What the processor has, and how it computes.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Instructions for products of bf16.
    #[derive(Debug)]
    enum Bf16 {
        /// None: such products are slower than those of float32.
        None,
        /// Of vectors (avx512_bf16): products are about twice as fast as those of float32.
        Vectors,
        /// Of tiles (AMX): many times as fast.
        Tiles,
    }

    unsafe extern "C++" {
        include!("processor.h");

        /// Of the CPU, as libtorch sees it.
        fn bf16_of_cpu() -> Bf16;

        /// Of the current GPU.
        fn gpu_has_bf16() -> bool;

        /// See `csrc/processor.h`.
        fn flush_denormals();
    }
}
