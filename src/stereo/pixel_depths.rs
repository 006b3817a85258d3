//! Depths of all pixels of the views that a model reads (spec 3.5), on which several photos agree.

use super::depth_search::{Search, SmallPhoto};
use super::sweep::{SceneDepth, Sweep, filled, most_alike};
use crate::scene::Camera;
use tch::{Device, Kind, Tensor, no_grad};

/// Longer side in pixels of the images whose depths are searched.
const LONGEST_SIDE: f64 = 96.;
/// Number of inverse depths that are tried.
const PLANES: i64 = 64;

/// Power of the fraction of photos that agree on a depth that is its weight.
const AGREEMENT_POWER: i64 = 8;

/// Computes the depths of `images` [V, 3, H, W], values in [0, 1], by a plane sweep over small copies of them. `masks` [V, 1, H, W] are 1
/// where a pixel counts. Returns [V, 2, H, W]: the inverse depth of each pixel along the axis of its camera, in the units of `cameras`, and
/// how sure it is, from 0 to 1.
pub(crate) fn pixel_depths(images: &Tensor, masks: Option<&Tensor>, cameras: &[Camera]) -> Tensor {
    no_grad(|| {
        let photo = |(view, camera): (usize, &Camera)| {
            let of_view = |t: &Tensor| t.get(view as i64);
            SmallPhoto::new("", &of_view(images), masks.map(of_view).as_ref(), *camera, LONGEST_SIDE)
        };
        let photos: Vec<SmallPhoto> = cameras.iter().enumerate().map(photo).collect();
        let depths =
            inverse_depths(&photos, PLANES).into_iter().zip(&photos).map(|([inverse, sure], photo)| {
                let sure = photo.weight.as_ref().map_or(sure.shallow_clone(), |weight| sure * weight);
                Tensor::stack(&[inverse, sure], 0)
            });
        let size = [images.size()[2], images.size()[3]];
        Tensor::stack(&depths.collect::<Vec<_>>(), 0).upsample_bilinear2d(size, false, None, None)
    })
}

/// Computes the inverse depths of all pixels of all `photos` by semi-global matching among `planes` candidates, and how sure each is, in
/// [0, 1]: the fraction of the other photos that agree, and 0 if there is no photo to compare with. Both are [h, w]. Depths on which photos
/// disagree come from pixels around.
pub(super) fn inverse_depths(photos: &[SmallPhoto], planes: i64) -> Vec<[Tensor; 2]> {
    let mut sweep = Sweep::new(photos, &[]);
    let scenes: Vec<SceneDepth> = (0..photos.len()).map(|index| sweep.scene_depth(index)).collect();
    let matched = |(index, scene)| {
        let photo: &SmallPhoto = &photos[index];
        let (others, nearest) = sweep.compared_with(index, scene);
        let (inverse, confidence) = most_alike(photo, &others, nearest, planes, Search::SemiGlobal);
        let step = nearest / (planes - 1) as f64;
        MatchedDepths { photo, inverse, confidence, step, is_measured: !others.is_empty() }
    };
    let all: Vec<MatchedDepths> = scenes.iter().enumerate().map(matched).collect();
    let depths = |(index, of): (usize, &MatchedDepths)| {
        let agreement = if of.is_measured { agreement(index, &all) } else { of.inverse.zeros_like() };
        let weight = agreement.pow_tensor_scalar(AGREEMENT_POWER);
        [filled(&of.inverse, &weight, of.photo.counted().as_ref()), agreement]
    };
    all.iter().enumerate().map(depths).collect()
}

/// Maximum difference of two inverse depths that agree, as a fraction of the larger one.
const RELATIVE_TOLERANCE: f64 = 0.1;
/// The same in planes of the search, if that is more.
const PLANE_TOLERANCE: f64 = 0.75;
/// Weight that is added to that of the photos that agree, and to that of all. A pixel that no other photo shows gets their ratio.
const PRIOR: (f64, f64) = (0.02, 0.1);
/// Least depth of a point that another photo shows, in units of the depth here.
const LEAST_DEPTH: f64 = 1e-6;

// Geometric consistency of the depths of several photos (Schönberger et al. 2016, "Pixelwise View Selection for Unstructured Multi-View
// Stereo"): the depth of a pixel is right if the photos that show its point measure the same.

/// Depths of a photo.
struct MatchedDepths<'a> {
    photo: &'a SmallPhoto,
    /// Inverse depth of each pixel, [h, w].
    inverse: Tensor,
    /// How sure each is by itself, in [0, 1], [h, w].
    confidence: Tensor,
    /// Inverse depth between two planes of the search.
    step: f64,
    /// `false` if there was no photo to compare with.
    is_measured: bool,
}

/// Returns the fraction of the other photos that agree on each pixel's depth, of those that show its point, [h, w]. Photos that are
/// surer of it count more.
fn agreement(index: usize, all: &[MatchedDepths]) -> Tensor {
    let this = &all[index];
    let [height, width] = this.photo.size();
    let centers = |pixels: i64| Tensor::arange(pixels, (Kind::Float, Device::Cpu)) + 0.5;
    let (x, y) = (centers(width), centers(height).unsqueeze(1));
    let (mut agreeing, mut total) =
        (this.inverse.zeros_like() + PRIOR.0, this.inverse.zeros_like() + PRIOR.1);
    for (_, other) in all.iter().enumerate().filter(|(other, _)| *other != index) {
        let m = other.photo.compared_with(&this.photo.camera).to_pixels;
        let row = |i: usize| &x * m[0][i] + &y * m[1][i] + m[2][i] + &this.inverse * m[3][i];
        let [column, row, z] = [0, 1, 2].map(row);
        let is_before = z.gt(LEAST_DEPTH);
        let z = z.clamp_min(LEAST_DEPTH);
        let (column, row) = ((column / &z).floor(), (row / &z).floor());
        let [height, width] = other.photo.size();
        let inside = |t: &Tensor, side: i64| t.ge(0).logical_and(&t.lt(side));
        let is_shown = is_before.logical_and(&inside(&column, width)).logical_and(&inside(&row, height));
        let at = (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).to_kind(Kind::Int64);
        let (found, expected) = (other.inverse.take(&at), &this.inverse / &z);
        let weight = other.confidence.take(&at) * is_shown;
        let tolerance =
            (found.maximum(&expected) * RELATIVE_TOLERANCE).clamp_min(PLANE_TOLERANCE * other.step);
        agreeing += &weight * (found - expected).abs().le_tensor(&tolerance);
        total += weight;
    }
    agreeing / total
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};

    /// Returns the depths that three cameras in a row, `step` apart, measure of a textured plane at depth 4. The left half of the photos is
    /// masked out.
    fn depths_of_plane(step: f64) -> Tensor {
        let options = (Kind::Float, Device::Cpu);
        let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 32. };
        let at = [-step, 0., step];
        let pixels = (Tensor::arange(64, options) + 0.5 - 32.) / 60. * 4.;
        let image = |at: f64| {
            let (x, y) = (&pixels + at, pixels.unsqueeze(1));
            let wave = (&x * 5.).sin() * (&y * 4.).cos() + (&x * 11. + &y * 7.).sin();
            (wave * 0.25 + 0.5).expand([3, 64, 64], false)
        };
        let cameras = at.map(|at| Camera {
            intrinsics,
            c2w: DMat4::from_translation(DVec3::new(at, 0., 0.)),
            width: 64,
            height: 64,
        });
        let masks = Tensor::ones([3, 1, 64, 64], options);
        let _ = masks.narrow(3, 0, 32).zero_();
        pixel_depths(&Tensor::stack(&at.map(image), 0), Some(&masks), &cameras)
    }

    #[test]
    fn depths_are_sure_where_photos_agree() {
        let depths = depths_of_plane(0.3);
        assert_eq!(depths.size(), [3, 2, 64, 64]);
        let seen = depths.narrow(3, 36, 24);
        let error = (seen.select(1, 0) * 4. - 1.).abs().mean(Kind::Float).double_value(&[]);
        // A third of a plane: one is 0.04 of 1 / 4 in these photos, in which the nearest moves by 0.7 of their width.
        assert!(error < 0.05, "{error}");
        assert!(seen.select(1, 1).mean(Kind::Float).double_value(&[]) > 0.8);
        assert_eq!(depths.narrow(3, 0, 32).select(1, 1).max().double_value(&[]), 0., "masked out");
    }

    #[test]
    fn no_depth_is_sure_without_parallax() {
        let depths = depths_of_plane(0.);
        assert_eq!(depths.select(1, 1).max().double_value(&[]), 0.);
        assert_eq!(depths.isfinite().all().int64_value(&[]), 1);
    }

    /// Three cameras in a row look at a plane at depth 4. One of them has measured a wrong depth for some pixels.
    #[test]
    fn a_depth_that_other_photos_contradict_is_unsure() {
        let options = (Kind::Float, Device::Cpu);
        let intrinsics = Intrinsics { fx: 60., fy: 60., cx: 32., cy: 24. };
        let photos = [0., 0.2, 0.4].map(|at| {
            let c2w = DMat4::from_translation(DVec3::new(at, 0., 0.));
            let camera = Camera { intrinsics, c2w, width: 64, height: 48 };
            SmallPhoto::new("", &Tensor::rand([3, 48, 64], options), None, camera, 64.)
        });
        let all = [0, 1, 2].map(|index| {
            let inverse = Tensor::full([48, 64], 0.25, options);
            if index == 1 {
                let _ = inverse.narrow(1, 20, 8).fill_(0.4);
            }
            let confidence = Tensor::ones([48, 64], options);
            MatchedDepths { photo: &photos[index], inverse, confidence, step: 0.01, is_measured: true }
        });
        let agreement = agreement(1, &all);
        assert!(agreement.narrow(1, 20, 8).max().double_value(&[]) < 0.1);
        assert!(agreement.narrow(1, 28, 30).min().double_value(&[]) > 0.9);
        // Only the first photo shows the first column.
        assert!(agreement.narrow(1, 0, 1).min().double_value(&[]) > 0.9);
    }
}
