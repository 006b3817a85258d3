//! Downscaled photos that are compared with each other.

use super::depth_search::{self, ComparedPhoto};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat3, DVec3};
use tch::{Kind, Tensor};

/// Downscaled photo.
#[derive(Debug)]
pub(crate) struct SmallPhoto {
    pub name: String,
    pub camera: Camera,
    /// Colors, [3, h, w].
    pub image: Tensor,
    /// Mean over the color channels, [h, w].
    pub grey: Tensor,
    /// Weight of each pixel, [h, w]; `None` if every pixel counts.
    pub weight: Option<Tensor>,
}

impl SmallPhoto {
    /// Downscales a photo to at most `longest_side` pixels along its longer side. `image` [3, H, W] has values in [0, 1], and `mask`
    /// [1, H, W] is 1 where a pixel counts, both on the CPU.
    pub fn new(name: &str, image: &Tensor, mask: Option<&Tensor>, camera: Camera, longest_side: f64) -> Self {
        let side = |pixels: u32| f64::from(pixels);
        let factor = (longest_side / side(camera.width.max(camera.height))).min(1.);
        let resized = |pixels: u32| ((side(pixels) * factor).round() as i64).max(depth_search::PATCH);
        let (height, width) = (resized(camera.height), resized(camera.width));
        let pool = |t: &Tensor| t.unsqueeze(0).adaptive_avg_pool2d([height, width]).squeeze_dim(0);
        let (image, weight) = pool_masked(image, mask, pool);
        let grey = image.mean_dim([0].as_slice(), false, Kind::Float);
        let scale = (width as f64 / side(camera.width), height as f64 / side(camera.height));
        let intrinsics = camera.intrinsics.resized(scale.0, scale.1);
        SmallPhoto {
            name: name.into(),
            camera: Camera { intrinsics, width: width as u32, height: height as u32, ..camera },
            image,
            grey,
            weight: weight.map(|weight| weight.squeeze_dim(0)),
        }
    }

    /// Returns the photo with at most `longest_side` pixels along its longer side.
    pub fn downscaled(&self, longest_side: f64) -> Self {
        let weight = self.weight.as_ref().map(|weight| weight.unsqueeze(0));
        SmallPhoto::new(&self.name, &self.image, weight.as_ref(), self.camera, longest_side)
    }

    /// Returns the mask of the pixels with at least half of the largest weight, [h, w]; `None` if every pixel counts.
    pub fn counted(&self) -> Option<Tensor> {
        self.weight.as_ref().map(|weight| weight.ge_tensor(&(weight.max() * 0.5)))
    }

    /// Returns this photo for a comparison with one that `camera` has taken.
    pub fn compared_with(&self, camera: &Camera) -> ComparedPhoto<'_> {
        // A pixel at inverse depth w is at rotation · ray + w · translation in this camera, up to a factor.
        let to_this = self.camera.c2w.inverse() * camera.c2w;
        let rotation = DMat3::from_mat4(to_this);
        let pixels_of =
            |k: &Intrinsics| DMat3::from_cols_array(&[k.fx, 0., 0., 0., k.fy, 0., k.cx, k.cy, 1.]);
        let pixels = pixels_of(&self.camera.intrinsics);
        let to_pixels = pixels * rotation * pixels_of(&camera.intrinsics).inverse();
        ComparedPhoto {
            grey: &self.grey,
            weight: self.weight.as_ref(),
            to_pixels: [
                to_pixels.x_axis,
                to_pixels.y_axis,
                to_pixels.z_axis,
                pixels * to_this.w_axis.truncate(),
            ],
        }
    }

    /// Returns the camera's position.
    pub fn centre(&self) -> DVec3 {
        self.camera.c2w.w_axis.truncate()
    }

    /// Returns height and width.
    pub fn size(&self) -> [i64; 2] {
        [i64::from(self.camera.height), i64::from(self.camera.width)]
    }
}

/// Downscales images [.., 3, H, W] and their masks [.., 1, H, W] by `pool`. Colors are means over the pixels that count.
pub(crate) fn pool_masked(
    images: &Tensor,
    masks: Option<&Tensor>,
    pool: impl Fn(&Tensor) -> Tensor,
) -> (Tensor, Option<Tensor>) {
    const LEAST: f64 = 1e-6;
    let Some(masks) = masks else { return (pool(images), None) };
    let weights = pool(masks);
    (pool(&(images * masks)) / weights.clamp_min(LEAST), Some(weights))
}
