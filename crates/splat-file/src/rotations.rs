//! Quaternions of any length: one of length 0 has no rotation, and one whose length is far from 1 overflows when it is squared.

use crate::Splat;
use std::borrow::Cow;

/// Maximum binary exponent: quaternions whose largest component is within 2^±10 keep their length.
const MAX_EXPONENT: f64 = 10.;

/// Returns the Gaussians that have a rotation, and the number of those left out: Gaussians whose quaternion is 0 or subnormal, which the
/// rasterizer doesn't draw (spec 6.2). Quaternions whose length is far from 1 are brought near it by a power of two.
pub(crate) fn drop_missing_rotations(splat: &Splat) -> (Cow<'_, Splat>, usize) {
    let has_rotation = |quaternion: &[f32; 4]| {
        quaternion.iter().any(|part| part.is_nan() || part.abs() >= f32::MIN_POSITIVE)
    };
    let kept: Vec<usize> =
        (0..splat.len()).filter(|&index| has_rotation(&splat.quaternions[index])).collect();
    let left_out = splat.len() - kept.len();
    let mut rotated = if left_out > 0 { Cow::Owned(splat.select(&kept)) } else { Cow::Borrowed(splat) };
    let exponents: Vec<f64> = rotated.quaternions.iter().map(exponent).collect();
    if exponents.iter().any(|&exponent| is_far(exponent)) {
        for (quaternion, exponent) in rotated.to_mut().quaternions.iter_mut().zip(exponents) {
            if is_far(exponent) {
                *quaternion = quaternion.map(|part| (f64::from(part) * (-exponent).exp2()) as f32);
            }
        }
    }
    (rotated, left_out)
}

/// Returns the binary exponent of the largest component.
fn exponent(quaternion: &[f32; 4]) -> f64 {
    let largest = quaternion.iter().fold(0f32, |largest, part| largest.max(part.abs()));
    f64::from(largest).log2().floor()
}

/// Returns `true` if quaternions with this exponent don't keep their length.
fn is_far(exponent: f64) -> bool {
    exponent.abs() > MAX_EXPONENT
}

/// Normalizes a quaternion to length 1; a quaternion of length 0 is unchanged.
pub(crate) fn normalized(quaternion: [f32; 4]) -> [f32; 4] {
    let length = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum::<f64>().sqrt();
    match length > 0. {
        true => quaternion.map(|part| (f64::from(part) / length) as f32),
        false => quaternion,
    }
}
