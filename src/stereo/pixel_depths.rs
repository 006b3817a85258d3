//! Depths of all pixels of the views that a model reads (spec 3.5).

use super::small_photo::SmallPhoto;
use super::sweep::inverse_depths;
use crate::scene::Camera;
use tch::{Tensor, no_grad};

/// Longer side in pixels of the images whose depths are searched.
const LONGEST_SIDE: f64 = 96.;
/// Number of inverse depths that are tried.
const PLANES: i64 = 64;
/// How sure a depth is at least.
const LEAST_SURE: f64 = 0.05;

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
        let depths = inverse_depths(&photos, PLANES)
            .into_iter()
            .map(|[inverse, sure]| Tensor::stack(&[inverse, sure.clamp_min(LEAST_SURE)], 0));
        let size = [images.size()[2], images.size()[3]];
        Tensor::stack(&depths.collect::<Vec<_>>(), 0).upsample_bilinear2d(size, false, None, None)
    })
}
