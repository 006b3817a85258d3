//! The splat op. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.
//!
//! # Safety
//! Every unsafe function requires that the arguments hold addresses of live tensors.

pub use ffi::*;

// The safety section of the module holds for all functions.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Gaussians and cameras of one call. Tensors are addresses of `at::Tensor` (tch's `C_tensor`) that the call borrows.
    struct SplatArguments {
        /// Means of the Gaussians, [B, N, 3].
        means: usize,
        /// Scales of the Gaussians, [B, N, 3].
        scales: usize,
        /// Quaternions of the Gaussians, [B, N, 4].
        quaternions: usize,
        /// Opacities of the Gaussians, [B, N].
        opacities: usize,
        /// Spherical harmonics coefficients, [B, N, bases, 3].
        sh: usize,
        /// World-to-camera matrices, [B, C, 4, 4].
        w2c: usize,
        /// Camera intrinsics in pixels, [B, C, 3, 3].
        intrinsics: usize,
        /// Width of the images in pixels.
        width: i32,
        /// Height of the images in pixels.
        height: i32,
        /// Value added to the diagonal of every projected covariance, in pixels².
        eps2d: f64,
        /// Multiplies opacities by the square root of det(Σ) / det(Σ + eps2d·I), Σ being the projected covariance, as gsplat's
        /// mode `antialiased` does.
        antialiased: bool,
    }

    /// Wall-clock seconds of the stages of a call, summed over all its views.
    #[derive(Debug, Clone, Copy)]
    struct StageTimes {
        /// Projection of Gaussians to splats, and search for the tiles that they touch.
        project: f64,
        /// Sorting of splats by depth.
        sort: f64,
        /// Sorting of splats into the tiles' lists.
        bin: f64,
        /// Blending of the lists into images.
        blend: f64,
        /// Gradients of splats from those of images.
        blend_backward: f64,
        /// Gradients of Gaussians from those of splats.
        project_backward: f64,
    }

    /// Numbers of pairs to blend, summed over all views of a call.
    #[derive(Debug, Clone, Copy)]
    struct PairCounts {
        /// Number of (tile, splat) pairs.
        tile_entries: i64,
        /// Number of (pixel, splat) pairs whose α is computed.
        evaluated: i64,
        /// Number of (pixel, splat) pairs that are blended.
        contributing: i64,
    }

    /// Total time of all launches of one of the rasterizer's GPU kernels.
    #[derive(Debug, Clone)]
    struct KernelTime {
        /// Name of the kernel.
        kernel: String,
        /// Total time in milliseconds.
        milliseconds: f64,
    }

    unsafe extern "C++" {
        include!("splat.h");

        /// Renders Gaussians; see `csrc/splat.h`.
        unsafe fn splat(of: &SplatArguments) -> Result<Vec<usize>>;

        /// Returns the stage times of this thread's last call; see `csrc/splat.h`.
        fn stage_times() -> StageTimes;

        /// Counts the pairs that a call blends; see `csrc/splat.h`.
        unsafe fn count_pairs(of: &SplatArguments) -> Result<PairCounts>;

        /// Measures the peak rate of multiply-adds in operations per second; see `csrc/splat.h`.
        fn multiply_add_peak(seconds: f64) -> f64;

        /// Starts or ends the measurement of GPU kernels; see `csrc/splat.h`.
        fn measure_kernels(on: bool);

        /// Returns the measured times of GPU kernels; see `csrc/splat.h`.
        fn kernel_times() -> Result<Vec<KernelTime>>;

        /// Returns the instruction set of the CPU kernels in use; see `csrc/splat.h`.
        fn simd_level() -> Result<String>;
    }
}
