//! Strict decoding of JPEGs (ITU-T T.81). Lenient decoders don't report missing data: they fill it with gray.

use image::{DynamicImage, GrayImage, RgbImage};
use std::io::{BufRead, Seek};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Marker of the end of an image.
const EOI: u8 = 0xd9;

/// Returns (width, height) from a JPEG's headers, without reading its data, or `None` if it isn't a JPEG.
pub(super) fn jpeg_size(reader: impl BufRead + Seek) -> Option<(u32, u32)> {
    let options = DecoderOptions::default().set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(reader, options);
    decoder.decode_headers().ok()?;
    decoder.info().map(|info| (info.width.into(), info.height.into()))
}

/// Decodes a JPEG, gray or as RGB. Returns `true` with it if the file holds three components: neither gray nor CMYK.
///
/// # Errors
/// Returns a description of what is missing or damaged. Without its end marker, a file counts as cut short.
pub(super) fn decode_jpeg(bytes: &[u8]) -> Result<(DynamicImage, bool), String> {
    if !has_end_marker(bytes) {
        return Err("its data end before the image does".into());
    }
    let options =
        DecoderOptions::default().set_strict_mode(true).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|why| why.to_string())?;
    let stored = decoder.input_colorspace().expect("the headers are decoded");
    let is_gray = stored == ColorSpace::Luma;
    let target = if is_gray { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(options.jpeg_set_out_colorspace(target));
    let pixels = decoder.decode().map_err(|why| why.to_string())?;
    let (width, height) =
        decoder.info().map(|info| (info.width.into(), info.height.into())).unwrap_or((0, 0));
    let image = match is_gray {
        true => GrayImage::from_raw(width, height, pixels).map(DynamicImage::from),
        false => RgbImage::from_raw(width, height, pixels).map(DynamicImage::from),
    };
    Ok((image.expect("a decoder that fills the image"), stored.num_components() == 3))
}

/// Returns `true` if the JPEG ends with a marker, whatever follows it. Those of thumbnails lie in segments, which are skipped.
fn has_end_marker(bytes: &[u8]) -> bool {
    let mut rest = bytes;
    // 0 follows a byte of data that isn't a marker, and 0xff fills up.
    // Markers of restarts and of the start have no segment.
    let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff | 0x01 | 0xd0..=0xd8);
    while let Some(at) = rest.windows(2).position(is_marker) {
        if rest[at + 1] == EOI {
            return true;
        }
        let Some(length) = rest.get(at + 2..).and_then(|segment| segment.first_chunk()) else { return false };
        rest = rest.get(at + 2 + usize::from(u16::from_be_bytes(*length))..).unwrap_or_default();
    }
    false
}
