//! Masks: which pixels of a photo count (spec 10.6). They are RGB images with equal channels, so that they go through the same steps
//! as their photos.

use super::codec::{decode_photo, multiply_levels};
use super::resample::Region;
use super::resize_and_crop::resample_planes;
use crate::geometry::ImageSize;
use globalsplat_files::{Error, Result};
use image::{GrayImage, Rgb, RgbImage};
use std::path::Path;

/// Reads the mask `file` at `size` = (width, height), like [`fit_mask`].
///
/// # Errors
/// Fails if the file can't be read or decoded.
pub(crate) fn read_mask(file: &Path, size: (u32, u32)) -> Result<RgbImage> {
    let encoded = std::fs::read(file).map_err(Error::read(file))?;
    Ok(fit_mask(decode_photo(&encoded, file, size)?.pixels, size))
}

/// Returns a decoded mask at `size` = (width, height), resized if it has another size. The level of its gray is the weight; a color counts
/// by its luminance, and what is transparent is black. A mask without a level above 1 has levels 0 and 1.
pub fn fit_mask(pixels: RgbImage, size: (u32, u32)) -> RgbImage {
    let mut mask = image::DynamicImage::from(pixels).into_luma8();
    if mask.pixels().all(|level| level[0] <= 1) {
        mask.pixels_mut().for_each(|level| level[0] *= u8::MAX);
    }
    let mask = gray_to_rgb(&mask);
    if mask.dimensions() == size {
        return mask;
    }
    let size = ImageSize { height: size.1, width: size.0 };
    resample_planes(&mask, Region::whole(&mask), size).to_rgb()
}

/// Returns the image whose channels all are `image`.
pub fn gray_to_rgb(image: &GrayImage) -> RgbImage {
    RgbImage::from_fn(image.width(), image.height(), |x, y| Rgb([image.get_pixel(x, y)[0]; 3]))
}

/// Adds the gray `level` to an image over black where `mask`, an image of the same size, leaves its pixels out.
pub(crate) fn add_background(image: &mut RgbImage, mask: &RgbImage, level: u8) {
    for (value, mask) in image.iter_mut().zip(mask.iter()) {
        *value = value.saturating_add(multiply_levels(u8::MAX - mask, level));
    }
}

/// Multiplies the levels of `mask` by those of `other`, an image of the same size.
pub(crate) fn multiply(mask: &mut RgbImage, other: &RgbImage) {
    for (level, other) in mask.iter_mut().zip(other.iter()) {
        *level = multiply_levels(*level, *other);
    }
}
