//! Quaternions of any length: one of length 0 has no rotation, and one whose length is far from 1 overflows when it is squared.

use crate::Splat;
use std::borrow::Cow;
use std::f64::consts::SQRT_2;

/// Lengths of quaternions that are kept.
const LENGTHS: std::ops::Range<f64> = 1e-3..1e3;

/// Returns the Gaussians that have a rotation, and the number of those left out: Gaussians whose quaternion is 0 or subnormal, which the
/// rasterizer doesn't draw (spec 6.2). Quaternions whose length is far from 1 are normalized.
pub(crate) fn drop_missing_rotations(splat: &Splat) -> (Cow<'_, Splat>, usize) {
    let has_rotation = |&index: &usize| {
        splat.quaternions[index].iter().any(|part| part.is_nan() || part.abs() >= f32::MIN_POSITIVE)
    };
    let kept: Vec<usize> = (0..splat.len()).filter(has_rotation).collect();
    let left_out = splat.len() - kept.len();
    let mut rotated = if left_out > 0 { Cow::Owned(splat.select(&kept)) } else { Cow::Borrowed(splat) };
    let is_far = |quaternion: &[f32; 4]| !LENGTHS.contains(&length(quaternion));
    if rotated.quaternions.iter().any(is_far) {
        let quaternions = rotated.to_mut().quaternions.iter_mut().filter(|quaternion| is_far(quaternion));
        quaternions.for_each(|quaternion| *quaternion = normalized(*quaternion));
    }
    (rotated, left_out)
}

fn length(quaternion: &[f32; 4]) -> f64 {
    quaternion.iter().map(|&part| f64::from(part).powi(2)).sum::<f64>().sqrt()
}

/// Normalizes a quaternion to length 1; a quaternion of length 0 is unchanged.
pub(crate) fn normalized(quaternion: [f32; 4]) -> [f32; 4] {
    match length(&quaternion) {
        0. => quaternion,
        length => quaternion.map(|part| (f64::from(part) / length) as f32),
    }
}

/// Returns the index of the component with the largest magnitude of a unit quaternion, and the other three components mapped from
/// [−√½, √½] to [0, 1]. If the largest one is negative, those of the negative quaternion, which is the same rotation.
pub(crate) fn smallest_three(quaternion: [f32; 4]) -> (usize, [f64; 3]) {
    let larger = |a: &usize, b: &usize| quaternion[*a].abs().total_cmp(&quaternion[*b].abs());
    let largest = (0..4).rev().max_by(larger).expect("four components");
    let sign = f64::from(quaternion[largest].signum());
    let mut others = (0..4).filter(|&index| index != largest);
    let fractions = [(); 3].map(|()| {
        let index = others.next().expect("three others");
        sign * f64::from(quaternion[index]) / SQRT_2 + 0.5
    });
    (largest, fractions)
}

/// Returns the unit quaternion of which [`smallest_three`] returned the index and the fractions.
pub(crate) fn from_smallest_three(largest: usize, fractions: [f64; 3]) -> [f32; 4] {
    let others = fractions.map(|fraction| (fraction - 0.5) * SQRT_2);
    let rest = 1. - others.iter().map(|other| other * other).sum::<f64>();
    let mut quaternion = others.to_vec();
    quaternion.insert(largest, rest.max(0.).sqrt());
    normalized(std::array::from_fn(|index| quaternion[index] as f32))
}
