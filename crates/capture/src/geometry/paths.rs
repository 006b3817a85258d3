//! Camera paths: orbits, and a smooth path through given views.
//!
//! # The smooth path
//!
//! The parameters of a camera other than its rotation form a point x in seven dimensions, each a length: the position, and Z·ln f
//! and Z·c/f along both axes of the image, where Z is the distance of the scene. A step from one camera to the next, which turns by
//! the angle θ, has the length
//!
//! ```text
//! d = √(|Δx|² + Z²θ²),
//! ```
//!
//! so that translation, rotation and zoom count by how far they move the image. Between the cameras, x is a Catmull–Rom spline (Catmull, Rom:
//! A class of local interpolating splines, 1974), evaluated by repeated linear interpolation (Barry, Goldman: A recursive evaluation algorithm
//! for a class of Catmull–Rom splines, 1988). The rotation goes through the same interpolations, each along the shorter arc (Schlag: Using
//! geometric constructions to interpolate orientation with quaternions, 1991). Knots are √d apart: the centripetal parametrization, which neither
//! loops nor overshoots if views are unevenly spaced (Yuksel, Schaefer, Keyser: Parameterization and applications of Catmull–Rom curves, 2011).
//!
//! The curve passes through every view with continuous velocity. Frames are equally spaced by the length d.

use super::camera::{Camera, ImageSize, Intrinsics, look_at};
use super::normalize;
use glam::{DMat4, DQuat, DVec3};
use globalsplat_files::{Error, Result};
use std::f64::consts::TAU;

/// Minimum length of a step relative to the whole path. A view at a shorter distance counts as equal to the previous one.
const SAME: f64 = 1e-9;

/// Number of chords of a step that its length is measured with.
const PIECES: usize = 256;

/// Point in seven dimensions: position, Z·ln fx, Z·ln fy, Z·cx/fx, Z·cy/fy.
type Point = [f64; 7];

/// Returns `frames` cameras on a smooth path through `cameras`, in their order, from the first to the last, at constant speed.
/// `distance` is the distance of the scene: a rotation by θ counts as much as a translation by θ·`distance`. Images have the first
/// camera's size.
///
/// # Errors
/// Fails if there are no cameras.
pub fn smooth_path(cameras: &[Camera], distance: f64, frames: usize) -> Result<Vec<Camera>> {
    let first = cameras.first().ok_or_else(|| Error::request("a path needs a camera"))?;
    let size = ImageSize { width: first.width, height: first.height };
    let views: Vec<View> = cameras.iter().map(|camera| View::of(&camera.with_size(size), distance)).collect();
    let curve = Curve::through(views, distance);
    let last = frames.max(2) - 1;
    Ok((0..frames).map(|i| curve.at(i as f64 / last as f64).camera(size, distance)).collect())
}

/// A camera split into the point x and the rotation.
#[derive(Debug, Clone, Copy)]
struct View {
    point: Point,
    rotation: DQuat,
}

impl View {
    fn of(camera: &Camera, distance: f64) -> Self {
        let (k, [x, y, z]) = (camera.intrinsics, camera.c2w.w_axis.truncate().to_array());
        let lens = [k.fx.ln(), k.fy.ln(), k.cx / k.fx, k.cy / k.fy].map(|value| value * distance);
        let point = [x, y, z, lens[0], lens[1], lens[2], lens[3]];
        View { point, rotation: DQuat::from_mat4(&camera.c2w).normalize() }
    }

    fn camera(&self, ImageSize { width, height }: ImageSize, distance: f64) -> Camera {
        let [x, y, z, lens @ ..] = self.point;
        let [fx, fy, cx, cy] = lens.map(|value| value / distance);
        let (fx, fy) = (fx.exp(), fy.exp());
        let intrinsics = Intrinsics { fx, fy, cx: cx * fx, cy: cy * fy };
        let c2w = DMat4::from_rotation_translation(self.rotation, DVec3::new(x, y, z));
        Camera { intrinsics, c2w, width, height }
    }

    /// Returns the view at the fraction `t` of the way to `other`, or beyond it.
    fn interpolate(&self, other: &View, t: f64) -> View {
        let point = std::array::from_fn(|i| self.point[i] + t * (other.point[i] - self.point[i]));
        let rotation = self.rotation * DQuat::from_scaled_axis(t * turn(self.rotation, other.rotation));
        View { point, rotation: rotation.normalize() }
    }

    /// Returns the length d of a step from this view to `other`.
    fn distance_to(&self, other: &View, distance: f64) -> f64 {
        let way: f64 = self.point.iter().zip(&other.point).map(|(a, b)| (b - a).powi(2)).sum();
        (way + (distance * turn(self.rotation, other.rotation).length()).powi(2)).sqrt()
    }
}

/// Returns the rotation from `a` to `b` in the axes of `a`, as axis times angle, the shorter way around. A quaternion and its
/// negative are the same rotation.
fn turn(a: DQuat, b: DQuat) -> DVec3 {
    let turn = a.conjugate() * b;
    (if turn.w < 0. { -turn } else { turn }).normalize().to_scaled_axis()
}

/// The whole path.
struct Curve {
    /// The views, with one more before the first and after the last, which continue the first and the last step backward and forward.
    views: Vec<View>,
    /// Curve parameter of each of `views`.
    knots: Vec<f64>,
    /// Path length up to the end of each of the [`PIECES`] pieces of each step.
    lengths: Vec<f64>,
}

impl Curve {
    fn through(mut views: Vec<View>, distance: f64) -> Self {
        let apart = |views: &[View]| -> Vec<f64> {
            views.windows(2).map(|pair| pair[0].distance_to(&pair[1], distance)).collect()
        };
        let least = SAME * apart(&views).iter().sum::<f64>();
        views.dedup_by(|next, view| view.distance_to(next, distance) <= least);
        if let [first, second, ..] = views[..] {
            let [.., before, last] = views[..] else { unreachable!("two views or more") };
            views.insert(0, first.interpolate(&second, -1.));
            views.push(before.interpolate(&last, 2.));
        }
        let mut knots = vec![0.];
        knots.extend(apart(&views).iter().scan(0., |knot, distance| {
            *knot += distance.sqrt();
            Some(*knot)
        }));
        let mut curve = Curve { views, knots, lengths: vec![] };
        let (mut length, mut before) = (0., curve.view_at(0, 0.));
        for step in 0..curve.steps() {
            for piece in 1..=PIECES {
                let view = curve.view_at(step, piece as f64 / PIECES as f64);
                length += before.distance_to(&view, distance);
                curve.lengths.push(length);
                before = view;
            }
        }
        curve
    }

    /// Returns the number of steps from one view to the next.
    fn steps(&self) -> usize {
        self.views.len().saturating_sub(3)
    }

    /// Returns the view at the fraction `u` of a step.
    fn view_at(&self, step: usize, u: f64) -> View {
        let Some(&[p, q, r, s]) = self.views[step..].first_chunk::<4>() else { return self.views[0] };
        let knots = &self.knots[step..];
        let t = knots[1] + u * (knots[2] - knots[1]);
        // Returns the view at t between views at two of the knots.
        let between =
            |a: View, b: View, i: usize, j: usize| a.interpolate(&b, (t - knots[i]) / (knots[j] - knots[i]));
        let (p, q, r) = (between(p, q, 0, 1), between(q, r, 1, 2), between(r, s, 2, 3));
        between(between(p, q, 0, 2), between(q, r, 1, 3), 1, 2)
    }

    /// Returns the view at the fraction `share` of the path length.
    fn at(&self, share: f64) -> View {
        let Some(whole) = self.lengths.last() else { return self.views[0] };
        let wanted = share * whole;
        let piece = self.lengths.partition_point(|&length| length < wanted).min(self.lengths.len() - 1);
        let begins = if piece == 0 { 0. } else { self.lengths[piece - 1] };
        let inside = (wanted - begins) / (self.lengths[piece] - begins).max(f64::MIN_POSITIVE);
        let u = ((piece % PIECES) as f64 + inside) / PIECES as f64;
        self.view_at(piece / PIECES, u.min(1.))
    }
}

/// Returns `frames` cameras on an ellipse around the mean of `cameras`, as wide and high as their own spread. All look at the point
/// at `distance` in front of the mean camera. It suits captures taken by walking, because the path stays close to the photos.
///
/// # Errors
/// Fails if there are no cameras.
pub fn orbit_around_cameras(cameras: &[Camera], distance: f64, frames: usize) -> Result<Vec<Camera>> {
    let poses: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
    let normalization = normalize(&poses)?;
    let to_world = normalization.world_from_normalized;
    let spread = |axis: usize| {
        let n = poses.len() as f64;
        (normalization.c2w.iter().map(|pose| pose.w_axis[axis].powi(2)).sum::<f64>() / n).sqrt()
            * to_world.scale
    };
    // At least a tenth of the distance to the target, so that cameras that only moved forward still give an orbit.
    let (x, y) = (spread(0).max(0.1 * distance), spread(1).max(0.05 * distance));
    let [right, down, forward] =
        [to_world.rotation.x_axis, to_world.rotation.y_axis, to_world.rotation.z_axis];
    let target = to_world.translation + forward * distance;
    let reference = cameras.first().ok_or_else(|| Error::request("an orbit needs a camera"))?;
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = to_world.translation + right * (x * angle.cos()) + down * (y * angle.sin());
        Camera { c2w: look_at(eye, target, down), ..*reference }
    };
    Ok((0..frames).map(camera).collect())
}

/// Returns `frames` cameras on a circle of `radius` around `target`, slightly above it (y points down). Everything but the pose is
/// copied from `reference`.
pub fn orbit_around_point(target: DVec3, radius: f64, reference: &Camera, frames: usize) -> Vec<Camera> {
    let camera = |frame: usize| {
        let angle = TAU * frame as f64 / frames as f64;
        let eye = target + radius * DVec3::new(angle.sin(), -0.3, -angle.cos());
        Camera { c2w: look_at(eye, target, DVec3::Y), ..*reference }
    };
    (0..frames).map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, EulerRot};
    use std::f64::consts::PI;

    const DISTANCE: f64 = 3.;

    fn camera(position: [f64; 3], rotation: DQuat, focal: f64) -> Camera {
        let intrinsics = Intrinsics { fx: focal, fy: 1.1 * focal, cx: 30., cy: 25. + focal / 50. };
        let c2w = DMat4::from_rotation_translation(rotation, DVec3::from_array(position));
        Camera { intrinsics, c2w, width: 64, height: 48 }
    }

    /// Returns unevenly spaced cameras that turn in all directions and zoom.
    fn cameras() -> Vec<Camera> {
        let turned = |x, y, z| DQuat::from_euler(EulerRot::XYZ, x, y, z);
        vec![
            camera([0., 0., 0.], turned(0., 0., 0.), 60.),
            camera([1., 0.2, 0.1], turned(0.3, -0.2, 0.), 60.),
            camera([1.01, 0.2, 0.1], turned(0.3, -0.25, 0.1), 61.),
            camera([4., -1., 2.], turned(1.2, 0.9, -0.4), 90.),
            camera([4., 1., 2.], turned(-0.4, 2.5, 0.3), 120.),
            camera([3., 1., 2.], turned(-0.4, 2.5, 2.), 50.),
        ]
    }

    fn apart(a: &Camera, b: &Camera) -> f64 {
        View::of(a, DISTANCE).distance_to(&View::of(b, DISTANCE), DISTANCE)
    }

    fn assert_rigid(path: &[Camera]) {
        for camera in path {
            let rotation = DMat3::from_mat4(camera.c2w);
            let gram = rotation.transpose() * rotation;
            assert!(gram.abs_diff_eq(DMat3::IDENTITY, 1e-12) && rotation.determinant() > 0., "{gram}");
            assert!(camera.intrinsics.check(camera.width, camera.height).is_ok(), "{camera:?}");
        }
    }

    #[test]
    fn the_path_goes_through_every_camera() {
        let (cameras, frames) = (cameras(), 2001);
        let path = smooth_path(&cameras, DISTANCE, frames).unwrap();
        assert_eq!(path.len(), frames);
        assert_rigid(&path);
        let mut at = 0;
        let step = apart(&path[500], &path[501]);
        for camera in &cameras {
            // The cameras are reached in their order.
            let rest = path[at..].iter().map(|frame| apart(frame, camera)).enumerate();
            let (next, nearest) = rest.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            assert!(nearest <= 0.51 * step, "{nearest} of a step of {step}");
            at += next;
        }
        for (frame, camera) in [(&path[0], &cameras[0]), (&path[frames - 1], &cameras[5])] {
            assert!(frame.c2w.abs_diff_eq(camera.c2w, 1e-9), "{} {}", frame.c2w, camera.c2w);
            let both = frame.intrinsics.to_rows().into_iter().zip(camera.intrinsics.to_rows());
            both.for_each(|(a, b)| assert!((a - b).abs() < 1e-9));
        }
    }

    #[test]
    fn the_path_has_no_kinks() {
        const SMALL: f64 = 1e-6;
        let views = cameras().iter().map(|camera| View::of(camera, DISTANCE)).collect();
        let curve = Curve::through(views, DISTANCE);
        assert_eq!(curve.steps(), 5);
        for step in 1..5 {
            // Velocities by the curve parameter, before and after the view between two steps.
            let velocity = |step: usize, from: f64| -> Vec<f64> {
                let h = SMALL * (curve.knots[step + 2] - curve.knots[step + 1]);
                let (a, b) = (curve.view_at(step, from), curve.view_at(step, from + SMALL));
                let moved = a.point.iter().zip(b.point).map(|(a, b)| b - a);
                moved.chain(turn(a.rotation, b.rotation).to_array()).map(|change| change / h).collect()
            };
            for (a, b) in velocity(step - 1, 1. - SMALL).into_iter().zip(velocity(step, 0.)) {
                assert!((a - b).abs() < 1e-4 * (1. + b.abs()), "{a} and {b} at the end of step {step}");
            }
        }
        // The speed is constant, except that chords are shorter than their arcs.
        let path = smooth_path(&cameras(), DISTANCE, 10_001).unwrap();
        let steps: Vec<f64> = path.windows(2).map(|pair| apart(&pair[0], &pair[1])).collect();
        let mean = steps.iter().sum::<f64>() / steps.len() as f64;
        let off = steps.iter().map(|step| (step / mean - 1.).abs()).fold(0., f64::max);
        assert!(off < 0.03, "{off}");
    }

    #[test]
    fn two_cameras_are_joined_by_the_shortest_way() {
        let [a, b] = [cameras()[0], cameras()[3]];
        let (from, to) = (View::of(&a, DISTANCE), View::of(&b, DISTANCE));
        for (i, frame) in smooth_path(&[a, b], DISTANCE, 5).unwrap().iter().enumerate() {
            let share = i as f64 / 4.;
            assert!(frame.c2w.w_axis.abs_diff_eq(a.c2w.w_axis.lerp(b.c2w.w_axis, share), 1e-9), "{i}");
            let rotation = View::of(frame, DISTANCE).rotation;
            assert!(turn(rotation, from.rotation.slerp(to.rotation, share)).length() < 1e-7, "{i}");
            // A zoom interpolates the focal length geometrically.
            let focal = a.intrinsics.fx * (b.intrinsics.fx / a.intrinsics.fx).powf(share);
            assert!((frame.intrinsics.fx - focal).abs() < 1e-9);
        }
    }

    #[test]
    fn one_camera_stands_still_and_none_is_refused() {
        let one = cameras()[4];
        for cameras in [&[one][..], &[one, one, one]] {
            let path = smooth_path(cameras, DISTANCE, 3).unwrap();
            assert_eq!(path.len(), 3);
            assert!(path.iter().all(|frame| frame.c2w.abs_diff_eq(one.c2w, 1e-12)));
        }
        assert_eq!(smooth_path(&cameras(), DISTANCE, 1).unwrap().len(), 1);
        assert!(smooth_path(&[], DISTANCE, 3).is_err());
    }

    #[test]
    fn cameras_that_stand_turn_and_zoom() {
        let turned = |angle| camera([1., 2., 3.], DQuat::from_rotation_y(angle), 60.);
        // One of the views occurs twice.
        let path = smooth_path(&[turned(0.), turned(0.5), turned(0.5), turned(1.5)], DISTANCE, 101).unwrap();
        assert_rigid(&path);
        for pair in path.windows(2) {
            assert!(pair[0].c2w.w_axis.abs_diff_eq(pair[1].c2w.w_axis, 1e-12));
            let turn = turn(View::of(&pair[0], 1.).rotation, View::of(&pair[1], 1.).rotation);
            assert!((turn - DVec3::Y * 0.015).length() < 1e-4, "{turn}");
        }
        let zoom = |focal| camera([0.; 3], DQuat::IDENTITY, focal);
        let path = smooth_path(&[zoom(50.), zoom(60.), zoom(200.)], DISTANCE, 51).unwrap();
        assert!(path.windows(2).all(|pair| pair[1].intrinsics.fx > pair[0].intrinsics.fx));
    }

    #[test]
    fn a_quaternion_and_its_negative_are_one_rotation() {
        let views: Vec<View> = cameras().iter().map(|camera| View::of(camera, DISTANCE)).collect();
        let mut negated = views.clone();
        negated.iter_mut().step_by(2).for_each(|view| view.rotation = -view.rotation);
        let [a, b] = [views, negated].map(|views| Curve::through(views, DISTANCE));
        assert!((0..=8).map(|i| f64::from(i) / 8.).all(|t| a.at(t).distance_to(&b.at(t), DISTANCE) < 1e-9));
    }

    #[test]
    fn half_turns_add_no_extra_rotation() {
        for angle in [PI - 1e-3, PI - 1e-9, PI, PI + 1e-9, PI + 1e-3] {
            let turned =
                |i: u32| camera([f64::from(i), 0., 0.], DQuat::from_rotation_y(angle * f64::from(i)), 60.);
            let cameras: Vec<Camera> = (0..4).map(turned).collect();
            let path = smooth_path(&cameras, DISTANCE, 601).unwrap();
            assert_rigid(&path);
            let rotations: Vec<DQuat> = path.iter().map(|frame| View::of(frame, DISTANCE).rotation).collect();
            let whole: f64 = rotations.windows(2).map(|pair| turn(pair[0], pair[1]).length()).sum();
            assert!(whole < 1.5 * 3. * PI, "{angle}: it turns by {whole}");
            assert!((apart(&path[600], &cameras[3])) < 1e-6);
        }
    }
}
