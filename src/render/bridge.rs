//! The border to C++. Nothing outside `render` sees it.

#[cxx::bridge(namespace = "globalsplat")]
pub(super) mod ffi {
    /// Wall-clock seconds that the stages of a call took, all its views together.
    #[derive(Debug, Clone, Copy)]
    struct StageTimes {
        /// Gaussians to splats.
        project: f64,
        /// Which tiles the splats reach.
        cover: f64,
        /// Splats into the order of their depths.
        sort: f64,
        /// Splats to the tiles' lists.
        bin: f64,
        /// Lists to pictures.
        blend: f64,
        /// From the pictures' gradients to the splats'.
        blend_backward: f64,
        /// From the splats' gradients to the Gaussians'.
        project_backward: f64,
    }

    unsafe extern "C++" {
        include!("projection.h");
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

        /// See `csrc/projection.h`.
        #[allow(clippy::too_many_arguments)]
        fn project(
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

        /// The first `out.len()` (1, 4, 9 or 16) spherical harmonics of a unit vector.
        fn sh_basis(direction: &[f64; 3], out: &mut [f64]);

        fn stage_times() -> StageTimes;

        fn libtorch_version() -> String;

        fn simd_level() -> Result<String>;
    }
}
