//! Depths of a photo that the plane sweep has found.

use crate::scene::Camera;
use tch::{Device, Tensor};

/// Downscaled photo with a depth for every pixel.
#[derive(Debug)]
pub struct DepthMap {
    /// Name of the photo.
    pub photo: String,
    /// Camera at the size of the downscaled photo.
    pub camera: Camera,
    /// Downscaled photo, [3, h, w].
    pub image: Tensor,
    /// Depth along the camera's axis, [h, w].
    pub depth: Tensor,
    /// Mask of the pixels on whose depth the photos agree, [h, w]. Other depths come from pixels around them.
    pub sure: Tensor,
    /// Mask of the pixels that count, [h, w], at least one; `None` if all do. The depths of the others are meaningless.
    pub counted: Option<Tensor>,
}

impl DepthMap {
    /// Returns a copy on `device`.
    pub fn to_device(&self, device: Device) -> Self {
        DepthMap {
            photo: self.photo.clone(),
            camera: self.camera,
            image: self.image.to_device(device),
            depth: self.depth.to_device(device),
            sure: self.sure.to_device(device),
            counted: self.counted.as_ref().map(|counted| counted.to_device(device)),
        }
    }
}
