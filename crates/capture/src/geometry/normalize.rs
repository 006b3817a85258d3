//! Scene normalization (spec 2.1 and 2.2): one similarity per scene gives all scenes the same position, orientation and size.

use glam::{DMat3, DMat4, DVec3};
use globalsplat_files::{Error, Result};

/// Relative rounding error of float64. If the spread of the cameras is at most this share of the largest coordinate (or not
/// finite), they differ by rounding alone, and the scene keeps its size.
const ROUNDING: f64 = 1e-14;

/// Minimum length of a sum of unit vectors that still defines a direction.
const MIN_DIRECTION: f64 = 1e-6;

/// A similarity transform x ↦ scale · rotation · x + translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Rotation matrix.
    pub rotation: DMat3,
    /// Translation, applied last.
    pub translation: DVec3,
    /// Uniform scale factor, above 0.
    pub scale: f64,
}

impl Similarity {
    /// Returns the transformed `point`.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }
}

/// Result of [`normalize`].
#[derive(Debug, Clone)]
pub struct Normalization {
    /// Camera-to-world poses in the normalized world, in the order of the input.
    pub c2w: Vec<DMat4>,
    /// Similarity from the normalized world to the capture's world. Its scale is the largest distance between two camera centers in
    /// the capture.
    pub world_from_normalized: Similarity,
}

/// Moves the mean camera to the origin, looking along z, and scales the largest distance between two camera centers to 1. If the
/// viewing directions cancel out, as for cameras all around an object, the axes of the first camera are used instead.
///
/// # Errors
/// Fails if there are no cameras.
pub fn normalize(c2w: &[DMat4]) -> Result<Normalization> {
    if c2w.is_empty() {
        return Err(Error::request("a scene without cameras can't be normalized"));
    }
    let mean =
        |column: usize| c2w.iter().map(|pose| pose.col(column).truncate()).sum::<DVec3>() / c2w.len() as f64;
    let direction = |v: DVec3| (v.length() > MIN_DIRECTION).then(|| v.normalize());
    let axes = direction(mean(2)).and_then(|forward| {
        let right = direction(mean(1).cross(forward))?;
        Some(DMat3::from_cols(right, forward.cross(right).normalize(), forward))
    });
    let axes = axes.unwrap_or_else(|| DMat3::from_mat4(c2w[0]));

    let (origin, inverse) = (mean(3), axes.inverse());
    let center = |pose: &DMat4| pose.w_axis.truncate();
    // Subtract the origin before multiplying: far from the world's origin, products would lose the digits in which centers differ.
    let align = |pose: &DMat4| {
        DMat4::from_mat3_translation(inverse * DMat3::from_mat4(*pose), inverse * (center(pose) - origin))
    };
    let aligned: Vec<DMat4> = c2w.iter().map(align).collect();
    let mut scale = 0f64;
    for (i, a) in aligned.iter().enumerate() {
        for b in &aligned[..i] {
            scale = scale.max(center(a).distance(center(b)));
        }
    }
    let largest = c2w.iter().map(|pose| center(pose).abs().max_element()).fold(0., f64::max);
    if !(scale > ROUNDING * largest && scale.is_finite()) {
        scale = 1.;
    }
    let c2w = aligned
        .into_iter()
        .map(|mut pose| {
            pose.w_axis = (center(&pose) / scale).extend(1.);
            pose
        })
        .collect();
    let world_from_normalized = Similarity { rotation: axes, translation: origin, scale };
    Ok(Normalization { c2w, world_from_normalized })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn cameras_all_around_a_thing_have_the_first_ones_axes() {
        for (count, tilt) in [(2, 0.), (8, 0.), (8, 0.6)] {
            // The cameras look at the origin, horizontally or from above.
            let ring: Vec<DMat4> = (0..count)
                .map(|i| {
                    DMat4::from_rotation_y(0.3 + TAU * f64::from(i) / f64::from(count))
                        * DMat4::from_rotation_x(tilt)
                        * DMat4::from_translation(DVec3::NEG_Z)
                })
                .collect();
            let Normalization { c2w, world_from_normalized } = normalize(&ring).unwrap();
            assert!(DMat3::from_mat4(c2w[0]).abs_diff_eq(DMat3::IDENTITY, 1e-12), "{count}, {tilt}");
            assert!(world_from_normalized.translation.with_y(0.).length() < 1e-12);
            for (pose, before) in c2w.iter().zip(&ring) {
                let Similarity { rotation, translation, scale } = world_from_normalized;
                let (center, turned) = (pose.w_axis.truncate(), rotation * DMat3::from_mat4(*pose));
                let back = DMat4::from_mat3_translation(turned, scale * (rotation * center) + translation);
                assert!(back.abs_diff_eq(*before, 1e-12));
            }
        }
    }

    /// Normalized cameras are the same in millimetres, kilometres or UTM coordinates, and bit-identical if the scene is scaled by a
    /// power of two.
    #[test]
    fn unit_and_origin_do_not_matter() {
        let pose =
            |x: f64| DMat4::from_translation(DVec3::new(x, 0.3 * x * x, 0.1)) * DMat4::from_rotation_y(x);
        let moved = |factor: f64, offset: DVec3| -> Vec<DMat4> {
            let place =
                |pose: DMat4| DMat4 { w_axis: (pose.w_axis.truncate() * factor + offset).extend(1.), ..pose };
            [0., 0.1, 0.5, 0.7].map(|x| place(pose(x))).into()
        };
        let plain = normalize(&moved(1., DVec3::ZERO)).unwrap();
        for exponent in [-60, -20, -3, 5, 20, 60] {
            let factor = f64::from(exponent).exp2();
            let other = normalize(&moved(factor, DVec3::ZERO)).unwrap();
            assert_eq!(other.c2w, plain.c2w, "2^{exponent}");
            let (a, b) = (other.world_from_normalized, plain.world_from_normalized);
            assert_eq!((a.translation, a.scale), (b.translation * factor, b.scale * factor));
        }
        for (factor, offset) in
            [(1e-6, DVec3::ZERO), (1e-13, DVec3::ZERO), (1e6, DVec3::ONE), (1., DVec3::splat(1e8))]
        {
            let other = normalize(&moved(factor, offset)).unwrap();
            for (a, b) in other.c2w.iter().zip(&plain.c2w) {
                assert!(a.abs_diff_eq(*b, 1e-6), "{factor} {offset}: {a} {b}");
            }
        }
        let still = normalize(&[DMat4::from_translation(DVec3::splat(1e8)); 3]).unwrap();
        assert_eq!(still.world_from_normalized.scale, 1.);
    }
}
