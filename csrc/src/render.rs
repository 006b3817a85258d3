//! The splat ops. Tensors cross the border as addresses of `at::Tensor`, which is what tch's `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Gaussians and cameras of one call. Tensors are addresses of at::Tensor (tch's C_tensor) that the call borrows.
    struct SplatArguments {
        /// [B, N, 3]
        means: usize,
        /// [B, N, 3]
        scales: usize,
        /// [B, N, 4]
        quaternions: usize,
        /// [B, N]
        opacities: usize,
        /// [B, N, bases, 3]
        sh: usize,
        /// [B, C, 4, 4]
        w2c: usize,
        /// [B, C, 3, 3], pixels
        intrinsics: usize,
        /// Of the pictures, pixels.
        width: i32,
        /// Of the pictures, pixels.
        height: i32,
        /// Added to the diagonal of every projected covariance, pixels².
        eps2d: f64,
    }

    /// Wall-clock seconds that the stages of a call took, all its views together.
    #[derive(Debug, Clone, Copy)]
    struct StageTimes {
        /// Gaussians to splats, and to the tiles that these reach.
        project: f64,
        /// Splats into the order of their depths.
        sort: f64,
        /// And into the tiles' lists.
        bin: f64,
        /// Lists to pictures.
        blend: f64,
        /// From the pictures' gradients to the splats'.
        blend_backward: f64,
        /// From the splats' gradients to the Gaussians'.
        project_backward: f64,
    }

    /// How much there is to blend, all views of a call together.
    #[derive(Debug, Clone, Copy)]
    struct PairCounts {
        /// (tile, splat) pairs.
        tile_entries: i64,
        /// (pixel, splat) pairs whose α is computed.
        evaluated: i64,
        /// (pixel, splat) pairs that are blended.
        contributing: i64,
    }

    /// What all launches of one of the rasterizer's kernels on a GPU took.
    #[derive(Debug, Clone)]
    struct KernelTime {
        /// Its name.
        kernel: String,
        /// All of them together.
        milliseconds: f64,
    }

    unsafe extern "C++" {
        include!("cpu/cpu.h");
        include!("cuda/kernel_times.h");
        include!("splat.h");
        include!("threads.h");

        /// See `csrc/splat.h`.
        ///
        /// # Safety
        /// The arguments hold addresses of live tensors.
        unsafe fn splat(of: &SplatArguments, out: &mut [usize]) -> Result<()>;

        /// See `csrc/splat.h`.
        ///
        /// # Safety
        /// The arguments hold addresses of live tensors.
        unsafe fn project(of: &SplatArguments, out: &mut [usize]) -> Result<()>;

        /// The first `out.len()` (1, 4, 9 or 16) spherical harmonics of a unit vector.
        fn sh_basis(direction: &[f64; 3], out: &mut [f64]);

        /// Of the libtorch whose headers this was compiled with.
        fn libtorch_version() -> String;

        /// See `csrc/splat.h`.
        fn leave_out_stack_traces();

        /// See `csrc/cpu/cpu.h`.
        ///
        /// # Safety
        /// The arguments hold addresses of live tensors.
        unsafe fn count_pairs(of: &SplatArguments) -> Result<PairCounts>;

        /// See `csrc/cpu/cpu.h`.
        fn multiply_add_peak(seconds: f64) -> f64;

        /// See `csrc/cpu/cpu.h`.
        fn stage_times() -> StageTimes;

        /// See `csrc/cuda/kernel_times.h`.
        fn measure_kernels(on: bool);

        /// See `csrc/cuda/kernel_times.h`.
        fn kernel_times() -> Result<Vec<KernelTime>>;

        /// See `csrc/cpu/cpu.h`.
        fn simd_level() -> Result<String>;

        /// See `csrc/threads.h`.
        fn threads() -> i32;

        /// See `csrc/threads.h`.
        fn set_threads(count: i32);
    }
}
