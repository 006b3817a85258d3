//! Real spherical harmonics up to degree 3, with the signs of 3DGS (spec 6.3), and their rotation.

use glam::{DMat3, DVec3};
use std::f64::consts::PI;

/// Number of spherical harmonics up to degree 3.
const BASES: usize = 16;

/// Returns the values of the spherical harmonics at a direction of length 1, in the order of the coefficients in a splat.
pub fn sh_basis(direction: DVec3) -> [f64; BASES] {
    let [x, y, z] = direction.to_array();
    let (xx, yy, zz) = (x * x, y * y, z * z);
    // √((2l + 1)/4π · …): the constants that make every function's square integrate to 1 over the sphere.
    let norm = |numerator: f64, denominator: f64| (numerator / (denominator * PI)).sqrt();
    [
        norm(1., 4.),
        -norm(3., 4.) * y,
        norm(3., 4.) * z,
        -norm(3., 4.) * x,
        norm(15., 4.) * x * y,
        -norm(15., 4.) * y * z,
        norm(5., 16.) * (2. * zz - xx - yy),
        -norm(15., 4.) * x * z,
        norm(15., 16.) * (xx - yy),
        -norm(35., 32.) * y * (3. * xx - yy),
        norm(105., 4.) * x * y * z,
        -norm(21., 32.) * y * (4. * zz - xx - yy),
        norm(7., 16.) * z * (2. * zz - 3. * xx - 3. * yy),
        -norm(21., 32.) * x * (4. * zz - xx - yy),
        norm(105., 16.) * z * (xx - yy),
        -norm(35., 32.) * x * (xx - 3. * yy),
    ]
}

/// Rotation of spherical harmonics: the matrix that takes the coefficients of a function f of directions to those of d ↦ f(Rᵀd).
///
/// It is D_ij = ∫ Y_i(R e) Y_j(e) de over the sphere, which is zero between functions of different degrees.
pub struct ShRotation([[f64; BASES]; BASES]);

impl ShRotation {
    /// Computes the matrix for a rotation R of directions.
    pub fn new(rotation: &DMat3) -> Self {
        let mut matrix = [[0.; BASES]; BASES];
        for (direction, weight) in quadrature() {
            let (before, after) = (sh_basis(direction), sh_basis(*rotation * direction));
            for (row, after) in matrix.iter_mut().zip(after) {
                for (entry, before) in row.iter_mut().zip(before) {
                    *entry += weight * after * before;
                }
            }
        }
        for (i, row) in matrix.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                if i.isqrt() != j.isqrt() {
                    *entry = 0.; // but for rounding
                }
            }
        }
        ShRotation(matrix)
    }

    /// Returns the rows of the matrix. The upper left `(degree + 1)²` rows and columns rotate harmonics up to a lower degree.
    pub fn rows(&self) -> &[[f64; 16]; 16] {
        &self.0
    }

    /// Rotates the coefficients of each Gaussian in place.
    pub(crate) fn apply<'a>(&self, gaussians: impl Iterator<Item = &'a mut [[f32; 3]]>) {
        for coefficients in gaussians {
            let before: [[f64; 3]; BASES] = std::array::from_fn(|basis| {
                coefficients.get(basis).copied().unwrap_or_default().map(f64::from)
            });
            for (i, after) in coefficients.iter_mut().enumerate().skip(1) {
                let degree = i.isqrt();
                let of_degree = degree * degree..(degree + 1).pow(2);
                *after = std::array::from_fn(|channel| {
                    of_degree.clone().map(|j| self.0[i][j] * before[j][channel]).sum::<f64>() as f32
                });
            }
        }
    }
}

/// Returns directions and weights that integrate polynomials of degree 7 or less exactly over the sphere: four Gauss–Legendre nodes in z,
/// eight equal steps around the axis.
fn quadrature() -> impl Iterator<Item = (DVec3, f64)> {
    const STEPS: usize = 8;
    let root = (6f64 / 5.).sqrt();
    let nodes = [-1., 1.].map(|sign| {
        let z = (3. / 7. + sign * 2. / 7. * root).sqrt();
        (z, (18. - sign * 30f64.sqrt()) / 36.)
    });
    nodes.into_iter().flat_map(|(z, weight)| [(z, weight), (-z, weight)]).flat_map(|(z, weight)| {
        (0..STEPS).map(move |step| {
            let (sin, cos) = (2. * PI * step as f64 / STEPS as f64).sin_cos();
            let radius = (1. - z * z).sqrt();
            (DVec3::new(radius * cos, radius * sin, z), weight * 2. * PI / STEPS as f64)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// A rotated function has the value in a rotated direction that it had before.
    #[test]
    fn rotated_functions_have_the_same_values() {
        let rotation = DMat3::from_quat(DQuat::from_euler(glam::EulerRot::XYZ, 0.4, 1.3, -2.));
        let direction = DVec3::new(0.3, -0.5, 0.8).normalize();
        let value = |coefficients: &[[f32; 3]], direction: DVec3| {
            let terms = coefficients.iter().zip(sh_basis(direction));
            terms.map(|(coefficient, basis)| f64::from(coefficient[1]) * basis).sum::<f64>()
        };
        for bases in [1, 4, 9, 16] {
            let before: Vec<[f32; 3]> =
                (0..bases).map(|basis| [(0.6 * basis as f32 + 0.2).sin(); 3]).collect();
            let mut after = before.clone();
            ShRotation::new(&rotation).apply(after.chunks_exact_mut(bases));
            let difference = value(&after, rotation * direction) - value(&before, direction);
            assert!(difference.abs() < 1e-6, "{bases} bases: {difference}");
        }
    }
}
