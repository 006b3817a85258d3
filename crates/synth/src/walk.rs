//! Camera paths of synthetic videos: walks, dollies, orbits and flights through free space, with the motion of a hand-held camera.

use super::noise::Noise;
use super::scene_builder::SceneBuilder;
use super::tracer::Tracer;
use glam::{DMat4, DVec3, DVec4, Vec3, vec3};

/// Maximum number of paths that are tried in a scene.
const TRIES: usize = 80;
/// Number of intervals between the positions of a path that are checked for free space.
const CHECKED: usize = 12;
/// Value of [`Path::wide`] for paths past objects.
const WIDE: f32 = 1.8;

/// Space where cameras may be.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSpace {
    /// Minimum corner of the bounding box; `max` is the maximum corner.
    pub min: Vec3,
    pub max: Vec3,
    /// Range of usual heights of a camera above the ground, in metres.
    pub eye_heights: (f32, f32),
    /// Free space that a camera needs around it, in metres.
    pub clearance: f32,
    /// Distance of the walls behind the box's sides in metres, if there are walls.
    pub walls: Option<f32>,
}

/// An object that the video shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct OrbitTarget {
    pub middle: Vec3,
    /// Radius of a ball that roughly encloses the object, in metres.
    pub radius: f32,
    /// Direction away from the wall that the object hangs on, or `None` if it is visible from all sides.
    pub front: Option<Vec3>,
}

/// Camera motion over time, which goes from 0 to 1.
#[derive(Debug, Clone, Copy)]
struct Path {
    start: Vec3,
    /// Point that the camera looks at, at the start; `target_motion` is its motion.
    target: Vec3,
    target_motion: Vec3,
    motion: Vec3,
    /// Angle of the orbit around the target, in radians.
    orbit: f32,
    /// Sideways swing in metres, and its angular frequency.
    swing: (Vec3, f32),
    /// Hand shake: amplitude in metres, and frequency.
    shake: (f32, f32),
    /// Roll angles at the start and at the end.
    roll: (f32, f32),
    /// Minimum mean depth of every image in metres; reduced if paths are hard to find.
    wide: f32,
    noise: Noise,
}

impl Path {
    /// Creates a path that stays at the origin, with the shake of a hand-held camera.
    fn hand_held(builder: &SceneBuilder) -> Self {
        Path {
            start: Vec3::ZERO,
            target: Vec3::ZERO,
            target_motion: Vec3::ZERO,
            motion: Vec3::ZERO,
            orbit: 0.,
            swing: (Vec3::ZERO, 0.),
            shake: (builder.log_uniform(0.002, 0.04), builder.within(2. ..8.)),
            roll: (builder.within(-0.04..0.04), builder.within(-0.04..0.04)),
            wide: WIDE,
            noise: builder.noise(),
        }
    }

    /// Returns the position, viewing direction and roll at `time`.
    fn at(&self, time: f32) -> (Vec3, Vec3, f32) {
        // Ease in and out, because nobody starts at full speed.
        let eased = 0.7 * time + 0.3 * time * time * (3. - 2. * time);
        let target = self.target + eased * self.target_motion;
        let turned = turned(self.start - self.target, self.orbit * eased);
        let (swing, waves) = self.swing;
        let hand = |offset: f32| self.noise.fractal(vec3(self.shake.1 * time + offset, offset, 0.), 3);
        let shaken = self.shake.0 * vec3(hand(0.), hand(40.), hand(80.));
        let position = self.target + turned + eased * self.motion + (waves * eased).sin() * swing + shaken;
        let aim = 0.3 * self.shake.0 * vec3(hand(120.), hand(160.), hand(200.));
        let roll = self.roll.0 + eased * (self.roll.1 - self.roll.0);
        (position, (target - position).normalize_or(Vec3::Z) + aim, roll)
    }
}

/// Returns camera-to-world poses of `frames` images, x right, y down, z forward, or `None` if there is no free path. If there is an
/// orbit_target, most paths orbit it.
pub(super) fn walk(
    builder: &SceneBuilder,
    tracer: &Tracer,
    place: CameraSpace,
    orbit_target: Option<OrbitTarget>,
    frames: usize,
) -> Option<Vec<DMat4>> {
    for attempt in 0..TRIES {
        // Paths get shorter with every attempt.
        let patience = 1. - attempt as f32 / TRIES as f32;
        let path = match orbit_target {
            Some(target) if builder.chance(0.85) => Some(orbit_path(builder, target, place, patience)),
            _ => walk_path(builder, tracer, place, patience),
        };
        if path.is_some_and(|path| is_free(&path, tracer, place, patience)) {
            let last = frames.max(2) - 1;
            return path.map(|path| (0..frames).map(|i| pose(path.at(i as f32 / last as f32))).collect());
        }
    }
    None
}

/// Creates a hand-held path around an object, from a short distance.
fn orbit_path(builder: &SceneBuilder, orbit_target: OrbitTarget, place: CameraSpace, patience: f32) -> Path {
    let OrbitTarget { middle, radius, front } = orbit_target;
    let away = 1.2 * radius + builder.log_uniform(0.3, 2.);
    let height = (middle.y + builder.within(-0.4..0.9) * away).max(place.min.y + 0.2);
    let side = builder.one_of(&[-1., 1.]);
    let (from, orbit) = match front {
        // Move from one side in front of the wall to the other.
        Some(_) => {
            let from = builder.within(0.2..1.2);
            (side * from, -side * (from + builder.within(0.2..1.2)))
        }
        None => (builder.angle(), side * builder.log_uniform(0.8, 6.)),
    };
    Path {
        start: (middle + away * turned(front.unwrap_or(Vec3::X), from)).with_y(height),
        target: middle,
        target_motion: 0.2 * radius * builder.direction(),
        motion: builder.vector([(-0.3, 0.3); 3]) * patience * away,
        orbit: patience * orbit,
        // Some paths also view the object from below and from above.
        swing: (Vec3::Y * away * patience * builder.log_uniform(0.02, 0.7), builder.within(2. ..9.)),
        wide: away,
        ..Path::hand_held(builder)
    }
}

/// Creates a path past the objects of the scene.
fn walk_path(builder: &SceneBuilder, tracer: &Tracer, place: CameraSpace, patience: f32) -> Option<Path> {
    // Choose the viewpoint with the widest view among several, as photographers do.
    let views: Vec<(Vec3, Vec3)> =
        (0..builder.within(1..6)).map(|_| random_viewpoint(builder, tracer, place)).collect();
    let width = |&(start, towards): &(Vec3, Vec3)| {
        let (right, up) =
            (towards.cross(Vec3::Y).normalize(), towards.cross(Vec3::Y).cross(towards).normalize());
        let rays = [(0., 0.), (0.3, 0.), (-0.3, 0.), (0., -0.3), (0.3, -0.3), (-0.3, -0.3)];
        let depth = |(x, y): (f32, f32)| {
            tracer.free_distance(start, (towards + x * right + y * up).normalize(), 20.).ln()
        };
        rays.map(depth).iter().sum::<f32>() / rays.len() as f32
    };
    let widths = views.iter().map(|view| (width(view), *view));
    let (widest, (start, towards)) = widths.max_by(|a, b| a.0.total_cmp(&b.0))?;
    let depth = widest.exp();
    if depth < 1.2 * patience {
        return None;
    }
    let (right, up) = (towards.cross(Vec3::Y).normalize(), Vec3::Y);
    let length = patience * depth.min(8.) * builder.log_uniform(0.25, 1.6);
    let sign = builder.one_of(&[-1., 1.]);
    let mut path = Path {
        start,
        target: start + depth * builder.within(0.6..1.2) * towards,
        swing: (
            right * length * builder.within(0. ..0.12) + up * length * builder.within(0. ..0.05),
            builder.within(2. ..9.),
        ),
        ..Path::hand_held(builder)
    };
    match builder.within(0..10) {
        // Forwards or backwards, as in walks and real-estate videos.
        0..4 => {
            let way = if builder.chance(0.8) { towards } else { -towards };
            path.motion = length * (way.with_y(0.2 * way.y) + builder.within(-0.5..0.5) * right);
            path.target_motion =
                path.motion * builder.within(0.3..1.) + right * builder.within(-0.3..0.3) * length;
        }
        // Sideways, as on rails.
        4..7 => {
            path.motion = length * (sign * right + builder.within(-0.3..0.3) * towards);
            path.target_motion = path.motion * builder.within(0.2..1.1);
        }
        // Orbit around a point.
        7 | 8 => path.orbit = sign * patience * builder.within(0.3..2.),
        // Free flight in any direction.
        _ => {
            path.motion = length
                * (builder.within(-0.5..0.5) * up
                    + builder.within(-0.7..0.7) * right
                    + builder.within(-0.5..0.5) * towards);
            path.target_motion = builder.within(0. ..0.6) * path.motion;
        }
    }
    // Additional rotation along the path.
    if builder.chance(0.35) {
        path.target_motion += sign * right * depth * patience * builder.within(0.2..1.2);
    }
    Some(path)
}

/// Returns the position of a standing or flying camera, and its viewing direction.
fn random_viewpoint(builder: &SceneBuilder, tracer: &Tracer, place: CameraSpace) -> (Vec3, Vec3) {
    let CameraSpace { min, max, eye_heights: (low, high), .. } = place;
    let start = min + (max - min) * vec3(builder.within(0. ..1.), 0., builder.within(0. ..1.));
    let below = tracer.free_distance(start.with_y(max.y), Vec3::NEG_Y, 40.);
    let is_flight = builder.chance(0.12);
    let height =
        if is_flight { builder.within(high..max.y.max(high + 0.1)) } else { builder.within(low..high) };
    let start = start.with_y(((max.y - below).max(0.) + height).min(max.y));
    // Look mostly towards the middle of the scene, horizontally or slightly down.
    let middle = (0.5 * (min + max) - start).with_y(0.).normalize_or(Vec3::X);
    let turn = builder.within(-1f32..1.) * builder.one_of(&[0.6, 1.2, 3.1]);
    let pitch = if is_flight { builder.within(-0.8..-0.05) } else { builder.within(-0.35..0.15) };
    (start, (turned(middle, turn) + pitch * Vec3::Y).normalize())
}

/// Rotates `v` about y by `angle`.
fn turned(v: Vec3, angle: f32) -> Vec3 {
    let (sin, cos) = angle.sin_cos();
    vec3(cos * v.x + sin * v.z, v.y, cos * v.z - sin * v.x)
}

/// Returns `true` if nothing blocks the path and every image shows something.
fn is_free(path: &Path, tracer: &Tracer, place: CameraSpace, patience: f32) -> bool {
    let margin = place.clearance * (0.3 + 0.7 * patience);
    let mut before: Option<Vec3> = None;
    (0..=CHECKED).all(|i| {
        let (at, towards, _) = path.at(i as f32 / CHECKED as f32);
        let towards = towards.normalize();
        let inside = at.cmpge(place.min).all() && at.cmple(place.max).all();
        let sides = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        let has_clearance = || sides.iter().all(|&side| tracer.free_distance(at, side, margin) >= margin);
        let right = towards.cross(Vec3::Y).normalize_or(Vec3::X);
        let up = right.cross(towards);
        // Reject views directly in front of a surface, and images that show nothing but one.
        let sees = || {
            let depths = [(0., 0.), (0.4, 0.), (-0.4, 0.), (0., 0.4), (0., -0.4)].map(|(x, y)| {
                let ray = (towards + x * right + y * up).normalize();
                tracer.free_distance(at, ray, 2. * path.wide)
            });
            let least = depths.into_iter().fold(f32::INFINITY, f32::min);
            least > 1.6 * margin && depths.iter().sum::<f32>() > depths.len() as f32 * patience * path.wide
        };
        let is_open = before.is_none_or(|from| {
            let way = at - from;
            let length = way.length();
            length < 1e-6 || tracer.free_distance(from, way / length, length) >= length
        });
        before = Some(at);
        inside && is_open && has_clearance() && sees()
    })
}

/// Returns the pose of a camera at a position with a viewing direction and a roll angle.
pub(super) fn pose((position, towards, roll): (Vec3, Vec3, f32)) -> DMat4 {
    let forward = towards.as_dvec3().normalize();
    let level = forward.cross(DVec3::Y).normalize();
    let below = forward.cross(level);
    let (sin, cos) = f64::from(roll).sin_cos();
    let (right, down) = (cos * level + sin * below, cos * below - sin * level);
    let column = |v: DVec3| DVec4::from((v, 0.));
    DMat4::from_cols(column(right), column(down), column(forward), position.as_dvec3().extend(1.))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn orbits_show_objects_from_below_above_and_in_front() {
        let builder = SceneBuilder::new(ChaCha8Rng::seed_from_u64(1));
        let (min, max) = (Vec3::splat(-9.), Vec3::splat(9.));
        let place = CameraSpace { min, max, eye_heights: (1., 2.), clearance: 0.3, walls: Some(0.3) };
        let (mut up_and_down, mut before) = (0, 0);
        for i in 0..400 {
            let front = (i % 2 == 0).then_some(Vec3::X);
            let path =
                orbit_path(&builder, OrbitTarget { middle: Vec3::ZERO, radius: 0.5, front }, place, 1.);
            let seen: Vec<(Vec3, Vec3, f32)> = (0..=16).map(|i| path.at(i as f32 / 16.)).collect();
            let pitches = seen.iter().map(|(_, towards, _)| towards.normalize().y.asin());
            let (lowest, highest) = pitches.fold((f32::MAX, f32::MIN), |(a, b), y| (a.min(y), b.max(y)));
            up_and_down += i32::from(lowest < 0. && highest > 0. && highest - lowest > 0.35);
            before += i32::from(front.is_some() && seen.iter().all(|(position, ..)| position.x > 0.));
        }
        assert!(up_and_down > 60, "{up_and_down} of 400");
        assert!(before > 180, "{before} of 200");
    }
}
