//! Moves splats: rotation, uniform scale and translation, spherical harmonics included.

use crate::sh::ShRotation;
use crate::{Error, Result, Splat};
use glam::{DMat3, DMat4, DQuat, DVec3};

/// Maximum difference between a matrix and the nearest similarity transform, relative to its scale. Numbers in files have about six digits.
const TOLERANCE: f64 = 1e-4;

/// Returns the scale and the rotation of a matrix that only rotates, scales uniformly and translates.
fn scale_and_rotation(matrix: &DMat4) -> Result<(f64, DMat3)> {
    let linear = DMat3::from_mat4(*matrix);
    let scale = linear.determinant().cbrt();
    let refuse = |found: String, expected: &str| Err(Error::setting("the matrix", found, expected));
    let is_affine = matrix.row(3).abs_diff_eq(DMat4::IDENTITY.row(3), TOLERANCE);
    if !(matrix.is_finite() && is_affine) {
        let found = format!("{:?}", matrix.transpose().to_cols_array());
        return refuse(found, "finite numbers, and 0, 0, 0, 1 as the last row");
    }
    if !(scale > 0. && scale.is_finite() && (linear * scale.recip()).is_finite()) {
        let found = format!("one of the determinant {}", linear.determinant());
        return refuse(found, "a rotation and a scale above 0, which have a finite determinant above 0");
    }
    let rotation = linear * scale.recip();
    if !(rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, TOLERANCE) {
        let lengths = [rotation.x_axis, rotation.y_axis, rotation.z_axis].map(|axis| axis.length() * scale);
        let found = format!("one whose axes have the lengths {lengths:.6?} or aren't perpendicular");
        return refuse(found, "a rotation, the same scale along all axes and a translation");
    }
    // Removes the rounding errors of the matrix.
    Ok((scale, DMat3::from_quat(DQuat::from_mat3(&rotation).normalize())))
}

impl Splat {
    /// Returns the splat with every point x moved to `matrix` · x. The colors of the moved splat, seen from a camera that is moved along,
    /// are the same. The origin is moved, too, unless it is zero.
    ///
    /// ```
    /// use glam::{DMat4, DVec3};
    /// use globalsplat_splat_file::Splat;
    ///
    /// let ball = Splat::new(0, vec![[1., 0., 0.]], vec![[0.; 3]], vec![[1., 0., 0., 0.]], vec![0.], vec![[0.; 3]])?;
    /// let quarter_turn = DMat4::from_rotation_z(std::f64::consts::FRAC_PI_2);
    /// let turned = ball.transformed(&quarter_turn)?;
    /// assert!((turned.means[0][1] - 1.).abs() < 1e-6);
    /// # Ok::<(), globalsplat_splat_file::Error>(())
    /// ```
    ///
    /// # Errors
    /// Returns an error if the matrix isn't finite, or does more than rotate, scale uniformly and translate.
    pub fn transformed(&self, matrix: &DMat4) -> Result<Self> {
        let (scale, rotation) = scale_and_rotation(matrix)?;
        let move_point = |point: DVec3| scale * (rotation * point) + matrix.w_axis.truncate();
        let has_origin = self.origin != DVec3::ZERO;
        let move_mean = |mean: &[f32; 3]| -> [f32; 3] {
            let mean = DVec3::from_array(mean.map(f64::from));
            let moved = if has_origin { scale * (rotation * mean) } else { move_point(mean) };
            moved.to_array().map(|coordinate| coordinate as f32)
        };
        let turn = DQuat::from_mat3(&rotation);
        let turn_quaternion = |&[w, x, y, z]: &[f32; 4]| -> [f32; 4] {
            let [x, y, z, w] = [x, y, z, w].map(f64::from);
            let turned = turn * DQuat::from_xyzw(x, y, z, w);
            [turned.w, turned.x, turned.y, turned.z].map(|part| part as f32)
        };
        let mut splat = Splat { warnings: vec![], ..self.clone() };
        splat.means = self.means.iter().map(move_mean).collect();
        if scale != 1. {
            let log_scale = scale.ln();
            for value in splat.log_scales.as_flattened_mut() {
                *value = (f64::from(*value) + log_scale) as f32;
            }
            for value in splat.linear_scales.iter_mut().flatten().flatten() {
                *value = (f64::from(*value) * scale) as f32;
            }
        }
        if rotation != DMat3::IDENTITY {
            splat.quaternions = self.quaternions.iter().map(turn_quaternion).collect();
            let bases = splat.bases();
            ShRotation::new(&rotation).apply(splat.sh.chunks_exact_mut(bases));
        }
        if has_origin {
            splat.origin = move_point(self.origin);
        }
        Ok(splat)
    }
}
