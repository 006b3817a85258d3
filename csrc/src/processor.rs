//! Features and floating-point modes of the processor.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// CPU instructions for bf16 matrix products.
    #[derive(Debug)]
    enum Bf16Support {
        /// No instructions: bf16 products are slower than float32 products.
        None,
        /// Vector instructions (avx512_bf16): bf16 products are about twice as fast as float32 products.
        Vectors,
        /// Tile instructions (AMX): bf16 products are many times as fast as float32 products.
        Tiles,
    }

    unsafe extern "C++" {
        include!("processor.h");

        /// Returns the CPU's bf16 instructions that libtorch detects, or `None` if `GLOBALSPLAT_SIMD` disables them.
        fn cpu_bf16_support() -> Bf16Support;

        /// Returns the instruction set of libtorch's own kernels, such as "AVX2".
        fn libtorch_simd_level() -> String;

        /// Returns `true` if the current GPU has bf16 instructions.
        fn gpu_has_bf16() -> bool;

        /// Makes this thread treat denormal numbers as 0; see `csrc/processor.h`.
        fn flush_denormals();
    }
}
