//! Eigenvalues of small symmetric matrices.

/// Number of sweeps over all elements, after which the other elements of matrices of up to 4×4 are rounding errors.
const SWEEPS: usize = 12;

/// Returns the eigenvalues of a symmetric matrix in ascending order, each with its eigenvector of length 1, by Jacobi's rotations (Golub
/// and Van Loan, *Matrix Computations*, section 8.5).
pub(super) fn symmetric_eigen<const N: usize>(mut matrix: [[f64; N]; N]) -> [(f64, [f64; N]); N] {
    let mut vectors: [[f64; N]; N] =
        std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for _ in 0..SWEEPS {
        for (p, q) in (0..N).flat_map(|p| (p + 1..N).map(move |q| (p, q))) {
            if matrix[p][q] == 0. {
                continue;
            }
            let cotangent = (matrix[q][q] - matrix[p][p]) / (2. * matrix[p][q]);
            let tangent = cotangent.signum() / (cotangent.abs() + cotangent.hypot(1.));
            let cos = tangent.hypot(1.).recip();
            let rotate = |x: f64, y: f64| (cos * (x - tangent * y), cos * (tangent * x + y));
            for row in &mut matrix {
                (row[p], row[q]) = rotate(row[p], row[q]);
            }
            for k in 0..N {
                (matrix[p][k], matrix[q][k]) = rotate(matrix[p][k], matrix[q][k]);
                (vectors[p][k], vectors[q][k]) = rotate(vectors[p][k], vectors[q][k]);
            }
        }
    }
    let mut pairs = std::array::from_fn(|i| (matrix[i][i], vectors[i]));
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_are_scaled_by_their_eigenvalues() {
        let matrix = [[4., 1., -2., 0.5], [1., 3., 0., 0.], [-2., 0., -5., 7.], [0.5, 0., 7., 1e-3]];
        let pairs = symmetric_eigen(matrix);
        assert!(pairs.windows(2).all(|pair| pair[0].0 < pair[1].0), "{pairs:?}");
        for (value, vector) in pairs {
            let length: f64 = vector.iter().map(|x| x * x).sum();
            assert!((length - 1.).abs() < 1e-12);
            for (row, x) in matrix.iter().zip(vector) {
                let product: f64 = row.iter().zip(vector).map(|(a, b)| a * b).sum();
                assert!((product - value * x).abs() < 1e-12, "{pairs:?}");
            }
        }
        // Equal eigenvalues, and none.
        assert_eq!(symmetric_eigen([[2., 0.], [0., 2.]]).map(|pair| pair.0), [2., 2.]);
        assert_eq!(symmetric_eigen([[0.; 3]; 3]).map(|pair| pair.0), [0.; 3]);
    }
}
