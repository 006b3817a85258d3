//! Which surfaces too few photos show, and where photos would show most of them.

use crate::scene::Camera;
use crate::stereo::{ComparablePhoto, PhotoSurface, PlaneSweepOutput, projection};
use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use std::fmt;

/// Number of photos from which on a surface is well covered.
const WELL_COVERED: usize = 3;
/// Every how many patches of a photo one is counted.
const SAMPLED: usize = 4;
/// Distance between a photo and one to take near it, in units of the distance to the surface: about 10°.
const MOVE: f64 = 0.17;
/// Number of photos to suggest.
const SUGGESTED: usize = 3;
/// Minimum fraction of all surfaces that a suggested photo has to show of those that too few photos show.
const MIN_GAIN: f64 = 0.01;

/// Photo that would show surfaces which too few photos show.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NextPhoto {
    /// Name of the photo to start from.
    pub near: String,
    /// Direction to step from there, as that photo shows it: left, right, up or down.
    pub step: &'static str,
    /// Position of the camera in the capture's world.
    pub position: [f64; 3],
    /// Position that it looks at.
    pub look_at: [f64; 3],
    /// Fraction of all known surfaces that it shows and at most two photos do.
    pub gain: f64,
}

/// Formats where to take the photo, as `a step to the left of a.jpg`.
impl fmt::Display for NextPhoto {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let place = match self.step {
            "up" => "above",
            "down" => "below",
            side => return write!(f, "a step to the {side} of {}", self.near),
        };
        write!(f, "a step {place} {}", self.near)
    }
}

/// Surfaces that photos show, and how many do.
pub(super) struct Coverage {
    /// Index of the photo by whose depths each surface is known, its position, and the number of photos that show it.
    surfaces: Vec<(usize, DVec3, usize)>,
}

impl Coverage {
    /// Counts the `photos` that show each of `surfaces`, the surfaces of photos with their indices.
    pub fn new(surfaces: &[(usize, PhotoSurface)], photos: &[ComparablePhoto]) -> Self {
        let shows: Vec<_> = photos.iter().map(ComparablePhoto::shows).collect();
        let count = |(index, surface): &(usize, PhotoSurface)| -> Vec<_> {
            let count = |position: DVec3| shows.iter().filter(|shows| shows(position)).count();
            let patches = surface.patches.iter().step_by(SAMPLED);
            patches.map(|patch| (*index, patch.position, count(patch.position))).collect()
        };
        Coverage { surfaces: surfaces.par_iter().flat_map_iter(count).collect() }
    }

    fn is_thin(&(_, _, count): &(usize, DVec3, usize)) -> bool {
        count < WELL_COVERED
    }

    /// Returns the fraction of the surfaces that fewer than three photos show.
    pub fn thin_share(&self) -> f64 {
        let thin = self.surfaces.iter().filter(|surface| Self::is_thin(surface)).count();
        thin as f64 / self.surfaces.len().max(1) as f64
    }

    /// Returns the positions of all surfaces, and the number of photos that show each.
    pub fn points(&self) -> impl Iterator<Item = (DVec3, usize)> {
        self.surfaces.iter().map(|&(_, position, count)| (position, count))
    }

    /// Returns up to three photos to take, one after the other the one that shows most of the surfaces that too few photos show: a step from
    /// a photo to a side, turned to those surfaces.
    pub fn next_photos(mut self, swept: &PlaneSweepOutput) -> Vec<NextPhoto> {
        let mut candidates: Vec<(usize, &'static str, Camera, DVec3)> = vec![];
        for (index, map) in &swept.depth_maps {
            let thin: Vec<DVec3> =
                self.surfaces.iter().filter(|s| s.0 == *index && Self::is_thin(s)).map(|s| s.1).collect();
            if thin.is_empty() {
                continue;
            }
            let target = thin.iter().sum::<DVec3>() / thin.len() as f64;
            let [right, down, center] = [map.camera.c2w.x_axis, map.camera.c2w.y_axis, map.camera.c2w.w_axis]
                .map(|axis| axis.truncate());
            for (step, direction) in [("right", right), ("left", -right), ("down", down), ("up", -down)] {
                let position = center + direction * MOVE * center.distance(target);
                let c2w = look_at(position, target, down);
                candidates.push((*index, step, Camera { c2w, ..map.camera }, target));
            }
        }
        let mut chosen = vec![];
        while chosen.len() < SUGGESTED {
            let gain = |(index, _, camera, target): &(usize, &str, Camera, DVec3)| {
                let (project, center) = (projection(camera), camera.c2w.w_axis.truncate());
                let far = 2. * center.distance(*target);
                let shown = |s: &&(usize, DVec3, usize)| {
                    s.0 == *index && Self::is_thin(s) && center.distance(s.1) < far && project(s.1).is_some()
                };
                self.surfaces.iter().filter(shown).count()
            };
            let gains: Vec<usize> = candidates.par_iter().map(gain).collect();
            let Some(best) = (0..gains.len()).rev().max_by_key(|&candidate| gains[candidate]) else { break };
            let (index, step, camera, target) = candidates[best];
            let gain = gains[best] as f64 / self.surfaces.len() as f64;
            if gain < MIN_GAIN {
                break;
            }
            let project = projection(&camera);
            for surface in &mut self.surfaces {
                if project(surface.1).is_some() {
                    surface.2 = WELL_COVERED;
                }
            }
            let near = swept.photos[index].name.clone();
            let position = camera.c2w.w_axis.truncate().to_array();
            chosen.push(NextPhoto { near, step, position, look_at: target.to_array(), gain });
        }
        chosen
    }
}

/// Returns the pose of a camera at `position` that looks at `target`, with `down` toward the lower edge of its image.
fn look_at(position: DVec3, target: DVec3, down: DVec3) -> DMat4 {
    let forward = (target - position).normalize();
    let right = down.cross(forward).normalize();
    DMat4::from_mat3_translation(DMat3::from_cols(right, forward.cross(right), forward), position)
}
