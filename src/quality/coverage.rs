//! Coverage of the surfaces by photos, and photos that would show most of those that too few show.

use crate::scene::{Camera, look_at};
use crate::stereo::{ComparablePhoto, PhotoSurface, PlaneSweepOutput, projection};
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use std::fmt;

/// Number of photos from which on a surface is well covered.
const WELL_COVERED: usize = 3;
/// Stride of the patches that are counted.
const STRIDE: usize = 4;
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
    pub position: DVec3,
    /// Position that it looks at.
    pub look_at: DVec3,
    /// Fraction of all surfaces that it shows, the photo to start from, too, and at most two photos do.
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
            let patches = surface.patches.iter().step_by(STRIDE);
            patches.map(|patch| (*index, patch.position, count(patch.position))).collect()
        };
        Coverage { surfaces: surfaces.par_iter().flat_map_iter(count).collect() }
    }

    fn is_rarely_seen(&(_, _, count): &(usize, DVec3, usize)) -> bool {
        count < WELL_COVERED
    }

    /// Returns the fraction of the surfaces that fewer than three photos show.
    pub fn rarely_seen_share(&self) -> f64 {
        let rarely_seen = self.surfaces.iter().filter(|surface| Self::is_rarely_seen(surface)).count();
        rarely_seen as f64 / self.surfaces.len().max(1) as f64
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
            let rarely_seen: Vec<DVec3> = self
                .surfaces
                .iter()
                .filter(|s| s.0 == *index && Self::is_rarely_seen(s))
                .map(|s| s.1)
                .collect();
            if rarely_seen.is_empty() {
                continue;
            }
            let target = rarely_seen.iter().sum::<DVec3>() / rarely_seen.len() as f64;
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
            let shows = |(index, _, camera, target): &(usize, &str, Camera, DVec3)| {
                let (index, project, center) = (*index, projection(camera), camera.c2w.w_axis.truncate());
                let far = 2. * center.distance(*target);
                // Surfaces that other photos know may be occluded.
                move |surface: &(usize, DVec3, usize)| {
                    surface.0 == index && center.distance(surface.1) < far && project(surface.1).is_some()
                }
            };
            let gain = |candidate: &(usize, &str, Camera, DVec3)| {
                let shows = shows(candidate);
                self.surfaces.iter().filter(|surface| Self::is_rarely_seen(surface) && shows(surface)).count()
            };
            let gains: Vec<usize> = candidates.par_iter().map(gain).collect();
            let Some(best) = (0..gains.len()).rev().max_by_key(|&candidate| gains[candidate]) else { break };
            let (index, step, camera, target) = candidates[best];
            let gain = gains[best] as f64 / self.surfaces.len() as f64;
            if gain < MIN_GAIN {
                break;
            }
            let shows = shows(&candidates[best]);
            self.surfaces.iter_mut().filter(|surface| shows(surface)).for_each(|surface| surface.2 += 1);
            let near = swept.photos[index].name.clone();
            let position = camera.c2w.w_axis.truncate();
            chosen.push(NextPhoto { near, step, position, look_at: target, gain });
        }
        chosen
    }
}
