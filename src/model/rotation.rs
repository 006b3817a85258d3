//! Differentiable rotations from six values (Zhou et al. 2019; spec 5.6).

use tch::{Kind, Tensor};

/// Minimum norm that vectors are divided by.
const EPS: f64 = 1e-8;

/// Divides each vector along the last dimension by its length, clamped to at least 1e-8.
pub(super) fn normalize(xs: &Tensor) -> Tensor {
    xs / xs.norm_scalaropt_dim(2, [-1i64], true).clamp_min(EPS)
}

/// Computes rotation matrices, [.., 3, 3], from `rotations` [.., 6]. b1 = normalize(first), b2 = normalize(second − (b1·second) b1), b3 =
/// b1 × b2 are the ROWS of the result.
pub fn rotation_matrix_from_6d(rotations: &Tensor) -> Tensor {
    let (first, second) = (rotations.narrow(-1, 0, 3), rotations.narrow(-1, 3, 3));
    let b1 = normalize(&first);
    let along = (&b1 * &second).sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>);
    let b2 = normalize(&(second - along * &b1));
    let b3 = b1.linalg_cross(&b2, -1);
    Tensor::stack(&[b1, b2, b3], -2)
}

/// Computes the quaternion (w, x, y, z), w ≥ 0, of [`rotation_matrix_from_6d`]; the result is [.., 4].
///
/// 4 q qᵀ is linear in the matrix, and each of its rows is a multiple of q. The row with the largest diagonal entry (at least 1) is far
/// from zero, so normalizing it loses no precision.
pub fn quaternion_from_6d(rotations: &Tensor) -> Tensor {
    let matrix = rotation_matrix_from_6d(rotations).flatten(-2, -1).unbind(-1);
    let [m00, m01, m02, m10, m11, m12, m20, m21, m22] =
        <[Tensor; 9]>::try_from(matrix).expect("nine entries");
    let rows = [
        [&m00 + &m11 + &m22 + 1., &m21 - &m12, &m02 - &m20, &m10 - &m01],
        [&m21 - &m12, &m00 - &m11 - &m22 + 1., &m10 + &m01, &m02 + &m20],
        [&m02 - &m20, &m10 + &m01, &m11 - &m00 - &m22 + 1., &m12 + &m21],
        [&m10 - &m01, &m20 + &m02, &m21 + &m12, &m22 - &m00 - &m11 + 1.],
    ];
    let rows = rows.map(|row| Tensor::stack(&row, -1));
    let rows = Tensor::stack(&rows, -2); // [.., 4, 4]
    let largest = rows.diagonal(0, -2, -1).argmax(-1, true).unsqueeze(-1); // [.., 1, 1]
    let mut index = largest.size();
    *index.last_mut().expect("a last dimension") = 4;
    let row = rows.gather(-2, &largest.expand(&index, false), false).squeeze_dim(-2);
    let sign = row.narrow(-1, 0, 1).ge(0.).to_kind(row.kind()) * 2. - 1.;
    normalize(&row) * sign
}
