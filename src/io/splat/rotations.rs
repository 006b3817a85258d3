//! Quaternions of any length: one of length 0 has no rotation, and one whose length is far from 1 overflows when it is squared.

use crate::scene::Gaussians;
use tch::{Kind, Tensor};

/// Maximum binary exponent: quaternions whose largest component is within 2^±10 keep their length.
const MAX_EXPONENT: f64 = 10.;

/// Returns the Gaussians that have a rotation, and the number of those left out: Gaussians whose quaternion is 0 or subnormal, which the
/// rasterizer doesn't draw (spec 6.2). Quaternions whose length is far from 1 are brought near it by a power of two.
pub(super) fn with_rotation(gaussians: &Gaussians) -> (Gaussians, i64) {
    let largest_part = |g: &Gaussians| g.quaternions.abs().amax([-1i64].as_slice(), true);
    let absent = largest_part(gaussians).less(f64::from(f32::MIN_POSITIVE)).flatten(0, -1);
    let left_out = absent.sum(Kind::Int64).int64_value(&[]);
    let mut rotated = gaussians.map(Tensor::shallow_clone);
    if left_out > 0 {
        let kept = absent.logical_not().nonzero().flatten(0, -1);
        rotated = rotated.map(|tensor| tensor.index_select(1, &kept));
    }
    let exponents = largest_part(&rotated).to_kind(Kind::Double).log2().floor();
    let is_far = exponents.abs().greater(MAX_EXPONENT);
    if is_far.any().int64_value(&[]) != 0 {
        let powers = (-exponents * is_far).exp2();
        let kind = rotated.quaternions.kind();
        rotated.quaternions = (rotated.quaternions.to_kind(Kind::Double) * powers).to_kind(kind);
    }
    (rotated, left_out)
}
