//! The border to C++. Nothing outside `render` sees it.

#[cxx::bridge(namespace = "globalsplat")]
pub(super) mod ffi {
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
        width: i32,
        height: i32,
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

    unsafe extern "C++" {
        include!("projection.h");
        include!("splat.h");

        /// See `csrc/splat.h`.
        fn splat(of: &SplatArguments, out: &mut [usize]) -> Result<()>;

        /// See `csrc/projection.h`.
        fn project(of: &SplatArguments, out: &mut [usize]) -> Result<()>;

        /// The first `out.len()` (1, 4, 9 or 16) spherical harmonics of a unit vector.
        fn sh_basis(direction: &[f64; 3], out: &mut [f64]);

        /// See `csrc/splat.h`.
        fn count_pairs(of: &SplatArguments) -> Result<PairCounts>;

        fn multiply_add_peak(seconds: f64) -> f64;

        fn stage_times() -> StageTimes;

        fn libtorch_version() -> String;

        fn simd_level() -> Result<String>;
    }
}
