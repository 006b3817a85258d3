//! Local frame of a capture or a splat: an origin near the scene and a unit that fits its size.
//!
//! Positions far from the world's origin, or in a unit that is too large or too small for the scene, lose precision in float32 and
//! don't suit absolute thresholds such as the near plane. World coordinates are float64. Only local coordinates are converted to
//! float32.

use super::Camera;
use glam::{DMat4, DVec3};

/// Distances at most this fraction of the largest coordinate are treated as rounding errors.
const MIN_RELATIVE_DISTANCE: f64 = 1e-14;

/// A coordinate frame with the axes of the world: local = (world − origin) / scale.
///
/// If a scene is scaled by a power of two, the origin and scale of its frame are scaled exactly, so that local coordinates are
/// bit-identical.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalFrame {
    /// Local origin, in world coordinates.
    pub origin: DVec3,
    /// Length of a local unit in world units, above 0.
    pub scale: f64,
}

impl LocalFrame {
    /// Typical distance from the origin in local units. The near plane, 0.01 local units (spec 6.2), is 1/1600 of it.
    const TYPICAL_DISTANCE: f64 = 16.;

    /// Returns the frame of a capture, computed from its camera centers. The origin is their median along each axis. A local unit is
    /// 1/16 of the median distance of the cameras from it, without those at the origin. If all cameras are at one position, a local
    /// unit is a world unit.
    pub fn from_cameras(cameras: &[Camera]) -> Self {
        let centers: Vec<DVec3> = cameras.iter().map(|camera| camera.c2w.w_axis.truncate()).collect();
        Self::from_spheres(&centers, &vec![0.; centers.len()])
    }

    /// Returns the frame of spheres with centers `points` and `radii`, in world units and of equal length. The origin is the median
    /// along each axis. A local unit is 1/16 of the median reach, a sphere's distance from the origin plus its radius. It is a world unit
    /// if there are no spheres or they have no extent.
    pub fn from_spheres(points: &[DVec3], radii: &[f64]) -> Self {
        let along = |axis: usize| median(points.iter().map(|point| point[axis]).collect());
        let origin = DVec3::from_array([0, 1, 2].map(|axis| along(axis).unwrap_or(0.)));
        let largest = points.iter().map(|point| point.abs().max_element()).fold(0., f64::max);
        let reaches = points.iter().zip(radii).map(|(point, radius)| point.distance(origin) + radius);
        let typical = median(reaches.filter(|reach| *reach > MIN_RELATIVE_DISTANCE * largest).collect());
        LocalFrame { origin, scale: typical.map_or(1., |typical| typical / Self::TYPICAL_DISTANCE) }
    }

    /// Returns the typical distance of the scene from the origin, in world units.
    pub fn typical_distance(&self) -> f64 {
        Self::TYPICAL_DISTANCE * self.scale
    }

    /// Converts a world point to local coordinates.
    pub fn point_to_local(&self, point: DVec3) -> DVec3 {
        (point - self.origin) / self.scale
    }

    /// Converts a local point to world coordinates.
    pub fn point_to_world(&self, point: DVec3) -> DVec3 {
        self.origin + self.scale * point
    }

    /// Converts a camera in world coordinates to local coordinates. Camera coordinates, and so depths, are then in local units; the
    /// pose stays rigid.
    pub fn camera_to_local(&self, camera: &Camera) -> Camera {
        let w_axis = self.point_to_local(camera.c2w.w_axis.truncate()).extend(1.);
        Camera { c2w: DMat4 { w_axis, ..camera.c2w }, ..*camera }
    }

    /// Converts cameras in world coordinates to local coordinates.
    pub fn cameras_to_local(&self, cameras: &[Camera]) -> Vec<Camera> {
        cameras.iter().map(|camera| self.camera_to_local(camera)).collect()
    }
}

/// Returns the lower median, or `None` if there are no values.
fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Intrinsics;

    fn camera(center: DVec3) -> Camera {
        let intrinsics = Intrinsics { fx: 1., fy: 1., cx: 0.5, cy: 0.5 };
        let c2w = DMat4::from_translation(center) * DMat4::from_rotation_y(0.3);
        Camera { intrinsics, c2w, width: 1, height: 1 }
    }

    fn cameras(factor: f64, offset: DVec3) -> Vec<Camera> {
        let place = |i: f64| DVec3::new(0.7 * i, (0.4 * i).sin(), 0.1 * i * i);
        (0..9).map(|i| camera(place(f64::from(i)) * factor + offset)).collect()
    }

    #[test]
    fn local_coordinates_are_independent_of_origin_and_unit() {
        let plain = cameras(1., DVec3::ZERO);
        let frame = LocalFrame::from_cameras(&plain);
        for (factor, offset, tolerance) in [
            // Powers of two change no bit.
            (0.125, DVec3::ZERO, 0.),
            (2f64.powi(-40), DVec3::ZERO, 0.),
            (2f64.powi(40), DVec3::ZERO, 0.),
            (1e-6, DVec3::ZERO, 1e-6),
            (1e6, DVec3::ZERO, 1e-6),
            (1., DVec3::new(1e8, -3e7, 55.), 1e-6),
        ] {
            let moved = cameras(factor, offset);
            let other = LocalFrame::from_cameras(&moved);
            for (a, b) in plain.iter().zip(&moved) {
                let (a, local) = (frame.camera_to_local(a).c2w, other.camera_to_local(b).c2w);
                assert!(a.abs_diff_eq(local, tolerance), "{factor} {offset}: {a} {local}");
            }
        }
    }

    /// Neither many frames from a resting camera nor a misplaced camera change the unit by a factor of two.
    #[test]
    fn rests_and_outliers_do_not_set_the_scale() {
        let plain = cameras(1., DVec3::ZERO);
        let typical = LocalFrame::from_cameras(&plain).scale;
        let rests = [plain.clone(), vec![plain[4]; 100]].concat();
        let outlier = [plain, vec![camera(DVec3::splat(1e7))]].concat();
        for cameras in [rests, outlier] {
            let scale = LocalFrame::from_cameras(&cameras).scale;
            assert!((0.5..2.).contains(&(scale / typical)), "{scale} {typical}");
        }
    }

    #[test]
    fn cameras_in_one_place_keep_the_unit() {
        let at = DVec3::new(448_265.12, 5_411_920.65, 135.4);
        for cameras in [vec![], vec![camera(at)], vec![camera(at); 5]] {
            let frame = LocalFrame::from_cameras(&cameras);
            assert_eq!(frame.scale, 1.);
            assert_eq!(frame.origin, cameras.first().map_or(DVec3::ZERO, |_| at));
        }
    }
}
