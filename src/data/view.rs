//! A photo as a tensor, and its camera.

use super::pixels::Pixels;
use crate::error::Result;
use crate::io::rgb_from_tensor;
use crate::scene::{Camera, ImageSize};
use globalsplat_capture::{CHANNELS, Capture, Photo, Planes, resize_and_crop};
use rayon::prelude::*;
use tch::{Device, Kind, Tensor};

/// A photo and its camera.
#[derive(Debug)]
pub struct View {
    /// Name of the image in the capture.
    pub name: String,
    /// Colors, `[3, H, W]`.
    pub image: Pixels,
    /// Weight of each pixel, `[1, H, W]`: 1 where the pixel counts, 0 where it is masked out. `None` if every pixel counts.
    pub mask: Option<Pixels>,
    /// Camera at the size of `image`.
    pub camera: Camera,
}

impl From<Photo> for View {
    fn from(Photo { name, image, mask, camera }: Photo) -> Self {
        let (height, width) = image.size();
        let mask = mask.map(|mask| Tensor::from_slice(&mask).view([1, height as i64, width as i64]).into());
        View { name, image: byte_tensor(&image).into(), mask, camera }
    }
}

impl View {
    /// Returns a copy that shares the pixels.
    pub fn shallow_clone(&self) -> Self {
        let mask = self.mask.as_ref().map(Pixels::shallow_clone);
        View { name: self.name.clone(), image: self.image.shallow_clone(), mask, camera: self.camera }
    }

    /// Returns the mask, in which every pixel counts if the view has none.
    pub(crate) fn mask_or_ones(&self) -> Pixels {
        let ones = || {
            let size = self.image.size();
            Tensor::full([1, size[1], size[2]], 255, (Kind::Uint8, Device::Cpu)).into()
        };
        self.mask.as_ref().map_or_else(ones, Pixels::shallow_clone)
    }

    /// Returns the fraction of the pixels that count, the mean weight of the mask; `None` if every pixel counts.
    pub fn pixel_fraction(&self) -> Option<f64> {
        self.mask.as_ref().map(|mask| mask.to_float().mean(Kind::Double).double_value(&[]))
    }

    /// Returns `true` if no pixel counts.
    pub fn is_masked_out(&self) -> bool {
        self.pixel_fraction() == Some(0.)
    }

    /// Returns the view fitted to `size` as [`load_views`] does, without reading the photo again.
    ///
    /// # Errors
    /// Fails if libtorch rejects the image because of its shape.
    pub fn fitted(&self, size: ImageSize) -> Result<Self> {
        let (planes, camera) = resize_and_crop(&rgb_from_tensor(&self.image.to_float())?, &self.camera, size);
        let fit_mask = |mask: &Pixels| -> Result<Pixels> {
            let mask = rgb_from_tensor(&mask.to_float().expand([3, -1, -1], false))?;
            let (planes, _) = resize_and_crop(&mask, &self.camera, size);
            Ok(byte_tensor(&planes).narrow(0, 0, 1).copy().into())
        };
        let mask = self.mask.as_ref().map(fit_mask).transpose()?;
        Ok(View { name: self.name.clone(), image: byte_tensor(&planes).into(), mask, camera })
    }
}

/// Reads the views `indices` of `capture` like [`Capture::load`], fitted to `size`, or at their own size if it is `None`.
///
/// # Errors
/// Fails like [`Capture::load`].
pub fn load_views(capture: &Capture, indices: &[usize], size: Option<ImageSize>) -> Result<Vec<View>> {
    Ok(capture.load(indices, size)?.into_par_iter().map(View::from).collect())
}

/// Reads every view of `capture` like [`load_views`].
///
/// # Errors
/// Fails like [`Capture::load`].
pub fn load_all_views(capture: &Capture, size: Option<ImageSize>) -> Result<Vec<View>> {
    load_views(capture, &(0..capture.len()).collect::<Vec<_>>(), size)
}

/// Converts an image to a tensor of 8-bit levels, `[3, H, W]`.
fn byte_tensor(planes: &Planes) -> Tensor {
    let (height, width) = planes.size();
    Tensor::from_slice(planes.as_bytes()).view([CHANNELS as i64, height as i64, width as i64])
}

/// Converts an image to a float tensor, `[3, H, W]`, values in [0, 1].
pub fn tensor_from_planes(planes: &Planes) -> Tensor {
    Pixels::from(byte_tensor(planes)).to_float()
}
