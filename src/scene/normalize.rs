//! Scene normalization (spec 2.1 and 2.2): one similarity per scene gives all scenes the same place, direction and size.

use crate::error::{Error, Result};
use glam::{DMat3, DMat4, DVec3};

/// Below it (or when not finite) the spread of the cameras counts as none, and the scene keeps its size.
const MIN_SCALE: f64 = 1e-12;

/// A sum of unit vectors shorter than it points nowhere.
const MIN_DIRECTION: f64 = 1e-6;

/// x ↦ scale · rotation · x + translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// A rotation matrix.
    pub rotation: DMat3,
    /// Applied last.
    pub translation: DVec3,
    /// Uniform, above 0.
    pub scale: f64,
}

impl Similarity {
    /// The pose, camera-to-world, that becomes `c2w` when the similarity moves the world: its camera sees there what `c2w` sees here.
    pub fn pose_before(&self, c2w: &DMat4) -> DMat4 {
        let rotation = self.rotation.transpose();
        let centre = rotation * (c2w.w_axis.truncate() - self.translation) / self.scale;
        let axes = rotation * DMat3::from_mat4(*c2w);
        DMat4::from_cols(
            axes.x_axis.extend(0.),
            axes.y_axis.extend(0.),
            axes.z_axis.extend(0.),
            centre.extend(1.),
        )
    }
}

/// What [`normalize`] finds.
#[derive(Debug, Clone)]
pub struct Normalization {
    /// The poses in the normalized world, camera-to-world, in the order given.
    pub c2w: Vec<DMat4>,
    /// Normalized world to the capture's own; its scale is the largest distance between two camera centres.
    pub world_from_normalized: Similarity,
}

/// Moves the mean camera to the origin, looking along z, and makes the largest distance between two camera centres 1.
///
/// # Errors
/// No cameras, or cameras whose directions cancel out, so that there is no mean direction.
pub fn normalize(c2w: &[DMat4]) -> Result<Normalization> {
    if c2w.is_empty() {
        return Err(Error::Request("a scene without cameras can't be normalized".into()));
    }
    let mean =
        |column: usize| c2w.iter().map(|pose| pose.col(column).truncate()).sum::<DVec3>() / c2w.len() as f64;
    let undirected =
        || Error::Request("the cameras' viewing directions cancel out, so the scene has no front".into());
    let direction = |v: DVec3| if v.length() > MIN_DIRECTION { Ok(v.normalize()) } else { Err(undirected()) };
    let forward = direction(mean(2))?;
    let right = direction(mean(1).cross(forward))?;
    let down = forward.cross(right).normalize();
    let average = DMat4::from_cols(right.extend(0.), down.extend(0.), forward.extend(0.), mean(3).extend(1.));

    let inverse = average.inverse();
    let aligned: Vec<DMat4> = c2w.iter().map(|pose| inverse * *pose).collect();
    let centre = |pose: &DMat4| pose.w_axis.truncate();
    let mut scale = 0f64;
    for (i, a) in aligned.iter().enumerate() {
        for b in &aligned[..i] {
            scale = scale.max(centre(a).distance(centre(b)));
        }
    }
    if !(scale > MIN_SCALE && scale.is_finite()) {
        scale = 1.;
    }
    let c2w = aligned
        .into_iter()
        .map(|mut pose| {
            pose.w_axis = (centre(&pose) / scale).extend(1.);
            pose
        })
        .collect();
    let world_from_normalized =
        Similarity { rotation: DMat3::from_mat4(average), translation: mean(3), scale };
    Ok(Normalization { c2w, world_from_normalized })
}
