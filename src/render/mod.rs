//! The differentiable splat op (SPEC section 6), safe and typed.

mod bridge;
mod transform;

pub use transform::transform;

use crate::data::ViewBatch;
use crate::error::Result;
use crate::model::Gaussians;
use crate::scene::{Camera, pose_to_rows};
use bridge::ffi;
use tch::{Kind, Tensor};

/// Pixels² added to the diagonal of every projected covariance.
pub const DEFAULT_EPS2D: f64 = 0.05;

/// Cameras to render from: C for each of B scenes.
#[derive(Debug)]
pub struct Cameras {
    /// World to camera, OpenCV axes, [B, C, 4, 4].
    pub w2c: Tensor,
    /// In pixels of the picture, [B, C, 3, 3].
    pub intrinsics: Tensor,
    /// Picture width in pixels.
    pub width: i64,
    /// Picture height in pixels.
    pub height: i64,
}

impl Cameras {
    /// Those that took the views of `batch`.
    pub fn of(batch: &ViewBatch) -> Self {
        let size = batch.images.size();
        Cameras {
            w2c: batch.w2c.shallow_clone(),
            intrinsics: batch.intrinsics.shallow_clone(),
            width: size[4],
            height: size[3],
        }
    }

    /// One camera of one scene, B = C = 1.
    pub fn single(camera: &Camera) -> Self {
        let matrix = |rows: &[f64], n: i64| Tensor::from_slice(rows).view([1, 1, n, n]).to_kind(Kind::Float);
        Cameras {
            w2c: matrix(&pose_to_rows(&camera.c2w.inverse()), 4),
            intrinsics: matrix(&camera.intrinsics.to_rows(), 3),
            width: i64::from(camera.width),
            height: i64::from(camera.height),
        }
    }
}

/// What the cameras see.
#[derive(Debug)]
pub struct Pictures {
    /// Colour over black, [B, C, 3, H, W]; not clamped above.
    pub rgb: Tensor,
    /// Accumulated opacity in [0, 1], [B, C, H, W].
    pub alpha: Tensor,
    /// Expected camera depth, [B, C, H, W]; 0 where nothing is seen.
    pub depth: Tensor,
}

/// Renders every scene from its cameras. Differentiable with respect to the Gaussians; float64 tensors are rendered in
/// float64, all others in float32. Tensors on a GPU are moved to the host and the pictures back.
///
/// # Errors
/// Shapes that don't fit together, and a `GLOBALSPLAT_SIMD` that this machine doesn't have.
pub fn render(gaussians: &Gaussians, cameras: &Cameras, eps2d: f64) -> Result<Pictures> {
    let address = |t: &Tensor| t.as_ptr() as usize;
    let mut out = [0usize; 3];
    // The tensors outlive the call, which only borrows them.
    ffi::splat(
        address(&gaussians.means),
        address(&gaussians.scales),
        address(&gaussians.quaternions),
        address(&gaussians.opacities),
        address(&gaussians.sh),
        address(&cameras.w2c),
        address(&cameras.intrinsics),
        cameras.width as i32,
        cameras.height as i32,
        eps2d,
        &mut out,
    )?;
    // SAFETY: on success the C++ side has put three new tensors there and left them to us.
    let [rgb, alpha, depth] = out.map(|p| unsafe { Tensor::from_ptr(p as *mut torch_sys::C_tensor) });
    Ok(Pictures { rgb, alpha, depth })
}

/// The instruction set of the rasterizer's kernels: `avx512`, `avx2`, `neon` or `portable`.
///
/// # Errors
/// A `GLOBALSPLAT_SIMD` that names one which this machine doesn't have.
pub fn simd_level() -> Result<String> {
    Ok(ffi::simd_level()?)
}

/// The version of the libtorch that this program was built with.
pub fn libtorch_version() -> String {
    ffi::libtorch_version()
}
