//! Camera intrinsics and poses.

use glam::{DMat3, DMat4, DVec3};
use serde::{Deserialize, Serialize};

/// Maximum deviation of RᵀR from the identity, per entry: captures store poses with 3 to 7 digits.
const RIGID_TOLERANCE: f64 = 5e-3;

/// Maximum deviation of a pose's 3×3 part from the nearest rotation, per entry, for files with more digits.
const ROUNDING_TOLERANCE: f64 = 1e-3;

/// Intrinsics of a pinhole camera, in pixels of its image. The center of pixel (i, j) is at (j + ½, i + ½).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

impl Intrinsics {
    /// Returns the intrinsics after resizing the image by the factors `x` and `y`.
    pub fn resized(&self, x: f64, y: f64) -> Self {
        Intrinsics { fx: self.fx * x, fy: self.fy * y, cx: self.cx * x, cy: self.cy * y }
    }

    /// Returns the intrinsics after cutting `left` columns and `top` rows off the image.
    pub fn cropped(&self, left: f64, top: f64) -> Self {
        Intrinsics { cx: self.cx - left, cy: self.cy - top, ..*self }
    }

    /// Returns the 3×3 matrix, row by row.
    pub fn to_rows(&self) -> [f64; 9] {
        [self.fx, 0., self.cx, 0., self.fy, self.cy, 0., 0., 1.]
    }

    /// Checks the intrinsics against an image of `width` × `height`: focal lengths must be positive, and the principal point at
    /// most one pixel outside the image.
    ///
    /// # Errors
    /// Returns (field, what was found, what was expected).
    pub fn check(&self, width: u32, height: u32) -> Result<(), (String, String, String)> {
        for (name, focal) in [("fx", self.fx), ("fy", self.fy)] {
            if !(focal > 0. && focal.is_finite()) {
                return Err((format!("focal length {name}"), focal.to_string(), "a number above 0".into()));
            }
        }
        for (name, point, size) in [("cx", self.cx, width), ("cy", self.cy, height)] {
            if !(point >= -1. && point <= f64::from(size) + 1.) {
                let expected = format!("one inside the image, 0 to {size} pixels");
                return Err((format!("principal point {name}"), point.to_string(), expected));
            }
        }
        Ok(())
    }
}

/// Height and width of an image in pixels, serialized as [H, W].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[u32; 2]", into = "[u32; 2]")]
pub struct ImageSize {
    /// Number of rows.
    pub height: u32,
    /// Number of columns.
    pub width: u32,
}

impl From<[u32; 2]> for ImageSize {
    fn from([height, width]: [u32; 2]) -> Self {
        ImageSize { height, width }
    }
}

impl From<ImageSize> for [u32; 2] {
    fn from(size: ImageSize) -> Self {
        [size.height, size.width]
    }
}

/// A pinhole camera: intrinsics, pose and image size.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    /// Intrinsics in pixels of an image of `width` × `height`.
    pub intrinsics: Intrinsics,
    /// Camera-to-world matrix.
    pub c2w: DMat4,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
}

impl Camera {
    /// Returns the point in world coordinates that is seen at the pixel coordinates (`u`, `v`) at `depth` along the camera's axis.
    pub fn unproject(&self, u: f64, v: f64, depth: f64) -> DVec3 {
        let k = self.intrinsics;
        self.c2w.transform_point3(DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.) * depth)
    }

    /// Returns the camera for an image of another size. The field of view stays the same along the side whose pixel count has the
    /// smaller ratio of new to old.
    pub fn with_size(&self, ImageSize { width, height }: ImageSize) -> Self {
        let (x, y) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        let (factor, k) = (x.min(y), self.intrinsics);
        let intrinsics = Intrinsics { fx: k.fx * factor, fy: k.fy * factor, cx: k.cx * x, cy: k.cy * y };
        Camera { intrinsics, c2w: self.c2w, width, height }
    }

    /// Returns the camera scaled to a photo of size (width, height) if that size differs from the camera's and the aspect ratios agree to
    /// within a pixel of the smaller image. The size may also agree with width and height swapped, because loading may rotate a photo.
    pub(crate) fn scaled_to(&self, (width, height): (u32, u32)) -> Option<Self> {
        let choices = [(width, height), (height, width)];
        if choices.contains(&(self.width, self.height)) {
            return None;
        }
        let share = |a: u32, b: u32| f64::from(a.min(b)) / f64::from(a.max(b));
        let agrees = |&(width, height): &(u32, u32)| {
            let (x, y) = (share(width, self.width), share(height, self.height));
            let is_one_way = (width <= self.width) == (height <= self.height) || x == 1. || y == 1.;
            let pixel = |a: u32, b: u32| 1. / f64::from(a.max(b));
            is_one_way && (x - y).abs() <= pixel(width, self.width) + pixel(height, self.height)
        };
        let (width, height) = choices.into_iter().find(agrees)?;
        let (x, y) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Some(Camera { intrinsics: self.intrinsics.resized(x, y), width, height, ..*self })
    }
}

/// Checks that `c2w` is a rigid motion: finite, with last row (0, 0, 0, 1) and an orthonormal right-handed rotation.
///
/// # Errors
/// Returns (what was found, what was expected).
pub fn check_pose(c2w: &DMat4) -> Result<(), (String, String)> {
    if !c2w.is_finite() {
        return Err(("a matrix with NaN or infinite entries".into(), "finite numbers".into()));
    }
    let last = c2w.row(3);
    if (last - glam::DVec4::W).abs().max_element() > RIGID_TOLERANCE {
        return Err((format!("a matrix with last row {last}"), "a last row of 0, 0, 0, 1".into()));
    }
    let rotation = DMat3::from_mat4(*c2w);
    let determinant = rotation.determinant();
    if determinant.abs() < 1e-9 {
        return Err(("a singular matrix".into(), "a rotation and a translation".into()));
    }
    let gram = rotation.transpose() * rotation;
    let off = (gram - DMat3::IDENTITY).to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
    if off > RIGID_TOLERANCE || determinant < 0. {
        let found = if determinant < 0. {
            "a matrix that mirrors (determinant below 0)".to_string()
        } else {
            format!("a matrix that isn't rigid (RᵀR is {off:.3} off the identity)")
        };
        return Err((found, "a rotation and a translation".into()));
    }
    Ok(())
}

/// Returns the rigid motion that equals `c2w` up to rounding. The 3×3 part A is replaced by the nearest rotation R, the orthogonal
/// factor of A = R·S with S symmetric and positive, and the last row by (0, 0, 0, 1).
///
/// # Errors
/// Fails like [`check_pose`], and if an entry of A differs from R's by more than 1e-3: (what was found, what was expected).
fn nearest_rigid(c2w: &DMat4) -> Result<DMat4, (String, String)> {
    check_pose(c2w)?;
    let given = DMat3::from_mat4(*c2w);
    // Newton's iteration X ← (X + X⁻ᵀ)/2 squares the error, initially at most 5e-3, in every iteration.
    let rotation = (0..4).fold(given, |x, _| (x + x.inverse().transpose()) * 0.5);
    let off = (rotation - given).to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
    if off > ROUNDING_TOLERANCE {
        let found = format!("a matrix that isn't rigid ({off:.4} off the nearest rotation)");
        return Err((found, "a rotation and a translation".into()));
    }
    Ok(DMat4::from_mat3_translation(rotation, c2w.w_axis.truncate()))
}

/// Returns [`nearest_rigid`] of a pose whose 3×3 part may be a rotation times a factor above 0, and that factor. Applying a
/// similarity to poses produces such factors. The position is unchanged.
///
/// # Errors
/// Fails like [`nearest_rigid`].
pub fn nearest_rigid_of_scaled(c2w: &DMat4) -> Result<(DMat4, f64), (String, String)> {
    nearest_rigid(c2w).map(|rigid| (rigid, 1.)).or_else(|why| {
        let scale = DMat3::from_mat4(*c2w).determinant().cbrt();
        if !(scale > 0. && scale.is_finite()) {
            return Err(why);
        }
        let column = |i: usize| c2w.col(i) / scale;
        let remove_scale = DMat4::from_cols(column(0), column(1), column(2), c2w.w_axis);
        // For any other matrix, report the error of the matrix as given.
        nearest_rigid(&remove_scale).map(|rigid| (rigid, scale)).map_err(|_| why)
    })
}

/// Returns the 4×4 matrix, row by row.
pub fn pose_to_rows(pose: &DMat4) -> [f64; 16] {
    pose.transpose().to_cols_array()
}

/// Returns the camera-to-world pose of a camera at `eye` that looks at `target`, with its y axis as close to `down` as possible.
pub fn look_at(eye: DVec3, target: DVec3, down: DVec3) -> DMat4 {
    let forward = (target - eye).normalize();
    let right = down.cross(forward).normalize();
    let down = forward.cross(right);
    DMat4::from_cols(right.extend(0.), down.extend(0.), forward.extend(0.), eye.extend(1.))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_are_scaled_where_the_aspect_agrees_to_a_pixel() {
        let intrinsics = Intrinsics { fx: 500., fy: 510., cx: 250., cy: 180. };
        let camera = Camera { intrinsics, c2w: DMat4::IDENTITY, width: 519, height: 339 };
        let size = |photo| camera.scaled_to(photo).map(|camera| (camera.width, camera.height));
        for photo in [(519, 339), (339, 519), (519, 300), (260, 180), (600, 339), (64, 64), (1038, 600)] {
            assert_eq!(size(photo), None, "{photo:?}");
        }
        // Halves and eighths, rounded down or up; twice the size; one row more. Below: width and height swapped.
        for photo in [(259, 169), (260, 170), (64, 42), (65, 42), (1038, 678), (1037, 678), (519, 340)] {
            assert_eq!(size(photo), Some(photo), "{photo:?}");
        }
        assert_eq!(size((170, 260)), Some((260, 170)));
        let half = Camera { width: 512, height: 340, ..camera }.scaled_to((256, 170)).unwrap();
        assert_eq!(half.intrinsics, Intrinsics { fx: 250., fy: 255., cx: 125., cy: 90. });
    }
}
