//! Depths of all pixels of the views that a model reads (spec 3.5).

use super::small_photo::SmallPhoto;
use super::sweep::inverse_depths;
use crate::scene::Camera;
use tch::{Tensor, no_grad};

/// Longer side in pixels of the images whose depths are searched.
const LONGEST_SIDE: f64 = 96.;
/// Number of inverse depths that are tried.
const PLANES: i64 = 64;

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use glam::{DMat4, DVec3};
    use tch::{Device, Kind};

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
}
