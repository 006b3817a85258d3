//! Downscaled photos that are compared with each other.

use super::depth_search::{self, ComparedPhoto};
use super::photos::pool_masked;
use crate::data::View;
use crate::scene::{Camera, Intrinsics};
use glam::{DMat3, DVec3};
use tch::{Device, Kind, Tensor};

/// Downscaled photo.
pub(super) struct SmallPhoto {
    pub name: String,
    pub camera: Camera,
    /// Colours, [3, h, w].
    pub image: Tensor,
    /// Mean over the colour channels, [h, w].
    pub grey: Tensor,
    /// Weight of each pixel, [h, w]; `None` if every pixel counts.
    pub weight: Option<Tensor>,
}

impl SmallPhoto {
    /// Downscales a photo to at most `longest_side` pixels along its longer side.
    pub fn from_view(view: &View, longest_side: f64) -> Self {
        let (camera, side) = (view.camera, |pixels: u32| f64::from(pixels));
        let factor = (longest_side / side(camera.width.max(camera.height))).min(1.);
        let resized = |pixels: u32| ((side(pixels) * factor).round() as i64).max(depth_search::PATCH);
        let (height, width) = (resized(camera.height), resized(camera.width));
        let pool = |t: &Tensor| t.unsqueeze(0).adaptive_avg_pool2d([height, width]).squeeze_dim(0);
        let mask = view.mask.as_ref().map(|mask| mask.to_float().to_device(Device::Cpu));
        let (image, weight) = pool_masked(&view.image.to_float().to_device(Device::Cpu), mask.as_ref(), pool);
        let grey = image.mean_dim([0].as_slice(), false, Kind::Float);
        let scale = (width as f64 / side(camera.width), height as f64 / side(camera.height));
        let intrinsics = camera.intrinsics.resized(scale.0, scale.1);
        SmallPhoto {
            name: view.name.clone(),
            camera: Camera { intrinsics, width: width as u32, height: height as u32, ..camera },
            image,
            grey,
            weight: weight.map(|weight| weight.squeeze_dim(0)),
        }
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
