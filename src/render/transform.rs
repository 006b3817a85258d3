//! Transforms a splat from one world to another, colours included (spec 2.4).

use crate::scene::{Gaussians, Similarity};
use glam::{DMat3, DQuat, DVec3};
use globalsplat_csrc::render::sh_basis;
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

/// Rotates spherical harmonics: returns the coefficients [.., bases, 3] of the functions d ↦ f(Rᵀd).
///
/// A rotation mixes the 2l + 1 functions of one degree among themselves. For directions dᵢ, with A = Y(dᵢ) and B = Y(R dᵢ), the new
/// coefficients c' satisfy B c' = A c, so c' = B⁺A c. More directions than functions make B well conditioned.
fn rotate_sh(sh: &Tensor, rotation: &DMat3) -> Tensor {
    const DIRECTIONS: usize = 32;
    let bases = sh.size()[sh.dim() - 2] as usize;
    let evaluate = |rotation: &DMat3| {
        let mut values = vec![0.; DIRECTIONS * bases];
        for (i, row) in values.chunks_exact_mut(bases).enumerate() {
            sh_basis(&(*rotation * fibonacci_direction(i, DIRECTIONS)).to_array(), row);
        }
        Tensor::from_slice(&values).view([DIRECTIONS as i64, bases as i64])
    };
    let (before, after) = (evaluate(&DMat3::IDENTITY), evaluate(rotation));
    let parts: Vec<Tensor> = (0i64..)
        .map(|degree| (degree * degree, 2 * degree + 1))
        .take_while(|(start, _)| *start < bases as i64)
        .map(|(start, count)| {
            let (a, b) = (before.narrow(1, start, count), after.narrow(1, start, count));
            let mixing = b.linalg_pinv(1e-12, false).matmul(&a);
            mixing.to_kind(sh.kind()).to_device(sh.device()).matmul(&sh.narrow(-2, start, count))
        })
        .collect();
    Tensor::cat(&parts, -2)
}

/// Returns the `i`th of `count` directions that are spread evenly over the sphere.
fn fibonacci_direction(i: usize, count: usize) -> DVec3 {
    let golden_angle = std::f64::consts::PI * (3. - 5f64.sqrt());
    let z = 1. - (2 * i + 1) as f64 / count as f64;
    let (sin, cos) = (golden_angle * i as f64).sin_cos();
    let radius = (1. - z * z).sqrt();
    DVec3::new(radius * cos, radius * sin, z)
}
