//! Transforms a splat from one world to another, colors included (spec 2.4).

use crate::scene::{Gaussians, Similarity};
use glam::{DMat3, DQuat};
use globalsplat_splat_file::ShRotation;
use tch::Tensor;

/// Returns the splat with every point x moved to `to(x)`. Images from cameras that are moved along stay the same, and their depth is
/// scaled.
pub fn transform(gaussians: &Gaussians, to: &Similarity) -> Gaussians {
    let on = |t: Tensor, like: &Tensor| t.to_kind(like.kind()).to_device(like.device());
    let rotation =
        on(Tensor::from_slice(&to.rotation.transpose().to_cols_array()).view([3, 3]), &gaussians.means);
    let translation = on(Tensor::from_slice(&to.translation.to_array()), &gaussians.means);
    Gaussians {
        means: gaussians.means.matmul(&rotation.tr()) * to.scale + translation,
        scales: &gaussians.scales * to.scale,
        quaternions: rotate_quaternions(&gaussians.quaternions, DQuat::from_mat3(&to.rotation)),
        opacities: gaussians.opacities.shallow_clone(),
        sh: rotate_sh(&gaussians.sh, &to.rotation),
        antialiased: gaussians.antialiased,
    }
}

/// Returns `by` · q for every quaternion q in [.., 4], (w, x, y, z).
fn rotate_quaternions(quaternions: &Tensor, by: DQuat) -> Tensor {
    let [x, y, z, w] = by.to_array();
    // Left multiplication by a quaternion is linear.
    let matrix = [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w];
    let matrix =
        Tensor::from_slice(&matrix).view([4, 4]).to_kind(quaternions.kind()).to_device(quaternions.device());
    quaternions.matmul(&matrix.tr())
}

/// Returns the coefficients [.., bases, 3] of the functions d ↦ f(Rᵀd), for the coefficients of functions f.
fn rotate_sh(sh: &Tensor, rotation: &DMat3) -> Tensor {
    let bases = sh.size()[sh.dim() - 2];
    let matrix = Tensor::from_slice(ShRotation::new(rotation).rows().as_flattened()).view([16, 16]);
    let matrix = matrix.narrow(0, 0, bases).narrow(1, 0, bases);
    matrix.to_kind(sh.kind()).to_device(sh.device()).matmul(sh)
}
