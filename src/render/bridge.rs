//! The border to C++. Nothing outside `render` sees it.

#[cxx::bridge(namespace = "globalsplat")]
pub(super) mod ffi {
    unsafe extern "C++" {
        include!("splat.h");

        /// See `csrc/splat.h`.
        #[allow(clippy::too_many_arguments)]
        fn splat(
            means: usize,
            scales: usize,
            quaternions: usize,
            opacities: usize,
            sh: usize,
            w2c: usize,
            intrinsics: usize,
            width: i32,
            height: i32,
            eps2d: f64,
            out: &mut [usize],
        ) -> Result<()>;

        fn simd_level() -> Result<String>;
    }
}
