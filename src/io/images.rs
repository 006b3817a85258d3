//! Conversion of images between tensors and files, and images for display.

use super::{check_writable_file, encode_photo, write_file};
use crate::error::{Error, Result};
use crate::scene::ImageSize;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{Rgb, RgbImage};
use std::path::Path;
use tch::{Kind, Tensor};

/// Converts an image to a tensor [3, H, W] in [0, 1].
pub fn tensor_from_rgb(image: &RgbImage) -> Tensor {
    let (width, height) = (i64::from(image.width()), i64::from(image.height()));
    Tensor::from_slice(image.as_raw()).view([height, width, 3]).permute([2, 0, 1]).to_kind(Kind::Float) / 255.
}

/// Converts a tensor [3, H, W] or [H, W] (gray) to an image; values are clamped to [0, 1] and rounded.
///
/// # Errors
/// Returns libtorch's error, for example for another shape.
pub fn rgb_from_tensor(image: &Tensor) -> Result<RgbImage> {
    let planes = if image.dim() == 2 {
        image.unsqueeze(0).f_expand([3, -1, -1], false).map_err(Error::external)?
    } else {
        image.shallow_clone()
    };
    let (height, width) = (planes.size()[1], planes.size()[2]);
    let bytes =
        (planes.detach().clamp(0., 1.) * 255.).round().to_kind(Kind::Uint8).permute([1, 2, 0]).contiguous();
    let bytes = Vec::<u8>::try_from(bytes.flatten(0, -1)).map_err(Error::external)?;
    RgbImage::from_raw(width as u32, height as u32, bytes)
        .ok_or_else(|| Error::failed("the number of pixels doesn't match the image size"))
}

/// Returns the URL that has a tensor [3, H, W] or [H, W] (gray) with values in [0, 1] in itself, as a JPEG.
///
/// # Errors
/// Returns an error for another shape, or a size that JPEG doesn't support.
pub fn jpeg_data_url(image: &Tensor) -> Result<String> {
    let jpeg = encode_photo(&rgb_from_tensor(image)?, true)?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

/// Returns `true` if `path` has the extension of a PNG.
pub fn is_png_name(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"))
}

/// Checks that a PNG could be written at `path`, like [`check_writable_file`].
///
/// # Errors
/// Returns an error for another extension, and the errors of [`check_writable_file`].
pub fn check_writable_png(path: &Path) -> Result<()> {
    if !is_png_name(path) {
        return Err(Error::input(path, "the image's file extension", "another", ".png"));
    }
    check_writable_file(path)
}

/// Writes a tensor [3, H, W] or [H, W] (gray) with values in [0, 1] as a PNG.
///
/// # Errors
/// Returns an error if the file can't be written.
pub fn write_png(path: &Path, image: &Tensor) -> Result<()> {
    write_image(path, &rgb_from_tensor(image)?, false)
}

/// Writes a tensor like [`write_png`], but as a JPEG, which is smaller and lossy.
pub(crate) fn write_jpeg(path: &Path, image: &Tensor) -> Result<()> {
    write_image(path, &rgb_from_tensor(image)?, true)
}

/// Writes an image as a JPEG, or as a PNG.
fn write_image(path: &Path, image: &RgbImage, as_jpeg: bool) -> Result<()> {
    let bytes = encode_photo(image, as_jpeg)?;
    write_file(path, bytes)
}

/// Enlarges `image` [3, H, W] by an integer factor, repeating its pixels, until it is `height` high or a little less.
pub fn enlarge(image: &Tensor, height: i64) -> Tensor {
    let factor = (height / image.size()[1]).max(1);
    image.repeat_interleave_self_int(factor, 1, None).repeat_interleave_self_int(factor, 2, None)
}

/// Shrinks `image` [3, H, W] by an integer factor: every pixel is the mean of `factor`² pixels.
pub fn shrink(image: &Tensor, factor: i64) -> Tensor {
    match factor {
        1 => image.shallow_clone(),
        _ => image.avg_pool2d(factor, factor, 0, false, true, None),
    }
}

/// Returns every `factor`-th row and column of values [H, W] that can't be averaged, in the size that [`shrink`] returns.
pub fn subsample(numbers: &Tensor, factor: i64) -> Tensor {
    let along = |t: Tensor, dim: i64| {
        let whole = t.size()[dim as usize] / factor * factor;
        t.narrow(dim, 0, whole).slice(dim, factor / 2, None, factor)
    };
    along(along(numbers.shallow_clone(), 0), 1)
}

/// Number of pixels between images.
const GAP: i64 = 4;

/// Tiles images [3, H, W] side by side, with a white gap, and white below those that are lower than others.
pub fn tile_horizontally(images: &[Tensor]) -> Tensor {
    let height = images.iter().map(|image| image.size()[1]).max().unwrap_or(0);
    let pad = |(index, image): (usize, &Tensor)| {
        let gap = if index > 0 { GAP } else { 0 };
        image.pad([gap, 0, 0, height - image.size()[1]], "constant", 1.)
    };
    Tensor::cat(&images.iter().enumerate().map(pad).collect::<Vec<_>>(), 2)
}

/// Tiles images one below the other, or else side by side, with white between and beside them.
fn tile_images(images: &[RgbImage], is_column: bool) -> RgbImage {
    let gap = GAP as u32;
    let largest = |side: fn(&RgbImage) -> u32| images.iter().map(side).max().unwrap_or(0);
    let sum = |side: fn(&RgbImage) -> u32| {
        (images.iter().map(side).sum::<u32>() + gap * images.len() as u32).saturating_sub(gap)
    };
    let (width, height) = match is_column {
        true => (largest(RgbImage::width), sum(RgbImage::height)),
        false => (sum(RgbImage::width), largest(RgbImage::height)),
    };
    let mut whole = RgbImage::from_pixel(width, height, Rgb([u8::MAX; 3]));
    let mut at = 0;
    for image in images {
        let (x, y, side) = if is_column { (0, at, image.height()) } else { (at, 0, image.width()) };
        image::imageops::replace(&mut whole, image, x.into(), y.into());
        at += side + gap;
    }
    whole
}

/// Returns the size of `count` images of `size` that [`tile_horizontally`] has put side by side.
pub fn tiled_size(size: ImageSize, count: u32) -> ImageSize {
    ImageSize { width: count * size.width + (count - 1) * GAP as u32, ..size }
}

/// Maximum number of pixels of a mosaic, chosen so that common programs can open it and people can view it.
const MAX_PIXELS: i64 = 1 << 26;

/// Images that are tiled into one, stored as 8 bits until then. If they have more pixels together than programs open, each is shrunk by an
/// integer factor.
#[derive(Debug)]
pub struct Mosaic {
    is_column: bool,
    /// Maximum number of pixels of each image.
    most_pixels: i64,
    images: Vec<RgbImage>,
    shrunk_by: i64,
}

impl Mosaic {
    /// Creates a mosaic for a row of `count` images.
    pub fn row(count: usize) -> Self {
        let most_pixels = MAX_PIXELS / count.max(1) as i64;
        Mosaic { is_column: false, most_pixels, images: vec![], shrunk_by: 1 }
    }

    /// Creates a mosaic for a column of `count` images.
    pub fn column(count: usize) -> Self {
        Mosaic { is_column: true, ..Mosaic::row(count) }
    }

    /// Adds an image that consists of `parts` side by side, each [3, H, W] in [0, 1] and all of the same size.
    ///
    /// # Errors
    /// Returns libtorch's error, for example for another shape.
    pub fn add(&mut self, parts: &[Tensor]) -> Result<()> {
        let factor = self.factor(parts.len(), &parts[0]);
        let parts: Vec<Tensor> = parts.iter().map(|part| shrink(part, factor)).collect();
        self.add_shrunk(&parts)
    }

    /// Returns the factor by which to divide the sides of an image that consists of `parts` tensors, each of the size of `part` [.., H, W].
    pub fn factor(&mut self, parts: usize, part: &Tensor) -> i64 {
        let [.., height, width] = part.size()[..] else { panic!("an image has height and width") };
        let factor = shrink_factor(parts as i64 * height * width, self.most_pixels);
        self.shrunk_by = self.shrunk_by.max(factor);
        factor
    }

    /// Adds an image like [`Mosaic::add`], from parts that [`Mosaic::factor`] has already shrunk.
    ///
    /// # Errors
    /// Returns libtorch's error, for example for another shape.
    pub fn add_shrunk(&mut self, parts: &[Tensor]) -> Result<()> {
        self.images.push(rgb_from_tensor(&tile_horizontally(parts))?);
        Ok(())
    }

    /// Returns the largest factor by which the sides of an image were divided: 1 if nothing was shrunk.
    pub fn shrunk_by(&self) -> i64 {
        self.shrunk_by
    }

    /// Writes the mosaic as a PNG.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn write(self, path: &Path) -> Result<()> {
        write_image(path, &tile_images(&self.images, self.is_column), false)
    }
}

/// Returns the smallest integer by which both sides must be divided so that at most `most` of `pixels` remain.
pub fn shrink_factor(pixels: i64, most: i64) -> i64 {
    (1..).find(|factor| pixels <= most.max(1) * factor * factor).expect("a whole number")
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;

    #[test]
    fn pictures_of_different_sizes_are_tiled_with_white() {
        let image = |height, width| Tensor::zeros([3, height, width], (Kind::Float, Device::Cpu));
        let row = tile_horizontally(&[image(2, 3), image(5, 1)]);
        assert_eq!(row.size(), [3, 5, 3 + GAP + 1]);
        let of_three = tile_horizontally(&[image(2, 3), image(2, 3), image(2, 3)]);
        let ImageSize { height, width } = tiled_size(ImageSize { height: 2, width: 3 }, 3);
        assert_eq!(of_three.size(), [3, height.into(), width.into()]);
        let black = |t: &Tensor| t.eq(0.).sum(Kind::Int64).int64_value(&[]);
        assert_eq!(black(&row), 3 * (2 * 3 + 5));
        assert_eq!(black(&row.narrow(1, 0, 2).narrow(2, 0, 3)), 3 * 2 * 3);
    }

    #[test]
    fn many_large_pictures_are_shrunk_and_few_are_not() {
        let image = Tensor::ones([3, 64, 96], (Kind::Float, Device::Cpu)) * 0.5;
        for (count, most, size, by) in [(2, 1 << 26, [64, 196], 1), (2, 2 * 64 * 96 / 4, [32, 100], 2)] {
            let mut mosaic = Mosaic { most_pixels: most / count, ..Mosaic::row(2) };
            for _ in 0..count {
                mosaic.add(std::slice::from_ref(&image)).unwrap();
            }
            assert_eq!(mosaic.shrunk_by(), by);
            let file = tempfile::NamedTempFile::with_suffix(".png").unwrap();
            mosaic.write(file.path()).unwrap();
            let image = crate::io::read_image(file.path()).unwrap();
            assert_eq!([image.height(), image.width()], size);
            assert_eq!((image.get_pixel(0, 0).0, image.get_pixel(size[1] - 1, 0).0), ([128; 3], [128; 3]));
        }
        assert_eq!(shrink_factor(16_000_000 * 3, MAX_PIXELS / 300), 15);
    }
}
