//! Lenses: how rays map to the pixels of a photo, and how a photo becomes pinhole views (spec 10.5).

mod distortion;
mod fisheye;
mod views;

pub(crate) use distortion::Distortion;
pub(crate) use views::{PinholeView, Projection, split_into_views};

use crate::geometry::{Camera, ImageSize, Intrinsics};
use fisheye::Fisheye;
use glam::{DMat2, DVec2, DVec3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// COLMAP's camera models in its numbering, each with its number of parameters.
pub const COLMAP_MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// Largest angle between a ray and the optical axis at which a photo is used, unless it shows all directions. Photos of fisheyes
/// rarely show anything beyond it.
const MAX_ANGLE: f64 = 110. * PI / 180.;
const COS_MAX_ANGLE: f64 = -0.342_020_143_325_668_7;

/// A lens and the size of its photos: how rays in camera axes (x right, y down, z forward) map to pixels. The center of pixel (i, j)
/// is at (j + ½, i + ½).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Factors and offsets from the model's image plane to pixels. The factors are pixels per radian if the model's plane is in
    /// radians, as that of fisheyes.
    pub(crate) intrinsics: Intrinsics,
    pub(crate) model: LensModel,
    size: ImageSize,
}

/// A camera model without its intrinsics: how a ray maps to the model's image plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum LensModel {
    /// The plane at distance 1, distorted.
    Perspective(Distortion),
    /// The equidistant projection, distorted.
    Fisheye(Fisheye),
    /// The field-of-view model of Devernay and Faugeras (2001), with the parameter ω in radians.
    Fov { omega: f64 },
    /// The division model of Fitzgibbon (2001).
    Division { k: f64 },
    /// The enhanced unified camera model of Khomutenko, Garcia and Martinet (2016).
    Eucm { alpha: f64, beta: f64 },
    /// Longitude and latitude in radians, both 0 on the optical axis, to the right and down.
    Equirectangular,
}

impl Default for LensModel {
    /// Returns the model of a pinhole camera.
    fn default() -> Self {
        LensModel::Perspective(Distortion::default())
    }
}

impl Lens {
    /// Creates the lens of a COLMAP camera with the given name of its model, parameters in COLMAP's order, and image size. All models
    /// of COLMAP 4 are known.
    ///
    /// # Errors
    /// Returns (field, what was found, what was expected) if the model is unknown, the number of parameters isn't the model's, or
    /// they describe no lens.
    pub fn from_colmap(
        model: &str,
        parameters: &[f64],
        size: ImageSize,
    ) -> Result<Self, (String, String, String)> {
        let Some((_, count)) = COLMAP_MODELS.iter().find(|(known, _)| *known == model) else {
            let known = COLMAP_MODELS.map(|(known, _)| known).join(", ");
            return Err(("model".into(), model.into(), format!("one of {known}")));
        };
        let refused = || {
            ("the parameters".into(), format!("{parameters:?}"), format!("{count} parameters for {model}"))
        };
        let has_one_focal = model.starts_with("SIMPLE_") || model.starts_with("RADIAL");
        let (intrinsics, coefficients) = match *parameters {
            [width, height] if model == "EQUIRECTANGULAR" => {
                (equirectangular_intrinsics(width, height), &[][..])
            }
            [f, cx, cy, ref rest @ ..] if has_one_focal => (Intrinsics { fx: f, fy: f, cx, cy }, rest),
            [fx, fy, cx, cy, ref rest @ ..] => (Intrinsics { fx, fy, cx, cy }, rest),
            _ => return Err(refused()),
        };
        let perspective = |radial: [f64; 4], tangential: [f64; 2]| {
            LensModel::Perspective(Distortion { radial, tangential, ..Distortion::default() })
        };
        let fisheye = |radial: [f64; 4]| LensModel::fisheye(radial, [0.; 2]);
        let model = match (model, coefficients) {
            ("SIMPLE_PINHOLE" | "PINHOLE", []) => LensModel::default(),
            ("SIMPLE_RADIAL", &[k]) => perspective([k, 0., 0., 0.], [0.; 2]),
            ("RADIAL", &[k1, k2]) => perspective([k1, k2, 0., 0.], [0.; 2]),
            ("OPENCV", &[k1, k2, p1, p2]) => perspective([k1, k2, 0., 0.], [p1, p2]),
            ("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                let (radial, denominator) = ([k1, k2, k3, 0.], [k4, k5, k6]);
                LensModel::Perspective(Distortion { radial, denominator, tangential: [p1, p2] })
            }
            ("SIMPLE_FISHEYE" | "FISHEYE", []) => fisheye([0.; 4]),
            ("SIMPLE_RADIAL_FISHEYE", &[k]) => fisheye([k, 0., 0., 0.]),
            ("RADIAL_FISHEYE", &[k1, k2]) => fisheye([k1, k2, 0., 0.]),
            ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => fisheye([k1, k2, k3, k4]),
            ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, sx, sy]) => {
                let radial = [k1, k2, k3, k4, 0., 0.];
                LensModel::Fisheye(Fisheye::new(radial, [p1, p2], [sx, 0., sy, 0.], false))
            }
            ("RAD_TAN_THIN_PRISM_FISHEYE", &[k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
                // The tangential coefficients come in the other order.
                let (radial, prism) = ([k0, k1, k2, k3, k4, k5], [s0, s1, s2, s3]);
                LensModel::Fisheye(Fisheye::new(radial, [p1, p0], prism, true))
            }
            ("FOV", &[omega]) => LensModel::Fov { omega: omega.abs() },
            ("SIMPLE_DIVISION" | "DIVISION", &[k]) => LensModel::Division { k },
            ("EUCM", &[alpha, beta]) => LensModel::Eucm { alpha, beta },
            ("EQUIRECTANGULAR", []) if parameters.len() == 2 => LensModel::Equirectangular,
            _ => return Err(refused()),
        };
        let lens = Lens { intrinsics, model, size };
        lens.check().map(|()| lens)
    }

    /// Creates the lens `model` of `camera`, whose pose doesn't matter.
    pub(crate) fn new(camera: &Camera, model: LensModel) -> Self {
        let size = ImageSize { width: camera.width, height: camera.height };
        Lens { intrinsics: camera.intrinsics, model, size }
    }

    /// Returns the size of the lens's photos.
    pub fn size(&self) -> ImageSize {
        self.size
    }

    /// Checks that the intrinsics are valid and that most pixels have a unique ray.
    ///
    /// # Errors
    /// Returns (field, what was found, what was expected).
    pub(crate) fn check(&self) -> Result<(), (String, String, String)> {
        /// Smallest fraction of a photo's pixels that have a ray.
        const MIN_RAY_FRACTION: f64 = 0.1;
        let ImageSize { width, height } = self.size;
        self.intrinsics.check(width, height)?;
        let refuse = |found: String, expected: &str| Err(("the distortion".into(), found, expected.into()));
        let parameters = match self.model {
            LensModel::Perspective(distortion) => {
                let folds = |&pixel: &DVec2| distortion.folds_at(self.plane_point(pixel));
                let found = format!("{}, by which the lens folds the image over", distortion.describe());
                return match self.grid(32).iter().any(folds) {
                    true => refuse(found, "coefficients by which every pixel sees a ray of its own"),
                    false => Ok(()),
                };
            }
            LensModel::Equirectangular if width.abs_diff(height.saturating_mul(2)) > 1 => {
                let expected =
                    "a width of twice the height, as EQUIRECTANGULAR photos show 360 by 180 degrees";
                return Err(("the size".into(), format!("{width}×{height} pixels"), expected.into()));
            }
            LensModel::Equirectangular => {
                let whole = equirectangular_intrinsics(f64::from(width), f64::from(height));
                let (found, whole) = (self.intrinsics.to_rows(), whole.to_rows());
                let is_whole = found.iter().zip(whole).all(|(a, b)| a.eq(&b) || (a / b - 1.).abs() < 0.01);
                let found = format!("[{}, {}]", 2. * self.intrinsics.cx, 2. * self.intrinsics.cy);
                let refused = || ("the parameters".into(), found, format!("the size, [{width}, {height}]"));
                return is_whole.then_some(()).ok_or_else(refused);
            }
            LensModel::Fov { omega } if !(0. ..PI).contains(&omega) => {
                return refuse(format!("omega {omega}"), "an angle below π");
            }
            LensModel::Eucm { alpha, beta }
                if !((0. ..=1.).contains(&alpha) && beta > 0. && beta.is_finite()) =>
            {
                return refuse(format!("alpha {alpha}, beta {beta}"), "alpha from 0 to 1 and beta above 0");
            }
            LensModel::Fisheye(fisheye) => fisheye.describe(),
            LensModel::Fov { omega } => format!("omega {omega}"),
            LensModel::Division { k } => format!("k {k}"),
            LensModel::Eucm { alpha, beta } => format!("alpha {alpha}, beta {beta}"),
        };
        let points = self.grid(16);
        let seen = points.iter().filter(|&&point| self.unproject_used(point).is_some()).count() as f64;
        let share = seen / points.len() as f64;
        match share >= MIN_RAY_FRACTION {
            true => Ok(()),
            false => refuse(
                format!("{parameters}, by which {:.0} % of the photo have a ray", 100. * share),
                "coefficients by which most pixels see a ray of their own",
            ),
        }
    }

    /// Returns the position in pixels at which the lens shows `ray`, a direction of any length in camera axes, or `None` if the model
    /// doesn't define it. The position may lie outside the photo.
    pub fn project(&self, ray: DVec3) -> Option<DVec2> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let point = self.model.project(ray)? * DVec2::new(fx, fy) + DVec2::new(cx, cy);
        point.is_finite().then_some(point)
    }

    /// Returns the direction, of length 1 in camera axes, that the lens shows at the position `pixel`, or `None` if there is none.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec3> {
        let ray = self.model.unproject(self.plane_point(pixel))?.normalize();
        ray.is_finite().then_some(ray)
    }

    /// Returns the point of the model's image plane at the position `pixel`.
    fn plane_point(&self, pixel: DVec2) -> DVec2 {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        (pixel - DVec2::new(cx, cy)) / DVec2::new(fx, fy)
    }

    /// Returns `true` if `ray` is within the angle at which photos are used.
    fn is_within_max_angle(&self, ray: DVec3) -> bool {
        matches!(self.model, LensModel::Equirectangular) || ray.z >= COS_MAX_ANGLE * ray.length()
    }

    /// Returns the position of `ray` in the photo, or `None` if the photo doesn't show it.
    pub(crate) fn project_into_photo(&self, ray: DVec3) -> Option<DVec2> {
        let ImageSize { width, height } = self.size;
        let is_inside =
            |p: &DVec2| p.x >= 0. && p.y >= 0. && p.x <= f64::from(width) && p.y <= f64::from(height);
        self.project(ray).filter(|point| is_inside(point) && self.is_within_max_angle(ray))
    }

    /// Returns the ray at a position in the photo, or `None` if nothing is there.
    fn unproject_used(&self, pixel: DVec2) -> Option<DVec3> {
        self.unproject(pixel).filter(|&ray| self.is_within_max_angle(ray))
    }

    /// Returns the corners of `count` × `count` equal parts of the photo.
    fn grid(&self, count: u32) -> Vec<DVec2> {
        let size = DVec2::new(self.size.width.into(), self.size.height.into());
        let at = |i: u32| DVec2::new(f64::from(i % (count + 1)), f64::from(i / (count + 1)));
        (0..(count + 1) * (count + 1)).map(|i| size * at(i) / f64::from(count)).collect()
    }
}

/// Returns the intrinsics of a photo of all directions.
fn equirectangular_intrinsics(width: f64, height: f64) -> Intrinsics {
    Intrinsics { fx: width / TAU, fy: height / PI, cx: width / 2., cy: height / 2. }
}

impl LensModel {
    /// Returns OpenCV's fisheye with coefficients k₁ to k₄, and with p₁ and p₂, which nerfstudio adds.
    pub fn fisheye([k1, k2, k3, k4]: [f64; 4], tangential: [f64; 2]) -> Self {
        LensModel::Fisheye(Fisheye::new([k1, k2, k3, k4, 0., 0.], tangential, [0.; 4], false))
    }

    /// Returns the distance on the image plane per radian at the optical axis.
    fn central_scale(&self) -> f64 {
        match *self {
            LensModel::Fov { omega } if omega > SMALLEST_OMEGA => 2. * (omega / 2.).tan() / omega,
            _ => 1.,
        }
    }

    fn project(&self, ray: DVec3) -> Option<DVec2> {
        let (across, z) = (ray.truncate(), ray.z);
        let distance = across.length();
        match *self {
            LensModel::Perspective(distortion) => (z > 0.).then(|| distortion.apply(across / z)),
            LensModel::Fisheye(fisheye) => {
                let angle = distance.atan2(z);
                let is_seen = angle <= fisheye.max_angle && !(distance == 0. && z <= 0.);
                let equidistant = if distance == 0. { DVec2::ZERO } else { across * (angle / distance) };
                is_seen.then(|| fisheye.apply(equidistant))
            }
            LensModel::Fov { omega } if omega > SMALLEST_OMEGA => {
                let plane = across / z;
                let radius = plane.length();
                let factor = match radius {
                    0. => self.central_scale(),
                    _ => (2. * radius * (omega / 2.).tan()).atan() / (radius * omega),
                };
                (z > 0.).then(|| plane * factor)
            }
            LensModel::Fov { .. } => (z > 0.).then(|| across / z),
            // The distance r from the axis solves distance·(1 + kr²) = z·r.
            LensModel::Division { k } => {
                let root = z * z - 4. * k * distance * distance;
                let below = z + root.sqrt();
                (root >= 0. && below > 0.).then(|| across * (2. / below))
            }
            LensModel::Eucm { alpha, beta } => {
                let d = (beta * distance * distance + z * z).sqrt();
                let below = alpha * d + (1. - alpha) * z;
                let limit = if alpha > 0.5 { (1. - alpha) / alpha } else { alpha / (1. - alpha) };
                (below > 0. && z > -limit * d).then(|| across / below)
            }
            LensModel::Equirectangular => {
                let longitude = ray.x.atan2(z);
                let latitude = ray.y.atan2((ray.x * ray.x + z * z).sqrt());
                (ray != DVec3::ZERO).then(|| DVec2::new(longitude, latitude))
            }
        }
    }

    fn unproject(&self, point: DVec2) -> Option<DVec3> {
        let r2 = point.length_squared();
        match *self {
            LensModel::Perspective(distortion) => {
                invert(|at| distortion.apply(at), point, point).map(|plane| plane.extend(1.))
            }
            LensModel::Fisheye(fisheye) => {
                let equidistant = fisheye.invert(point)?;
                let angle = equidistant.length();
                Some(match angle {
                    0. => DVec3::Z,
                    _ => (equidistant * (angle.sin() / angle)).extend(angle.cos()),
                })
            }
            LensModel::Fov { omega } if omega > SMALLEST_OMEGA && r2 > 0. => {
                let (radius, angle) = (r2.sqrt(), r2.sqrt() * omega);
                let factor = angle.tan() / (2. * radius * (omega / 2.).tan());
                (angle < FRAC_PI_2).then(|| (point * factor).extend(1.))
            }
            LensModel::Fov { .. } => Some(point.extend(1.)),
            // Beyond kr² = 1 the model shows rays a second time.
            LensModel::Division { k } => (k * r2 <= 1.).then(|| point.extend(1. + k * r2)),
            LensModel::Eucm { alpha, beta } => {
                let root = 1. - (2. * alpha - 1.) * beta * r2;
                let z = (1. - beta * alpha * alpha * r2) / (alpha * root.sqrt() + 1. - alpha);
                (root >= 0.).then(|| point.extend(z))
            }
            LensModel::Equirectangular => {
                /// Rounding that is allowed at the edges, in radians.
                const ROUNDING: f64 = 1e-9;
                let is_inside = point.x.abs() <= PI + ROUNDING && point.y.abs() <= FRAC_PI_2 + ROUNDING;
                let ((x, z), (y, level)) = (point.x.sin_cos(), point.y.sin_cos());
                is_inside.then(|| DVec3::new(x * level, y, z * level))
            }
        }
    }
}

/// Parameter ω of the field-of-view model below which it is a pinhole camera up to rounding.
const SMALLEST_OMEGA: f64 = 1e-7;

/// Solves `map`(x) = `target` by Newton's method with steps that are halved until they approach the target, starting at `start`.
/// Returns `None` if that leads nowhere, or where the map turns over.
fn invert(map: impl Fn(DVec2) -> DVec2, target: DVec2, start: DVec2) -> Option<DVec2> {
    const ITERATIONS: usize = 60;
    const HALVINGS: usize = 12;
    // Distances from the target at which a solution is exact, and at which it is accepted.
    const EXACT: f64 = 1e-15;
    const ACCEPTED: f64 = 1e-11;
    let mut at = start;
    let mut left = target - map(at);
    for _ in 0..ITERATIONS {
        if left.length() <= EXACT {
            break;
        }
        let step = jacobian(&map, at).inverse() * left;
        let steps = (0..HALVINGS).map(|halving| at + step * 0.5f64.powi(halving as i32));
        let better =
            steps.map(|next| (next, target - map(next))).find(|(_, next)| next.length() < left.length());
        let Some(better) = better else { break };
        (at, left) = better;
    }
    let is_solved =
        left.length() <= ACCEPTED * (1. + target.length()) && jacobian(&map, at).determinant() > 0.;
    is_solved.then_some(at)
}

/// Returns the Jacobian of `map` at a point, by central differences.
fn jacobian(map: &impl Fn(DVec2) -> DVec2, at: DVec2) -> DMat2 {
    const STEP: f64 = 1e-6;
    let slope = |step: DVec2| (map(at + step) - map(at - step)) / (2. * STEP);
    DMat2::from_cols(slope(DVec2::X * STEP), slope(DVec2::Y * STEP))
}
