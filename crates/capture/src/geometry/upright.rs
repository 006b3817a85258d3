//! The transform of a world of arbitrary orientation to one in which -y points up and the floor is at y = 0.

use super::align::{PositionFit, covariance, fit_positions, outer};
use super::eigen::symmetric_eigen;
use fastrand::Rng;
use glam::{DMat3, DMat4, DQuat, DVec3};
use globalsplat_files::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Standard deviation of the angle by which people tilt a camera sideways, in radians.
const ROLL: f64 = 0.035;
/// Standard deviation of the angle by which they tilt all photos of a scene up or down on average, in radians.
const PITCH: f64 = 0.26;
/// Standard deviation of the tilt that all photos of a scene have in common, in radians.
const COMMON_TILT: f64 = 0.017;
/// Sine of the angle above which a camera's x axis isn't taken for horizontal, as in photos on their side: first, less by every step, and last.
const MAX_ROLL: [f64; 3] = [0.8, 0.05, 0.25];
/// Number of these steps.
const ROLL_STEPS: u32 = 30;
/// Length of the median of unit vectors below which they have no common direction.
const MIN_MEDIAN: f64 = 0.3;
/// Weight of the mean pitch in terms of the variance of rolls. From 1 on, cameras that all look in one direction aren't turned by noise.
const PITCH_WEIGHT: f64 = 2.;
/// Weight of the viewing directions, which point down rather than up, where the cameras' own up directions don't decide which is which.
const DOWNWARD: f64 = 0.5;

/// Number of points among which a floor is searched.
const FLOOR_POINTS: usize = 5000;
/// Number of triples of points that are tried as a floor.
const FLOOR_TRIPLES: usize = 2000;
/// Number of times that the floor is fitted to its points.
const REFITS: usize = 10;
/// Distance of points from the floor they belong to, in terms of the median distance between points and cameras.
const FLOOR_THICKNESS: f64 = 0.02;
/// Maximum standard deviation of their heights, in terms of the largest distance. That of points all over the volume is 0.58.
const MAX_FLOOR_DEVIATION: f64 = 0.4;
/// Largest angle between the floor's normal and the up direction that is known before, in standard deviations of the latter, and in radians.
/// Other planes, such as sloping roofs and dunes, aren't taken for floors.
const FLOOR_DEVIATIONS: f64 = 3.;
const MAX_FLOOR_ANGLE: f64 = 0.44;
/// Minimum share of the points that belong to the floor, and maximum share that is below it.
const MIN_ON_FLOOR: f64 = 0.08;
const MAX_BELOW_FLOOR: f64 = 0.1;
/// Share of a floor's points that count less if it is at the largest angle. Of planes below a ball, it selects the one at the very bottom.
const TILT_PENALTY: f64 = 0.5;
/// Number of points on the floor that one point below it outweighs.
const BELOW_WEIGHT: f64 = 2.;
/// Share of the cameras that may be below a floor, being wrong.
const CAMERAS_BELOW: f64 = 0.05;
/// Share of the points that is below the height 0 if there is no floor.
const LOW_POINTS: f64 = 0.02;

/// What determines the vertical direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpSource {
    /// The cameras, which people hold level.
    Cameras,
    /// A plane of points below the cameras.
    Floor,
    /// The positions of the photos.
    Positions,
}

/// Result of [`estimate_upright`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Upright {
    /// Transform from the given world to the upright one: a rotation, a translation, and a scale if `is_metric`.
    #[serde(with = "rows")]
    pub matrix: DMat4,
    /// What determines the vertical direction.
    pub up: UpSource,
    /// `true` if a floor was found, which is at y = 0.
    #[serde(rename = "floor")]
    pub has_floor: bool,
    /// `true` if the upright world is in metres, by the positions of the photos.
    #[serde(rename = "metres")]
    pub is_metric: bool,
    /// How well the positions agree with the cameras, if three or more photos have one.
    pub positions: Option<PositionFit>,
}

/// A matrix in JSON: its rows.
mod rows {
    use super::DMat4;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(matrix: &DMat4, serializer: S) -> Result<S::Ok, S::Error> {
        matrix.transpose().to_cols_array_2d().serialize(serializer)
    }

    pub fn deserialize<'a, D: Deserializer<'a>>(deserializer: D) -> Result<DMat4, D::Error> {
        <[[f64; 4]; 4]>::deserialize(deserializer).map(|rows| DMat4::from_cols_array_2d(&rows).transpose())
    }
}

/// Formats what the transform follows from, as `upright by the floor; in metres by the positions of 40 of 42 photos (error 2.1 m, scale ±1.5 %)`.
impl fmt::Display for Upright {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match (self.up, self.has_floor) {
            (UpSource::Floor, _) => "upright by the floor",
            (UpSource::Cameras, _) => "upright by the cameras, without a floor",
            (UpSource::Positions, _) => "upright by the positions of the photos",
        })?;
        let Some(fit) = self.positions else { return Ok(()) };
        let PositionFit { inliers, positions, error, spread, scale_error, .. } = fit;
        match self.is_metric {
            true => write!(
                f,
                "; in metres by the positions of {inliers} of {positions} photos (error {error:.1} m, scale ±{:.1} %)",
                100. * scale_error
            ),
            false => write!(
                f,
                "; not in metres: the positions of {inliers} of {positions} photos agree with their cameras within {error:.1} m, too little \
                 for their spread of {spread:.1} m"
            ),
        }
    }
}

/// Estimates the transform to a world with -y up, the floor at y = 0, and the mean camera at x = z = 0, from poses `c2w`, points on
/// surfaces, and the positions of photos in metres, east, north and up, where they are known.
///
/// The cameras' x axes are nearly horizontal: up is the direction that is most perpendicular to them, the smallest eigenvector of Σ wᵢ xᵢ xᵢᵀ
/// with the weights wᵢ of Tukey's biweight. As far as all cameras look in similar directions, the median of their own up directions decides.
/// A floor refines this: the plane within three standard deviations of it, at most 25°, that has the most points on it, few below, and the
/// cameras above. Without a floor, 2 % of the points are below y = 0, and without points, the mean camera is there.
///
/// If the positions agree with the cameras, they determine the scale; and also the vertical direction if they do so more precisely
/// than the cameras, which needs positions that are far apart and not on a line. Otherwise the scale stays.
///
/// # Errors
/// Returns an error if there are no cameras.
pub fn estimate_upright(c2w: &[DMat4], points: &[DVec3], positions: &[Option<DVec3>]) -> Result<Upright> {
    if c2w.is_empty() {
        return Err(Error::request("a scene without cameras can't be turned upright"));
    }
    let centers: Vec<DVec3> = c2w.iter().map(|pose| pose.w_axis.truncate()).collect();
    let located =
        centers.iter().zip(positions).filter_map(|(center, position)| Some((*center, (*position)?)));
    let (from, to): (Vec<_>, Vec<_>) = located.unzip();
    let fit = fit_positions(&from, &to);
    let reliable = fit.filter(|(_, fit)| fit.is_reliable());

    let (by_cameras, error) = up_of_cameras(c2w);
    let error = error.hypot(COMMON_TILT);
    let (mut up, error, mut source) = match reliable.filter(|(_, fit)| fit.up_error < error) {
        Some((to, fit)) => (to.rotation.transpose() * DVec3::Z, fit.up_error, UpSource::Positions),
        None => (by_cameras, error, UpSource::Cameras),
    };
    let floor = find_floor(points, &centers, up, (FLOOR_DEVIATIONS * error).min(MAX_FLOOR_ANGLE));
    if let Some(floor) = floor.filter(|_| source == UpSource::Cameras) {
        (up, source) = (floor.normal, UpSource::Floor);
    }
    let center = centers.iter().sum::<DVec3>() / centers.len() as f64;
    let height = match floor {
        Some(floor) => floor.point.dot(up),
        None => quantile(points.iter().map(|point| point.dot(up)), LOW_POINTS).unwrap_or(center.dot(up)),
    };
    let scale = reliable.map_or(1., |(to_positions, _)| to_positions.scale);
    let rotation = DMat3::from_quat(DQuat::from_rotation_arc(up, DVec3::NEG_Y));
    let origin = center + (height - center.dot(up)) * up;
    Ok(Upright {
        matrix: DMat4::from_mat3_translation(scale * rotation, -scale * (rotation * origin)),
        up: source,
        has_floor: floor.is_some(),
        is_metric: reliable.is_some(),
        positions: fit.map(|(_, fit)| fit),
    })
}

/// Returns the up direction by the cameras' axes, and the standard deviation of its error in radians.
fn up_of_cameras(c2w: &[DMat4]) -> (DVec3, f64) {
    let axis = |pose: &DMat4, column: usize| pose.col(column).truncate().normalize();
    let ups: Vec<DVec3> = c2w.iter().map(|pose| -axis(pose, 1)).collect();
    let median = median_direction(&ups);
    let backward = c2w.iter().map(|pose| -axis(pose, 2)).sum::<DVec3>() / c2w.len() as f64;
    let sign = median + DOWNWARD * backward;
    let is_common = median.length() > MIN_MEDIAN;
    let mut up = (if is_common { median } else { sign }).try_normalize().unwrap_or(DVec3::NEG_Y);
    let initial = up;
    let mut error = 0.;
    for step in 0..ROLL_STEPS {
        let max = (MAX_ROLL[0] - MAX_ROLL[1] * f64::from(step)).max(MAX_ROLL[2]);
        let weighted = c2w.iter().map(|pose| axis(pose, 0)).map(|x| {
            let weight = (1. - (x.dot(up) / max).powi(2)).max(0.).powi(2);
            weight * outer(x)
        });
        let horizontal: DMat3 = weighted.sum();
        // The mean pitch is another measurement of the direction that is perpendicular to all x axes, if there is one.
        let weight = PITCH_WEIGHT * up.dot(horizontal * up) + (ROLL / PITCH).powi(2);
        let matrix = horizontal + weight * (DMat3::IDENTITY - outer(initial));
        let [(_, smallest), (middle, _), _] = symmetric_eigen(matrix.to_cols_array_2d());
        let direction = DVec3::from(smallest);
        up = if direction.dot(sign) < 0. { -direction } else { direction };
        error = ROLL / middle.sqrt();
    }
    (up, error)
}

/// Returns the point with the least sum of distances to unit vectors, which few wrong ones hardly move, by Weiszfeld's iteration.
fn median_direction(directions: &[DVec3]) -> DVec3 {
    const ITERATIONS: usize = 50;
    let mut median = DVec3::ZERO;
    for _ in 0..ITERATIONS {
        let (sum, weights) = directions.iter().fold((DVec3::ZERO, 0.), |(sum, weights), direction| {
            let weight = median.distance(*direction).max(1e-6).recip();
            (sum + weight * *direction, weights + weight)
        });
        median = sum / weights;
    }
    median
}

/// A plane through `point`.
#[derive(Debug, Clone, Copy)]
struct Plane {
    /// Unit vector that points up.
    normal: DVec3,
    point: DVec3,
}

impl Plane {
    fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point - self.point)
    }
}

/// Returns the plane of a floor or the ground below cameras at `centers`, among `points`, if there is one.
/// `up` is known to `max_angle` radians.
fn find_floor(points: &[DVec3], centers: &[DVec3], up: DVec3, max_angle: f64) -> Option<Plane> {
    let mut random = Rng::with_seed(0);
    let points = random.choose_multiple(points.iter().copied(), FLOOR_POINTS);
    let center = centers.iter().sum::<DVec3>() / centers.len() as f64;
    let size = quantile(points.iter().map(|point| point.distance(center)), 0.5)?;
    let thickness = FLOOR_THICKNESS * size;
    let lowest = quantile(centers.iter().map(|center| center.dot(up)), CAMERAS_BELOW)?;
    let low: Vec<DVec3> = points.iter().copied().filter(|point| point.dot(up) < lowest).collect();
    let is_possible = |plane: &Plane| {
        let nearest = quantile(centers.iter().map(|center| plane.height(*center)), CAMERAS_BELOW);
        plane.normal.dot(up) > max_angle.cos() && nearest.is_some_and(|height| height > thickness)
    };
    let share = |is_counted: &dyn Fn(f64) -> bool, plane: &Plane| {
        points.iter().filter(|point| is_counted(plane.height(**point))).count() as f64 / points.len() as f64
    };
    let on = |plane: &Plane| share(&|height| height.abs() < thickness, plane);
    let below = |plane: &Plane| share(&|height| height < -2. * thickness, plane);
    let tilt = |plane: &Plane| (1. - plane.normal.dot(up)) / (1. - max_angle.cos());
    let score = |plane: &Plane| on(plane) * (1. - TILT_PENALTY * tilt(plane)) - BELOW_WEIGHT * below(plane);
    let candidates = (0..FLOOR_TRIPLES).filter_map(|_| {
        let [a, b, c] = random.choose_multiple(&low, 3)[..] else { return None };
        let normal = (*b - *a).cross(*c - *a).try_normalize()?;
        let plane = Plane { normal: if normal.dot(up) < 0. { -normal } else { normal }, point: *a };
        is_possible(&plane).then(|| (score(&plane), plane))
    });
    let (_, mut floor) = candidates.max_by(|a, b| a.0.total_cmp(&b.0))?;
    let mut variance = 0.;
    for _ in 0..REFITS {
        let near = || points.iter().copied().filter(|point| floor.height(*point).abs() < thickness);
        let mean = near().sum::<DVec3>() / near().count().max(1) as f64;
        let [(smallest, normal), ..] = symmetric_eigen(covariance(near().map(|point| point - mean)));
        let normal = DVec3::from(normal);
        floor = Plane { normal: if normal.dot(up) < 0. { -normal } else { normal }, point: mean };
        variance = smallest;
    }
    let is_flat = variance < (MAX_FLOOR_DEVIATION * thickness).powi(2);
    (is_possible(&floor) && is_flat && on(&floor) >= MIN_ON_FLOOR && below(&floor) <= MAX_BELOW_FLOOR)
        .then_some(floor)
}

/// Returns the value below which a `share` of the values is, or `None` if there are none.
fn quantile(values: impl Iterator<Item = f64>, share: f64) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let index = (share * values.len().saturating_sub(1) as f64) as usize;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(index, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::EulerRot;
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

    /// Returns a number from -1 to 1.
    fn signed(random: &mut Rng) -> f64 {
        2. * random.f64() - 1.
    }

    /// Returns a number that is roughly normally distributed, with a standard deviation of 1.
    fn normal(random: &mut Rng) -> f64 {
        (0..3).map(|_| signed(random)).sum()
    }

    /// Returns a camera at `center`, in an upright world, that is held with `angles` of yaw, pitch and roll in radians.
    fn camera(center: DVec3, angles: [f64; 3]) -> DMat4 {
        let [yaw, pitch, roll] = angles;
        DMat4::from_rotation_translation(DQuat::from_euler(EulerRot::YXZ, yaw, pitch, roll), center)
    }

    /// Returns cameras that are held by hand at 1.5 m above the floor, each with a yaw in ±`yaw`, a mean `pitch`, up if positive, and a
    /// roll of 2°.
    fn held_by_hand(random: &mut Rng, yaw: f64, pitch: f64) -> Vec<DMat4> {
        let camera = |_| {
            let center = DVec3::new(2. * signed(random), -1.5 + 0.1 * signed(random), 2. * signed(random));
            camera(center, [yaw * signed(random), pitch + 0.1 * normal(random), 0.035 * normal(random)])
        };
        (0..30).map(camera).collect()
    }

    /// Returns points of a room of 6 m × 6 m × 2.5 m with a table and clutter, and of a few reflections below the floor.
    fn room(random: &mut Rng) -> Vec<DVec3> {
        let mut points = vec![];
        for index in 0..3000 {
            let (x, z) = (3. * signed(random), 3. * signed(random));
            let noise = 0.01 * normal(random);
            points.push(match index % 10 {
                0..3 => DVec3::new(x, noise, z),
                3 | 4 => DVec3::new(0.3 * x, -0.8 + noise, 0.2 * z),
                5 | 6 => DVec3::new(x, -2.5 * random.f64(), 3. + noise),
                7 => DVec3::new(-3. + noise, -2.5 * random.f64(), z),
                _ => DVec3::new(x, -2.5 * random.f64() + 0.2 * random.f64(), z),
            });
        }
        points
    }

    fn turn_randomly(random: &mut Rng) -> DMat4 {
        let rotation = DQuat::from_euler(
            EulerRot::YXZ,
            PI * signed(random),
            0.5 * PI * signed(random),
            PI * signed(random),
        );
        DMat4::from_rotation_translation(rotation, DVec3::new(signed(random), 5., signed(random)))
    }

    /// Turns everything randomly and back, and returns the result, the angle between the upright world's up direction and the right one in
    /// degrees, and the matrix from the world at the beginning to the upright one.
    fn error(random: &mut Rng, cameras: &[DMat4], points: &[DVec3]) -> (Upright, f64, DMat4) {
        let turn = turn_randomly(random);
        let cameras: Vec<DMat4> = cameras.iter().map(|camera| turn * *camera).collect();
        let points: Vec<DVec3> = points.iter().map(|point| turn.transform_point3(*point)).collect();
        let upright = estimate_upright(&cameras, &points, &[]).unwrap();
        let matrix = upright.matrix * turn;
        let angle = matrix.transform_vector3(DVec3::NEG_Y).angle_between(DVec3::NEG_Y).to_degrees();
        (upright, angle, matrix)
    }

    #[test]
    fn rooms_and_objects_stand_upright() {
        let mut random = Rng::with_seed(1);
        for _ in 0..4 {
            let points = room(&mut random);
            for (yaw, pitch) in [(PI, -0.2), (0.6, 0.2), (0.05, -0.15)] {
                let cameras = held_by_hand(&mut random, yaw, pitch);
                let (upright, angle, matrix) = error(&mut random, &cameras, &points);
                assert!(upright.has_floor && upright.up == UpSource::Floor && angle < 0.5, "{yaw} {angle}°");
                let center = cameras.iter().map(|camera| camera.w_axis.truncate()).sum::<DVec3>() / 30.;
                let moved = matrix.transform_point3(center);
                assert!(moved.abs_diff_eq(DVec3::Y * center.y, 0.05), "{moved} {center}");
                assert!((matrix.determinant() - 1.).abs() < 1e-9 && !upright.is_metric);
            }
            // By cameras alone. They rest on a tilt of 8° by an assumption if all of them look in one direction.
            for (yaw, pitch, bound) in [(PI, -0.6, 2.), (0.6, -0.2, 2.5), (0.05, -0.15, 13.)] {
                let cameras = held_by_hand(&mut random, yaw, pitch);
                let (upright, angle, _) = error(&mut random, &cameras, &[]);
                assert!(upright.up == UpSource::Cameras && angle < bound, "{yaw} {angle}°");
            }
            // An object that is photographed from above, on nothing.
            let ball: Vec<DVec3> = (0..2000)
                .map(|_| DVec3::new(normal(&mut random), normal(&mut random), normal(&mut random)))
                .map(|point| 0.3 * point.normalize())
                .collect();
            for arc in [TAU, 0.5 * PI] {
                let orbit = (0..24).map(|index| {
                    let (yaw, pitch) = (arc * f64::from(index) / 24., -0.3 - 0.5 * random.f64());
                    let pose = camera(DVec3::ZERO, [yaw, pitch, 0.035 * normal(&mut random)]);
                    pose * DMat4::from_translation(DVec3::NEG_Z * 2.)
                });
                let orbit: Vec<DMat4> = orbit.collect();
                let (upright, angle, _) = error(&mut random, &orbit, &ball);
                assert!(!upright.has_floor && angle < 2., "{arc} {angle}° {upright}");
            }
        }
    }

    #[test]
    fn photos_on_their_side_do_not_count() {
        let mut random = Rng::with_seed(2);
        for seed in 0..20 {
            let mut cameras = held_by_hand(&mut random, [PI, 0.5, 0.05][seed % 3], -0.1);
            for camera in &mut cameras[..9] {
                *camera *= DMat4::from_rotation_z(FRAC_PI_2);
            }
            let (_, angle, _) = error(&mut random, &cameras, &[]);
            assert!(angle < [2., 2.5, 12.][seed % 3], "{angle}°");
        }
    }

    #[test]
    fn cameras_that_look_straight_down_are_above() {
        let mut random = Rng::with_seed(3);
        let down = |index: u32| {
            let yaw = f64::from(index);
            camera(DVec3::new(signed(&mut random), -1., signed(&mut random)), [yaw, -FRAC_PI_2, 0.02])
        };
        let cameras: Vec<DMat4> = (0..20).map(down).collect();
        let (_, angle, _) = error(&mut random, &cameras, &[]);
        assert!(angle < 2., "{angle}°");
    }

    #[test]
    fn one_camera_is_enough_and_none_is_refused() {
        let pose = camera(DVec3::new(1., 2., 3.), [0.3, 0., 0.]);
        let upright = estimate_upright(&[pose], &[], &[]).unwrap();
        assert!(upright.matrix.transform_point3(DVec3::new(1., 2., 3.)).length() < 1e-9);
        assert_eq!(upright.to_string(), "upright by the cameras, without a floor");
        assert!(estimate_upright(&[], &[], &[]).is_err());
    }
}
