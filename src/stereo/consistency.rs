//! Geometric consistency of the depths of several photos (Schönberger et al. 2016, "Pixelwise View Selection for Unstructured Multi-View
//! Stereo"): the depth of a pixel is right if the photos that show its point measure the same.

use super::small_photo::SmallPhoto;
use tch::{Device, Kind, Tensor};

/// Maximum difference of two inverse depths that agree, as a fraction of the larger one.
const RELATIVE_TOLERANCE: f64 = 0.1;
/// The same in planes of the search, if that is more.
const PLANE_TOLERANCE: f64 = 0.75;
/// Weight that is added to that of the photos that agree, and to that of all. A pixel that no other photo shows gets their ratio.
const PRIOR: (f64, f64) = (0.02, 0.1);
/// Least depth of a point that another photo shows, in units of the depth here.
const LEAST_DEPTH: f64 = 1e-6;

/// Depths of a photo.
pub(super) struct MatchedDepths<'a> {
    pub photo: &'a SmallPhoto,
    /// Inverse depth of each pixel, [h, w].
    pub inverse: Tensor,
    /// How sure each is by itself, in [0, 1], [h, w].
    pub sureness: Tensor,
    /// Inverse depth between two planes of the search.
    pub step: f64,
    /// `false` if there was no photo to compare with.
    pub is_measured: bool,
}

/// Returns the fraction of the other photos that agree on each pixel's depth, of those that show its point, [h, w]. Photos that are
/// surer of it count more.
pub(super) fn agreement(index: usize, all: &[MatchedDepths]) -> Tensor {
    let this = &all[index];
    let [height, width] = this.photo.size();
    let centres = |pixels: i64| Tensor::arange(pixels, (Kind::Float, Device::Cpu)) + 0.5;
    let (x, y) = (centres(width), centres(height).unsqueeze(1));
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
        let weight = other.sureness.take(&at) * is_shown;
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
    use crate::scene::{Camera, Intrinsics};
    use glam::{DMat4, DVec3};

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
            let sureness = Tensor::ones([48, 64], options);
            MatchedDepths { photo: &photos[index], inverse, sureness, step: 0.01, is_measured: true }
        });
        let agreement = agreement(1, &all);
        assert!(agreement.narrow(1, 20, 8).max().double_value(&[]) < 0.1);
        assert!(agreement.narrow(1, 28, 30).min().double_value(&[]) > 0.9);
        // Only the first photo shows the first column.
        assert!(agreement.narrow(1, 0, 1).min().double_value(&[]) > 0.9);
    }
}
