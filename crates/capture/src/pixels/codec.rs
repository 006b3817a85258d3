//! Decoding and encoding of photos.

use super::jpeg::{END_MARKER, check_jpeg, jpeg_size};
use globalsplat_files::{Error, Result, panic_message};
use image::codecs::jpeg::JpegEncoder;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits, Rgb, RgbImage};
use std::any::Any;
use std::io::{BufReader, Cursor, Seek};
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;

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

/// Pixels of a decoded photo.
#[derive(Debug)]
pub struct DecodedPhoto {
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
pub fn decode_photo(encoded: &[u8], file: &Path, size: (u32, u32)) -> Result<DecodedPhoto> {
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
    Ok(DecodedPhoto { pixels: rgb_over_black(image), as_stored, is_jpeg: format == Some(ImageFormat::Jpeg) })
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
    encoded.map_err(Error::failed_by("an image can't be encoded"))?;
    Ok(bytes.into_inner())
}

/// Returns (width, height) like [`read_image_size`], for an image in memory, or `None` if it isn't an image.
pub fn encoded_image_size(encoded: &[u8]) -> Option<(u32, u32)> {
    let dimensions =
        || ImageReader::new(Cursor::new(encoded)).with_guessed_format().ok()?.into_dimensions().ok();
    jpeg_size(Cursor::new(encoded)).or_else(dimensions)
}

/// Returns (width, height) of the pixels as stored, from the image's header alone.
///
/// # Errors
/// Returns an error if the file is missing or isn't an image.
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
    // Unreadable EXIF data isn't an error, because the pixels may still be usable.
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
