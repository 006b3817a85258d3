//! Edits of a splat: moving it, removing Gaussians, and joining splats.

use super::{contributions, largest_contributions, orbit_around_splat};
use crate::error::{Error, Result};
use crate::scene::{Camera, Gaussians, splat_frame};
use glam::{DMat3, DMat4, DVec3};
use globalsplat_splat_file::Splat;
use kd_tree::KdTree;
use rayon::prelude::*;

/// Contribution to all images, in pixels, below which cameras don't see a Gaussian.
const MIN_CONTRIBUTION: f32 = 1e-3;
/// Number of neighbours within whose distance a Gaussian isn't isolated.
const NEIGHBOURS: usize = 8;
/// Number of standard deviations that a Gaussian extends to, for its neighbours.
const EXTENT: f32 = 3.;

/// Edit of a splat. Coordinates are world coordinates of the splat as the edits before it leave it.
#[derive(Debug, Clone)]
pub enum SplatEdit {
    /// Moves every point x to matrix · x: a rotation, a uniform scale and a translation.
    Transform(DMat4),
    /// Removes Gaussians whose mean is outside of the box between two corners.
    CropBox(DVec3, DVec3),
    /// Removes Gaussians whose mean is farther from a centre than a radius.
    CropSphere(DVec3, f64),
    /// Removes Gaussians of a lower opacity.
    MinOpacity(f64),
    /// Removes Gaussians with a larger scale along any axis.
    MaxScale(f64),
    /// Removes isolated Gaussians: those whose eighth neighbour is beyond their own size, and farther than the median of this distance
    /// times a factor.
    FilterFloaters(f64),
    /// Removes Gaussians that contribute less than a thousandth of a pixel to all images of cameras together. The cameras are in the world of the
    /// splat before all edits.
    SeenBy(Vec<Camera>),
    /// Keeps this number of Gaussians: those that contribute most to images.
    Decimate(usize),
    /// Adds the Gaussians of another splat.
    Merge(Box<Splat>),
}

/// Result of [`edit_splat`].
#[derive(Debug)]
pub struct EditedSplat {
    /// The splat after all edits.
    pub splat: Splat,
    /// Transform from the world of the original splat to that of the edited one.
    pub from_original: DMat4,
    /// Number of Gaussians after each edit.
    pub counts: Vec<usize>,
}

/// Applies `edits` in their order. [`SplatEdit::Decimate`] keeps what contributes most to the images of `cameras`, which are in the world of
/// the original splat, or if there are none, to views around the splat.
///
/// # Errors
/// Fails if a matrix does more than rotate, scale uniformly and translate, if no Gaussian is left, or like [`crate::render::render`].
pub fn edit_splat(original: &Splat, edits: &[SplatEdit], cameras: &[Camera]) -> Result<EditedSplat> {
    let mut edited = EditedSplat { splat: original.clone(), from_original: DMat4::IDENTITY, counts: vec![] };
    for (index, edit) in edits.iter().enumerate() {
        let before = edited.splat.len();
        edited.apply(edit, cameras)?;
        if edited.splat.is_empty() && before > 0 {
            let which = format!("edit {} of {}", index + 1, edits.len());
            let why = format!("{which} removes all {before} Gaussians, expected at least one that is left");
            return Err(Error::request(why));
        }
        edited.counts.push(edited.splat.len());
    }
    Ok(edited)
}

/// Returns the cameras that see a world moved by `matrix` as `cameras` see the original one. The matrix rotates, scales uniformly and
/// translates.
pub fn move_cameras(cameras: &[Camera], matrix: &DMat4) -> Vec<Camera> {
    let linear = DMat3::from_mat4(*matrix);
    let rotation = linear * linear.determinant().cbrt().recip();
    let moved = |camera: &Camera| {
        let centre = matrix.transform_point3(camera.c2w.w_axis.truncate());
        let c2w = DMat4::from_mat3_translation(rotation * DMat3::from_mat4(camera.c2w), centre);
        Camera { c2w, ..*camera }
    };
    cameras.iter().map(moved).collect()
}

impl EditedSplat {
    fn apply(&mut self, edit: &SplatEdit, cameras: &[Camera]) -> Result<()> {
        match edit {
            SplatEdit::Transform(matrix) => {
                // With an origin in float64, several moves, or one far away, don't round the positions.
                if self.splat.origin == DVec3::ZERO {
                    self.splat = self.splat.with_origin(splat_frame(&self.splat).origin);
                }
                self.splat = self.splat.transformed(matrix)?;
                self.from_original = *matrix * self.from_original;
            }
            SplatEdit::CropBox(min, max) => {
                self.retain_means(|mean| mean.cmpge(*min).all() && mean.cmple(*max).all())
            }
            SplatEdit::CropSphere(centre, radius) => {
                self.retain_means(|mean| mean.distance(*centre) <= *radius)
            }
            SplatEdit::MinOpacity(min) => self.retain(|splat, index| f64::from(splat.opacity(index)) >= *min),
            SplatEdit::MaxScale(max) => {
                self.retain(|splat, index| splat.scale(index).iter().all(|&scale| f64::from(scale) <= *max));
            }
            SplatEdit::FilterFloaters(factor) => self.filter_floaters(*factor as f32),
            SplatEdit::SeenBy(cameras) => {
                let seen = self.contributions(&move_cameras(cameras, &self.from_original))?;
                self.retain(|_, index| seen[index] >= MIN_CONTRIBUTION);
            }
            SplatEdit::Decimate(count) => {
                let cameras = match cameras {
                    [] => orbit_around_splat(&self.splat),
                    cameras => move_cameras(cameras, &self.from_original),
                };
                let mut kept = largest_contributions(&self.contributions(&cameras)?, *count);
                kept.sort_unstable();
                self.splat = self.splat.select(&kept);
            }
            SplatEdit::Merge(other) => self.splat = self.splat.merged(other),
        }
        Ok(())
    }

    fn retain(&mut self, is_kept: impl Fn(&Splat, usize) -> bool) {
        let kept: Vec<usize> = (0..self.splat.len()).filter(|&index| is_kept(&self.splat, index)).collect();
        if kept.len() < self.splat.len() {
            self.splat = self.splat.select(&kept);
        }
    }

    /// Keeps the Gaussians for whose mean in world coordinates `is_kept` returns `true`.
    fn retain_means(&mut self, is_kept: impl Fn(DVec3) -> bool) {
        let mean =
            |splat: &Splat, index: usize| splat.origin + DVec3::from(splat.means[index].map(f64::from));
        self.retain(|splat, index| is_kept(mean(splat, index)));
    }

    fn filter_floaters(&mut self, factor: f32) {
        let distances = neighbor_distances(&self.splat.means, NEIGHBOURS);
        let mut sorted = distances.clone();
        sorted.sort_unstable_by(f32::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.);
        self.retain(|splat, index| {
            let size = EXTENT * splat.scale(index).into_iter().fold(0., f32::max);
            distances[index] <= (factor * median).max(size)
        });
    }

    fn contributions(&self, cameras: &[Camera]) -> Result<Vec<f32>> {
        let frame = splat_frame(&self.splat);
        let gaussians = Gaussians::from_splat(&self.splat).to_local(&frame, self.splat.origin);
        contributions(&gaussians, &frame.cameras_to_local(cameras))
    }
}

/// Returns the distance of each point to its `k`th nearest other point; infinite if there are fewer.
fn neighbor_distances(points: &[[f32; 3]], k: usize) -> Vec<f32> {
    let tree = KdTree::build_by_ordered_float(points.to_vec());
    let distance = |point: &[f32; 3]| {
        // The nearest of all points is the point itself.
        let nearest = tree.nearests(point, k + 1);
        nearest.get(k).map_or(f32::INFINITY, |neighbor| neighbor.squared_distance.sqrt())
    };
    points.par_iter().map(distance).collect()
}
