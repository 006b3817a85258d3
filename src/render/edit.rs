//! Edits of a splat: moving it (spec 2.4), removing Gaussians, by how much they contribute to images or otherwise, and joining splats.

use super::{Cameras, default_eps2d, orbit_around_splat, render};
use crate::error::{Error, Result};
use crate::scene::{Camera, Gaussians, SH_C0, Similarity, Upright, estimate_upright, splat_frame};
use glam::{DMat3, DMat4, DQuat, DVec3};
use globalsplat_splat_file::{ShRotation, Splat};
use kd_tree::KdTree;
use rayon::prelude::*;
use tch::{Tensor, with_grad};

/// Returns the splat with every point x moved to `to(x)`. Images from cameras that are moved along stay the same, and their depth is
/// scaled.
pub fn transform(gaussians: &Gaussians, to: &Similarity) -> Gaussians {
    let on = |t: Tensor, like: &Tensor| t.to_kind(like.kind()).to_device(like.device());
    let rotation =
        on(Tensor::from_slice(&to.rotation.transpose().to_cols_array()).view([3, 3]), &gaussians.means);
    let translation = on(Tensor::from_slice(&to.translation.to_array()), &gaussians.means);
    Gaussians {
        means: gaussians.means.matmul(&rotation.tr()) * to.scale + translation,
        scales: &gaussians.scales * to.scale,
        quaternions: rotate_quaternions(&gaussians.quaternions, DQuat::from_mat3(&to.rotation)),
        opacities: gaussians.opacities.shallow_clone(),
        sh: rotate_sh(&gaussians.sh, &to.rotation),
        antialiased: gaussians.antialiased,
    }
}

/// Returns `by` · q for every quaternion q in [.., 4], (w, x, y, z).
fn rotate_quaternions(quaternions: &Tensor, by: DQuat) -> Tensor {
    let [x, y, z, w] = by.to_array();
    // Left multiplication by a quaternion is linear.
    let matrix = [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w];
    let matrix =
        Tensor::from_slice(&matrix).view([4, 4]).to_kind(quaternions.kind()).to_device(quaternions.device());
    quaternions.matmul(&matrix.tr())
}

/// Returns the coefficients [.., bases, 3] of the functions d ↦ f(Rᵀd), for the coefficients of functions f.
fn rotate_sh(sh: &Tensor, rotation: &DMat3) -> Tensor {
    let bases = sh.size()[sh.dim() - 2];
    let matrix = Tensor::from_slice(ShRotation::new(rotation).rows().as_flattened()).view([16, 16]);
    let matrix = matrix.narrow(0, 0, bases).narrow(1, 0, bases);
    matrix.to_kind(sh.kind()).to_device(sh.device()).matmul(sh)
}

/// Contribution to all images, in pixels, below which cameras don't see a Gaussian.
const MIN_CONTRIBUTION: f32 = 1e-3;
/// Opacity from which a Gaussian's mean counts as a point on a surface.
const MIN_SURFACE_OPACITY: f32 = 0.5;
/// Number of neighbours within whose distance a Gaussian isn't isolated.
const NEIGHBOURS: usize = 8;
/// Number of standard deviations that a Gaussian extends to, for its neighbours.
const EXTENT: f32 = 3.;

/// Edit of a splat. Coordinates are world coordinates of the splat as the edits before it leave it.
#[derive(Debug, Clone)]
pub enum SplatEdit {
    /// Moves every point x to matrix · x: a rotation, a uniform scale and a translation.
    Transform(DMat4),
    /// Turns the splat so that -y points up and its floor is at y = 0, as [`estimate_upright`] does by cameras and the means of opaque Gaussians.
    /// The cameras are in the world of the splat before all edits.
    Upright(Vec<Camera>),
    /// Removes Gaussians whose mean is outside of the box between two corners.
    CropBox(DVec3, DVec3),
    /// Removes Gaussians whose mean is farther from a center than a radius.
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
    /// What the last [`SplatEdit::Upright`] follows from.
    pub upright: Option<Upright>,
}

/// Applies `edits` in their order. [`SplatEdit::Decimate`] keeps what contributes most to the images of `cameras`, which are in the world of
/// the original splat, or if there are none, to views around the splat.
///
/// # Errors
/// Fails if a matrix does more than rotate, scale uniformly and translate, if [`SplatEdit::Upright`] has no cameras, if no Gaussian is left, or like [`render`].
pub fn edit_splat(original: &Splat, edits: &[SplatEdit], cameras: &[Camera]) -> Result<EditedSplat> {
    let mut edited = EditedSplat {
        splat: original.clone(),
        from_original: DMat4::IDENTITY,
        counts: vec![],
        upright: None,
    };
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
        let center = matrix.transform_point3(camera.c2w.w_axis.truncate());
        let c2w = DMat4::from_mat3_translation(rotation * DMat3::from_mat4(camera.c2w), center);
        Camera { c2w, ..*camera }
    };
    cameras.iter().map(moved).collect()
}

impl EditedSplat {
    fn apply(&mut self, edit: &SplatEdit, cameras: &[Camera]) -> Result<()> {
        match edit {
            SplatEdit::Transform(matrix) => self.transform(matrix)?,
            SplatEdit::Upright(cameras) => {
                let cameras = move_cameras(cameras, &self.from_original);
                let poses: Vec<DMat4> = cameras.iter().map(|camera| camera.c2w).collect();
                let is_opaque = |index: &usize| self.splat.opacity(*index) >= MIN_SURFACE_OPACITY;
                let opaque = (0..self.splat.len()).filter(is_opaque);
                let means: Vec<DVec3> = opaque.map(|index| mean(&self.splat, index)).collect();
                let upright = estimate_upright(&poses, &means, &[])?;
                self.transform(&upright.matrix)?;
                self.upright = Some(upright);
            }
            SplatEdit::CropBox(min, max) => {
                self.retain_means(|mean| mean.cmpge(*min).all() && mean.cmple(*max).all())
            }
            SplatEdit::CropSphere(center, radius) => {
                self.retain_means(|mean| mean.distance(*center) <= *radius)
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

    fn transform(&mut self, matrix: &DMat4) -> Result<()> {
        // With an origin in float64, several moves, or one far away, don't round the positions.
        if self.splat.origin == DVec3::ZERO {
            self.splat = self.splat.with_origin(splat_frame(&self.splat).origin);
        }
        self.splat = self.splat.transformed(matrix)?;
        self.from_original = *matrix * self.from_original;
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

/// Returns the mean of a Gaussian in world coordinates.
fn mean(splat: &Splat, index: usize) -> DVec3 {
    splat.origin + DVec3::from(splat.means[index].map(f64::from))
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

/// Returns the contribution of each Gaussian to the images of `cameras`, in pixels: the sum over all pixels of its weight α·T, its opacity
/// there times the transmittance in front of it. `gaussians` are of one scene, in the cameras' local frame (spec 2.5).
///
/// The weight of a Gaussian in a pixel is the derivative of the pixel's color with respect to the Gaussian's color.
///
/// # Errors
/// Fails like [`render`].
pub fn contributions(gaussians: &Gaussians, cameras: &[Camera]) -> Result<Vec<f32>> {
    let mut total = gaussians.opacities.zeros_like();
    for camera in cameras {
        total += image_contributions(gaussians, &Cameras::single(camera))?;
    }
    Vec::try_from(total.view([-1])).map_err(Error::external)
}

/// Returns the indices of the `count` Gaussians, or of all if there are fewer, with the largest `contributions`, the largest first.
pub(crate) fn largest_contributions(contributions: &[f32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..contributions.len()).collect();
    order.sort_by(|&a, &b| contributions[b].total_cmp(&contributions[a]));
    order.truncate(count);
    order
}

/// Returns the contribution of each Gaussian to the images of `cameras` together, [B, N], as [`contributions`] does.
pub(crate) fn image_contributions(gaussians: &Gaussians, cameras: &Cameras) -> Result<Tensor> {
    let (b, n) = gaussians.opacities.size2().map_err(Error::external)?;
    let colors = Tensor::zeros([b, n, 1, 3], (gaussians.means.kind(), gaussians.means.device()));
    let colors = colors.set_requires_grad(true);
    let gray = Gaussians { sh: colors.shallow_clone(), ..gaussians.map(Tensor::detach) };
    let red = with_grad(|| -> Result<Tensor> {
        let image = render(&gray, cameras, default_eps2d(gaussians))?;
        Ok(image.rgb.select(2, 0).sum(None))
    })?;
    Ok(Tensor::run_backward(&[red], &[colors], false, false)[0].select(3, 0).select(2, 0) / SH_C0)
}
