//! Depths of a photo that the plane sweep has found.

use crate::scene::Camera;
use tch::Tensor;
#[cfg(test)]
use {
    crate::scene::Intrinsics,
    glam::DMat4,
    tch::{Device, Kind},
};

/// Downscaled photo with a depth for every pixel, on the CPU.
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
    /// Returns the depth of every pixel, row by row.
    pub fn depths(&self) -> Vec<f32> {
        numbers(&self.depth)
    }

    /// Returns the photo's values, channel by channel.
    pub fn colors(&self) -> Vec<f32> {
        numbers(&self.image)
    }

    /// Returns for every pixel whether the photos agree on its depth.
    pub fn sure_pixels(&self) -> Vec<bool> {
        truths(&self.sure)
    }

    /// Returns for every pixel whether it counts; `None` if all do.
    pub fn counted_pixels(&self) -> Option<Vec<bool>> {
        self.counted.as_ref().map(truths)
    }

    /// Returns a map of one depth in black, all of it sure and counted, of a camera at the origin.
    #[cfg(test)]
    pub fn flat(width: u32, height: u32, depth: f64) -> Self {
        let (k, size) = (f64::from(width) / 2., [i64::from(height), i64::from(width)]);
        let options = (Kind::Float, Device::Cpu);
        DepthMap {
            photo: String::new(),
            camera: Camera {
                intrinsics: Intrinsics { fx: k, fy: k, cx: k, cy: f64::from(height) / 2. },
                c2w: DMat4::IDENTITY,
                width,
                height,
            },
            image: Tensor::zeros([3, size[0], size[1]], options),
            depth: Tensor::full(size, depth, options),
            sure: Tensor::ones(size, (Kind::Bool, Device::Cpu)),
            counted: None,
        }
    }
}

/// Returns the values of a float32 tensor.
pub(crate) fn numbers(t: &Tensor) -> Vec<f32> {
    Vec::try_from(t.contiguous().view([-1])).expect("numbers")
}

/// Returns the values of a Boolean tensor.
pub(crate) fn truths(t: &Tensor) -> Vec<bool> {
    Vec::try_from(t.contiguous().view([-1])).expect("truths")
}
