//! Decoding and encoding of photos.

use super::heif::{HEADER_BYTES, decode_heif, heif_size};
use super::jpeg::{decode_jpeg, jpeg_size};
use super::metadata::{exif_chunk, upright_exif};
use globalsplat_files::{Error, Result, panic_message};
use image::codecs::jpeg::JpegEncoder;
use image::metadata::Orientation;
use image::{
    ColorType, DynamicImage, GrayImage, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits, Luma,
    Rgb, RgbImage,
};
use std::any::Any;
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Read, Seek};
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;

/// File extensions of photos, in lower case.
pub const PHOTO_EXTENSIONS: [&str; 10] =
    ["png", "jpg", "jpeg", "webp", "tif", "tiff", "bmp", "heic", "heif", "avif"];

/// Description of the supported formats for error messages.
pub(crate) const SUPPORTED_IMAGES: &str = "a JPEG, PNG, WebP, TIFF, BMP, HEIC or AVIF";

/// Reads any image as 8-bit RGB, with pixels as they are stored, but HEIC and AVIF upright: gray is repeated, transparent pixels are
/// composited over black, 16 bits are rounded to 8. HEIC and AVIF are decoded by libheif's program on the PATH.
///
/// # Errors
/// Returns an error if the file is missing, can't be decoded, or is truncated.
pub fn read_image(path: &Path) -> Result<RgbImage> {
    Ok(decode(&std::fs::read(path).map_err(Error::read(path))?, path, |_, _| false)?.pixels)
}

/// Largest number of pixels of a photo: more than the sensor of any phone or camera has.
const MAX_PIXELS: u64 = 256_000_000;
/// Bytes of a pixel: four colors of 16 bits.
const MAX_PIXEL_BYTES: u64 = 8;

/// Pixels of a decoded photo.
#[derive(Debug)]
pub struct DecodedPhoto {
    /// Pixels in 8-bit RGB.
    pub pixels: RgbImage,
    /// Opacity of each pixel, 255 where it is opaque; `None` if every pixel is.
    pub alpha: Option<GrayImage>,
    /// `true` if the file holds exactly these pixels in 8-bit RGB: no palette, gray, CMYK or opacity, not rotated and not converted.
    pub is_verbatim: bool,
    /// `true` if the orientation in the file's EXIF data was applied to the pixels as they are stored.
    pub is_turned: bool,
    /// `true` if the file is a JPEG.
    pub is_jpeg: bool,
    /// `true` if the file is a PNG.
    pub is_png: bool,
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
    decode(encoded, file, |stored, turned| stored != size && turned == size)
}

/// Decodes the photo `encoded`, the contents of `file`, like [`read_image`], but upright: the EXIF orientation is applied.
///
/// # Errors
/// Returns the errors of [`read_image`].
pub fn decode_upright(encoded: &[u8], file: &Path) -> Result<DecodedPhoto> {
    decode(encoded, file, |_, _| true)
}

/// Decodes a photo. `should_turn` returns `true` if the EXIF orientation is to be applied, given the photo's size as stored and its upright
/// size.
fn decode(
    encoded: &[u8],
    file: &Path,
    should_turn: impl FnOnce((u32, u32), (u32, u32)) -> bool,
) -> Result<DecodedPhoto> {
    if heif_size(encoded).is_some() {
        return Ok(DecodedPhoto {
            pixels: decode_heif(encoded, file)?,
            alpha: None,
            is_verbatim: false,
            is_turned: false,
            is_jpeg: false,
            is_png: false,
        });
    }
    let reader = ImageReader::new(Cursor::new(encoded)).with_guessed_format().map_err(Error::read(file))?;
    let format = reader.format();
    let mut decoder = reader.into_decoder().map_err(undecodable(file))?;
    // A file of a few bytes can claim any size.
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let found = format!("{width}×{height} pixels, more than {} megapixels", MAX_PIXELS / 1_000_000);
        return Err(Error::input(file, "the image", found, "a smaller one"));
    }
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(MAX_PIXELS * MAX_PIXEL_BYTES);
    if matches!(decoder.color_type(), ColorType::Rgb32F | ColorType::Rgba32F) {
        // The range of floating-point pixels isn't standardized.
        let found = "with floating-point pixels";
        return Err(Error::input(file, "the image", found, "8 or 16 bits for each of its colors"));
    }
    decoder.set_limits(limits).map_err(undecodable(file))?;
    // Unreadable EXIF data isn't an error, because the pixels may still be usable.
    let orientation = exif_chunk(&mut decoder).and_then(|exif| Orientation::from_exif_chunk(&exif));
    let orientation = orientation.or(decoder.orientation().ok()).unwrap_or(Orientation::NoTransforms);
    let (is_jpeg, is_png) = (format == Some(ImageFormat::Jpeg), format == Some(ImageFormat::Png));
    // The decoders of some rare formats panic.
    let image = panic::catch_unwind(AssertUnwindSafe(|| match is_jpeg {
        true => decode_jpeg(encoded).map_err(undecodable(file)),
        false => {
            let has_rgb = is_png && encoded.get(PNG_COLOR_TYPE) == Some(&PNG_RGB);
            DynamicImage::from_decoder(decoder).map(|image| (image, has_rgb)).map_err(undecodable(file))
        }
    }));
    let panicked =
        |why: Box<dyn Any + Send>| undecodable(file)(format!("the decoder failed: {}", panic_message(&*why)));
    let (mut image, has_rgb) = image.map_err(panicked)??;
    let stored = (image.width(), image.height());
    let turned = match orientation {
        Orientation::Rotate90
        | Orientation::Rotate270
        | Orientation::Rotate90FlipH
        | Orientation::Rotate270FlipH => (stored.1, stored.0),
        _ => stored,
    };
    let is_turned = orientation != Orientation::NoTransforms && should_turn(stored, turned);
    if is_turned {
        image.apply_orientation(orientation);
    }
    let is_verbatim = !is_turned && has_rgb && matches!(image, DynamicImage::ImageRgb8(_));
    let (pixels, alpha) = split_alpha(image);
    Ok(DecodedPhoto { pixels, alpha, is_verbatim, is_turned, is_jpeg, is_png })
}

/// Encodes a photo as a JPEG of high quality, or as a PNG.
///
/// # Errors
/// Returns an error if the format doesn't support the size.
pub fn encode_photo(pixels: &RgbImage, as_jpeg: bool) -> Result<Vec<u8>> {
    if as_jpeg {
        return encode_jpeg(pixels, None);
    }
    let mut bytes = Cursor::new(vec![]);
    pixels.write_to(&mut bytes, ImageFormat::Png).map_err(not_encoded())?;
    Ok(bytes.into_inner())
}

/// Encodes the upright photo `pixels` as a JPEG of high quality, with the EXIF data in `original`, the contents of the file that they are
/// of, but for the orientation.
///
/// # Errors
/// Returns an error if the format doesn't support the size.
pub fn encode_upright(pixels: &RgbImage, original: &[u8]) -> Result<Vec<u8>> {
    encode_jpeg(pixels, upright_exif(original))
}

fn encode_jpeg(pixels: &RgbImage, exif: Option<Vec<u8>>) -> Result<Vec<u8>> {
    const QUALITY: u8 = 95;
    let mut bytes = vec![];
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, QUALITY);
    // A segment of a JPEG has no more.
    if let Some(exif) = exif.filter(|exif| exif.len() < 65_000) {
        encoder.set_exif_metadata(exif).map_err(not_encoded())?;
    }
    pixels.write_with_encoder(encoder).map_err(not_encoded())?;
    Ok(bytes)
}

fn not_encoded<E: std::error::Error + Send + Sync + 'static>() -> impl FnOnce(E) -> Error {
    Error::failed_with_context("an image can't be encoded")
}

/// Returns (width, height) like [`read_image_size`], for an image in memory, or `None` if it isn't an image.
pub(crate) fn encoded_image_size(encoded: &[u8]) -> Option<(u32, u32)> {
    read_header(Cursor::new(encoded), Path::new("")).ok().map(|(size, _)| size)
}

/// Returns (width, height) of the image that [`read_image`] returns, from its header alone.
///
/// # Errors
/// Returns an error if the file is missing or isn't an image.
pub fn read_image_size(path: &Path) -> Result<(u32, u32)> {
    Ok(read_header(BufReader::new(File::open(path).map_err(Error::read(path))?), path)?.0)
}

/// Returns `true` if the image's header declares an alpha channel or a transparent color. HEIC and AVIF are decoded without their alpha
/// channel, so they have none here.
///
/// # Errors
/// Returns an error if the file is missing or is no image.
pub(crate) fn has_alpha_channel(path: &Path) -> Result<bool> {
    Ok(read_header(BufReader::new(File::open(path).map_err(Error::read(path))?), path)?.1)
}

/// Returns (width, height) and whether there is an alpha channel, from the header of the image `path`.
fn read_header(mut reader: impl BufRead + Seek, path: &Path) -> Result<((u32, u32), bool)> {
    // image's JPEG decoder would read the whole file.
    if let Some(size) = jpeg_size(&mut reader) {
        return Ok((size, false));
    }
    reader.rewind().map_err(Error::read(path))?;
    let mut start = vec![];
    reader.by_ref().take(HEADER_BYTES).read_to_end(&mut start).map_err(Error::read(path))?;
    if let Some(size) = heif_size(&start) {
        return Ok((size, false));
    }
    reader.rewind().map_err(Error::read(path))?;
    let reader = ImageReader::new(reader).with_guessed_format().map_err(Error::read(path))?;
    let decoder = reader.into_decoder().map_err(undecodable(path))?;
    Ok((decoder.dimensions(), decoder.color_type().has_alpha()))
}

/// Offset of the color type in the header of a PNG.
const PNG_COLOR_TYPE: usize = 25;
/// Color type of red, green and blue, without a palette.
const PNG_RGB: u8 = 2;

fn undecodable<E: std::fmt::Display>(path: &Path) -> impl FnOnce(E) -> Error {
    move |e| Error::input(path, "the image", format!("undecodable ({e})"), SUPPORTED_IMAGES)
}

/// Returns the pixels, composited over black, and their opacity unless all of them are opaque.
fn split_alpha(image: DynamicImage) -> (RgbImage, Option<GrayImage>) {
    if !image.color().has_alpha() {
        return (image.into_rgb8(), None);
    }
    let image = image.into_rgba8();
    let (width, height) = image.dimensions();
    let pixels = RgbImage::from_fn(width, height, |x, y| {
        let [red, green, blue, alpha] = image.get_pixel(x, y).0;
        Rgb([red, green, blue].map(|value| multiply_levels(value, alpha)))
    });
    let is_opaque = image.pixels().all(|pixel| pixel[3] == u8::MAX);
    let alpha = || GrayImage::from_fn(width, height, |x, y| Luma([image.get_pixel(x, y)[3]]));
    (pixels, (!is_opaque).then(alpha))
}

/// Returns the product of two levels, 255 of which stand for 1, rounded to the nearest level.
pub(super) fn multiply_levels(a: u8, b: u8) -> u8 {
    ((u32::from(a) * u32::from(b) + 127) / 255) as u8
}
