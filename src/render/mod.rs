//! Safe, typed bindings to the differentiable splat op (spec 6).

pub mod cpu;
mod depth_colors;
mod edit;
mod harmonics;
mod views;

pub use depth_colors::{DepthScale, colorize_depth, depth_colors};
pub use edit::{EditedSplat, SplatEdit, contributions, edit_splat, move_cameras, transform};
pub(crate) use edit::{image_contributions, largest_contributions};
pub use globalsplat_csrc::runtime::libtorch_version;
pub use harmonics::{compensate_mean_color, fit_harmonics, shrink_harmonics};
pub use views::{RenderedView, SplatRenderer, orbit_around_gaussians, orbit_around_splat, render_views};

use crate::error::{Error, Result};
use crate::ffi::take_tensors;
use crate::scene::{Camera, Gaussians, pose_to_rows};
use globalsplat_csrc::render::{SplatArguments, splat};
use tch::{Device, Kind, Tensor};

/// GPU-only functions: the driver, and kernels that are compiled at first use.
pub mod cuda {
    pub use globalsplat_csrc::cuda::{
        CodeFormat, Driver, Gpu, KernelOrigin, Nvrtc, cache_folder, load_kernels,
    };
    pub use globalsplat_csrc::render::{KernelTime, kernel_times, measure_kernels};
}

/// Value added to the diagonal of every projected covariance of a splat that isn't antialiased, in pixels².
pub const DEFAULT_EPS2D: f64 = 0.05;

/// Value added to the diagonal of every projected covariance of an antialiased splat, in pixels², as in Mip-Splatting (Yu et al. 2024).
/// A pixel itself has a variance of 1/12 in each direction.
pub const ANTIALIASED_EPS2D: f64 = 0.1;

/// Returns the value that is added to the diagonal of every projected covariance of `gaussians` by default, in pixels².
pub fn default_eps2d(gaussians: &Gaussians) -> f64 {
    if gaussians.antialiased { ANTIALIASED_EPS2D } else { DEFAULT_EPS2D }
}

/// Cameras to render from: C cameras for each of B scenes.
#[derive(Debug)]
pub struct Cameras {
    /// World-to-camera matrices with OpenCV axes, [B, C, 4, 4].
    pub w2c: Tensor,
    /// Intrinsic matrices in pixels of the image, [B, C, 3, 3].
    pub intrinsics: Tensor,
    /// Image width in pixels.
    pub width: i64,
    /// Image height in pixels.
    pub height: i64,
}

impl Cameras {
    /// Returns one camera of one scene, B = C = 1.
    pub fn single(camera: &Camera) -> Self {
        let matrix = |rows: &[f64], n: i64| Tensor::from_slice(rows).view([1, 1, n, n]).to_kind(Kind::Float);
        Cameras {
            w2c: matrix(&pose_to_rows(&camera.c2w.inverse()), 4),
            intrinsics: matrix(&camera.intrinsics.to_rows(), 3),
            width: i64::from(camera.width),
            height: i64::from(camera.height),
        }
    }

    /// Returns the cameras on `device`.
    pub fn to_device(&self, device: Device) -> Self {
        let to = |t: &Tensor| t.to_device(device);
        Cameras { w2c: to(&self.w2c), intrinsics: to(&self.intrinsics), ..*self }
    }
}

/// Rendered images of all cameras.
#[derive(Debug)]
pub struct RenderOutput {
    /// Color over a black background, [B, C, 3, H, W]; not clamped above.
    pub rgb: Tensor,
    /// Accumulated opacity in [0, 1], [B, C, H, W].
    pub alpha: Tensor,
    /// Expected camera depth, [B, C, H, W]; 0 where nothing is seen.
    pub depth: Tensor,
}

/// Renders every scene from its cameras on the device of the Gaussians, the CPU or a CUDA device, with bit-identical results. `eps2d` is added
/// to the diagonal of every projected covariance; [`default_eps2d`] returns the usual value.
/// Differentiable with respect to the Gaussians and to `w2c`, whose entries are treated as independent values. float64 tensors are rendered
/// in float64, on the host wherever they are, and all others in float32.
///
/// # Errors
/// Fails if shapes don't match, if `GLOBALSPLAT_SIMD` names an instruction set that this machine doesn't have, or if kernels can't be
/// compiled for the GPU.
pub fn render(gaussians: &Gaussians, cameras: &Cameras, eps2d: f64) -> Result<RenderOutput> {
    // SAFETY: the tensors outlive the call, which returns the addresses of new ones.
    let [rgb, alpha, depth] =
        unsafe { take_tensors(splat(&splat_arguments(gaussians, cameras, eps2d)).map_err(Error::external)?) };
    Ok(RenderOutput { rgb, alpha, depth })
}

/// Returns the arguments of a call of the C++ side. They are valid as long as `gaussians` and `cameras` live.
fn splat_arguments(gaussians: &Gaussians, cameras: &Cameras, eps2d: f64) -> SplatArguments {
    let address = |t: &Tensor| t.as_ptr() as usize;
    SplatArguments {
        means: address(&gaussians.means),
        scales: address(&gaussians.scales),
        quaternions: address(&gaussians.quaternions),
        opacities: address(&gaussians.opacities),
        sh: address(&gaussians.sh),
        w2c: address(&cameras.w2c),
        intrinsics: address(&cameras.intrinsics),
        width: cameras.width as i32,
        height: cameras.height as i32,
        eps2d,
        antialiased: gaussians.antialiased,
    }
}
