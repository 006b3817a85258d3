//! Conversion of images between files and tensors, and images for display.

use super::jpeg::{END_MARKER, check_jpeg, jpeg_size};
use super::{check_writable_file, write_atomically};
use crate::error::{Error, Result, panic_message};
use crate::scene::ImageSize;
use image::codecs::jpeg::JpegEncoder;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits, Rgb, RgbImage};
use std::any::Any;
use std::io::{BufReader, Cursor, Seek};
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;
use tch::{Kind, Tensor};

/// File extensions of photos.
pub const PHOTO_EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Reads any image as 8-bit RGB, with pixels as they are stored: grey is repeated, transparent pixels are composited over black, 16 bits
/// are rounded to 8.
///
/// # Errors
/// Returns an error if the file is missing, can't be decoded, or is truncated.
pub fn read_image(path: &Path) -> Result<RgbImage> {
    let bytes = std::fs::read(path).map_err(Error::read(path))?;
    Ok(rgb_over_black(decode(&bytes, path)?.image))
}

/// Pixels of a photo.
#[derive(Debug)]
pub struct Photo {
    /// Pixels in 8-bit RGB.
    pub pixels: RgbImage,
    /// `true` if the file holds exactly these pixels in 8-bit RGB: no palette, grey, CMYK or opacity, not rotated and not converted.
    pub as_stored: bool,
    /// `true` if the file is a JPEG.
    pub is_jpeg: bool,
}

/// Decodes the photo `encoded`, the contents of `file`, like [`read_image`]. The capture declares the photo to have `size` = (width,
/// height).
///
/// Cameras turned on their side store the pixels as the sensor has them, and the orientation in EXIF. Most tools that create captures,
/// COLMAP among them, ignore it, so their intrinsics refer to the pixels as stored; others rotate the photo first. The declared size
/// distinguishes the two: the orientation is applied only if the stored size isn't the declared one and the rotated size is. A photo that
/// matches neither way is returned as stored, so the caller must compare its size.
///
/// # Errors
/// Returns the errors of [`read_image`].
pub fn decode_photo(encoded: &[u8], file: &Path, size: (u32, u32)) -> Result<Photo> {
    let Decoded { mut image, orientation, format, is_rgb } = decode(encoded, file)?;
    let stored = (image.width(), image.height());
    let turned = match orientation {
        Orientation::Rotate90
        | Orientation::Rotate270
        | Orientation::Rotate90FlipH
        | Orientation::Rotate270FlipH => (stored.1, stored.0),
        _ => stored,
    };
    let turn = stored != size && turned == size;
    if turn {
        image.apply_orientation(orientation);
    }
    let as_stored = !turn && is_rgb && matches!(image, DynamicImage::ImageRgb8(_));
    Ok(Photo { pixels: rgb_over_black(image), as_stored, is_jpeg: format == Some(ImageFormat::Jpeg) })
}

/// Encodes a photo as a JPEG of high quality, or as a PNG.
///
/// # Errors
/// Returns an error if the format doesn't support the size.
pub fn encode_photo(pixels: &RgbImage, as_jpeg: bool) -> Result<Vec<u8>> {
    const QUALITY: u8 = 95;
    let mut bytes = Cursor::new(vec![]);
    let encoded = match as_jpeg {
        true => pixels.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, QUALITY)),
        false => pixels.write_to(&mut bytes, ImageFormat::Png),
    };
    encoded.map_err(|e| Error::failed(format!("an image can't be encoded: {e}")))?;
    Ok(bytes.into_inner())
}

/// Returns (width, height) like [`read_image_size`], for an image in memory, or `None` if it is no image.
pub fn encoded_image_size(encoded: &[u8]) -> Option<(u32, u32)> {
    let dimensions =
        || ImageReader::new(Cursor::new(encoded)).with_guessed_format().ok()?.into_dimensions().ok();
    jpeg_size(Cursor::new(encoded)).or_else(dimensions)
}

/// Returns (width, height) of the pixels as stored, from the image's header alone.
///
/// # Errors
/// Returns an error if the file is missing or is no image.
pub fn read_image_size(path: &Path) -> Result<(u32, u32)> {
    let file = std::fs::File::open(path).map_err(Error::read(path))?;
    let mut reader = BufReader::new(file);
    // The decoder would read the whole file.
    if let Some(size) = jpeg_size(&mut reader) {
        return Ok(size);
    }
    reader.rewind().map_err(Error::read(path))?;
    let reader = ImageReader::new(reader).with_guessed_format().map_err(Error::read(path))?;
    reader.into_dimensions().map_err(undecodable(path))
}

struct Decoded {
    image: DynamicImage,
    orientation: Orientation,
    format: Option<ImageFormat>,
    /// `true` if the file holds three channels, whatever they were decoded to, and has an end marker.
    is_rgb: bool,
}

/// Offset of the colour type in the header of a PNG.
const PNG_COLOUR_TYPE: usize = 25;
/// Colour type of red, green and blue, without a palette.
const PNG_RGB: u8 = 2;

fn decode(encoded: &[u8], file: &Path) -> Result<Decoded> {
    let reader = ImageReader::new(Cursor::new(encoded)).with_guessed_format().map_err(Error::read(file))?;
    let format = reader.format();
    let mut decoder = reader.into_decoder().map_err(undecodable(file))?;
    // A file of a few bytes can claim any size.
    let limits = Limits::default();
    limits.check_dimensions(decoder.dimensions().0, decoder.dimensions().1).map_err(undecodable(file))?;
    if decoder.total_bytes() > limits.max_alloc.unwrap_or(u64::MAX) {
        let (width, height) = decoder.dimensions();
        return Err(Error::input(file, "the image", format!("{width}×{height} pixels"), "a photo's size"));
    }
    decoder.set_limits(limits).map_err(undecodable(file))?;
    let is_rgb = match format {
        Some(ImageFormat::Jpeg) => {
            let damaged =
                |why| Error::input(file, "the image", format!("undecodable ({why})"), "a PNG or JPEG");
            let checked = check_jpeg(encoded).map_err(damaged)?;
            if !checked.is_marked {
                // Without the marker the decoder leaves the last rows grey, though none of their data is missing.
                let decoded = decode(&[encoded, &END_MARKER].concat(), file)?;
                return Ok(Decoded { is_rgb: false, ..decoded });
            }
            checked.components == Some(3)
        }
        Some(ImageFormat::Png) => encoded.get(PNG_COLOUR_TYPE) == Some(&PNG_RGB),
        _ => false,
    };
    // Unreadable EXIF is no reason to refuse the pixels.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    // The decoders of some rare formats panic.
    let image = panic::catch_unwind(AssertUnwindSafe(|| DynamicImage::from_decoder(decoder)));
    let panicked = |why: Box<dyn Any + Send>| {
        let found = format!("undecodable (the decoder failed: {})", panic_message(&*why));
        Error::input(file, "the image", found, "a PNG or JPEG")
    };
    let image = image.map_err(panicked)?.map_err(undecodable(file))?;
    Ok(Decoded { image, orientation, format, is_rgb })
}

fn undecodable(path: &Path) -> impl FnOnce(ImageError) -> Error {
    move |e| Error::input(path, "the image", format!("undecodable ({e})"), "a PNG or JPEG")
}

fn rgb_over_black(image: DynamicImage) -> RgbImage {
    if !image.color().has_alpha() {
        return image.into_rgb8();
    }
    let image = image.to_rgba8();
    RgbImage::from_fn(image.width(), image.height(), |x, y| {
        let [red, green, blue, alpha] = image.get_pixel(x, y).0;
        let covered = |value: u8| ((u32::from(value) * u32::from(alpha) + 127) / 255) as u8;
        Rgb([red, green, blue].map(covered))
    })
}

/// Converts an image to a tensor [3, H, W] in [0, 1].
pub fn tensor_from_rgb(image: &RgbImage) -> Tensor {
    let (width, height) = (i64::from(image.width()), i64::from(image.height()));
    Tensor::from_slice(image.as_raw()).view([height, width, 3]).permute([2, 0, 1]).to_kind(Kind::Float) / 255.
}

/// Converts a tensor [3, H, W] or [H, W] (grey) to an image; values are clamped to [0, 1] and rounded.
///
/// # Errors
/// Returns libtorch's error, for example for another shape.
pub fn rgb_from_tensor(picture: &Tensor) -> Result<RgbImage> {
    let planes = if picture.dim() == 2 {
        picture.unsqueeze(0).f_expand([3, -1, -1], false)?
    } else {
        picture.shallow_clone()
    };
    let (height, width) = (planes.size()[1], planes.size()[2]);
    let bytes =
        (planes.detach().clamp(0., 1.) * 255.).round().to_kind(Kind::Uint8).permute([1, 2, 0]).contiguous();
    let bytes = Vec::<u8>::try_from(bytes.flatten(0, -1))?;
    RgbImage::from_raw(width as u32, height as u32, bytes)
        .ok_or_else(|| Error::failed("a picture has another size than its pixels"))
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
        return Err(Error::input(path, "the picture's ending", "another", ".png"));
    }
    Ok(check_writable_file(path)?)
}

/// Writes a tensor [3, H, W] or [H, W] (grey) with values in [0, 1] as a PNG.
///
/// # Errors
/// Returns an error if the file can't be written.
pub fn write_png(path: &Path, picture: &Tensor) -> Result<()> {
    write_picture(path, picture, false)
}

/// Writes a tensor like [`write_png`], but as a JPEG, which is smaller and lossy.
///
/// # Errors
/// Returns the errors of [`write_png`].
pub fn write_jpeg(path: &Path, picture: &Tensor) -> Result<()> {
    write_picture(path, picture, true)
}

fn write_picture(path: &Path, picture: &Tensor, as_jpeg: bool) -> Result<()> {
    write_image(path, &rgb_from_tensor(picture)?, as_jpeg)
}

/// Writes an image as a JPEG, or as a PNG.
///
/// # Errors
/// Returns an error if the format doesn't support the size, or if the file can't be written.
pub(super) fn write_image(path: &Path, image: &RgbImage, as_jpeg: bool) -> Result<()> {
    let bytes = encode_photo(image, as_jpeg)?;
    write_atomically(path, |writer| writer.write_all(&bytes).map_err(Error::write(path)))
}

/// Enlarges `picture` [3, H, W] by an integer factor, repeating its pixels, until it is `height` high or a little less.
pub fn enlarge(picture: &Tensor, height: i64) -> Tensor {
    let factor = (height / picture.size()[1]).max(1);
    picture.repeat_interleave_self_int(factor, 1, None).repeat_interleave_self_int(factor, 2, None)
}

/// Shrinks `picture` [3, H, W] by an integer factor: every pixel is the mean of `factor`² pixels.
pub fn shrink(picture: &Tensor, factor: i64) -> Tensor {
    match factor {
        1 => picture.shallow_clone(),
        _ => picture.avg_pool2d(factor, factor, 0, false, true, None),
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
pub fn tile_horizontally(pictures: &[Tensor]) -> Tensor {
    tile(pictures, 2)
}

/// Tiles images [3, H, W] one below the other, with a white gap, and white beside those that are narrower than others.
pub fn tile_vertically(pictures: &[Tensor]) -> Tensor {
    tile(pictures, 1)
}

/// Tiles images one below the other, or else side by side, like [`tile_vertically`] and [`tile_horizontally`].
pub(super) fn tile_images(images: &[RgbImage], is_column: bool) -> RgbImage {
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

fn tile(pictures: &[Tensor], dim: i64) -> Tensor {
    let mut parts = vec![];
    for (i, picture) in padded(pictures, 3 - dim).into_iter().enumerate() {
        if i > 0 {
            let mut gap = picture.size();
            gap[dim as usize] = GAP;
            parts.push(Tensor::ones(gap, (picture.kind(), picture.device())));
        }
        parts.push(picture);
    }
    Tensor::cat(&parts, dim)
}

/// Pads images [3, H, W] with white below or to the right, to the size of the largest of them along `dim`.
fn padded(pictures: &[Tensor], dim: i64) -> Vec<Tensor> {
    let largest = pictures.iter().map(|picture| picture.size()[dim as usize]).max().unwrap_or(0);
    let pad = |picture: &Tensor| {
        let missing = largest - picture.size()[dim as usize];
        let sides = if dim == 1 { [0, 0, 0, missing] } else { [0, missing, 0, 0] };
        picture.pad(sides, "constant", 1.)
    };
    pictures.iter().map(pad).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;

    #[test]
    fn pictures_of_different_sizes_are_tiled_with_white() {
        let picture = |height, width| Tensor::zeros([3, height, width], (Kind::Float, Device::Cpu));
        let row = tile_horizontally(&[picture(2, 3), picture(5, 1)]);
        assert_eq!(row.size(), [3, 5, 3 + GAP + 1]);
        let of_three = tile_horizontally(&[picture(2, 3), picture(2, 3), picture(2, 3)]);
        let ImageSize { height, width } = tiled_size(ImageSize { height: 2, width: 3 }, 3);
        assert_eq!(of_three.size(), [3, height.into(), width.into()]);
        let black = |t: &Tensor| t.eq(0.).sum(Kind::Int64).int64_value(&[]);
        assert_eq!(black(&row), 3 * (2 * 3 + 5));
        assert_eq!(black(&row.narrow(1, 0, 2).narrow(2, 0, 3)), 3 * 2 * 3);
        assert_eq!(tile_vertically(&[picture(2, 3), picture(5, 1)]).size(), [3, 2 + GAP + 5, 3]);
    }
}
