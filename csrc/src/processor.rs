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

        /// Of the CPU, as libtorch sees it; none where `GLOBALSPLAT_SIMD` hides them.
        fn bf16_of_cpu() -> Bf16;

        /// The instruction set of libtorch's own kernels, such as "AVX2".
        fn libtorch_simd_level() -> String;

        /// Of the current GPU.
        fn gpu_has_bf16() -> bool;

        /// See `csrc/processor.h`.
        fn flush_denormals();
    }
}
