//! What a photo's metadata say about its camera.

use super::codec::encoded_image_size;
use crate::geo::GeoPosition;
use exif::{Context, Exif, In, Reader, Tag, Value};
use image::metadata::Orientation;
use image::{ImageDecoder, ImageReader};
use std::io::Cursor;

/// Diagonal of 35 mm film, 36 mm × 24 mm.
const FILM_DIAGONAL: f64 = 43.266_615;

/// Returns the focal length in pixels that the EXIF data in `encoded`, the contents of a photo's file, tell, at the size of the file, or
/// `None` if they tell none.
///
/// The 35 mm equivalent f₃₅ comes first, since a photo may have been reduced after its EXIF data were written: f = f₃₅·√(W² + H²) /
/// 43.27 mm (CIPA DCG-001). Otherwise f is the focal length times the sensor's pixels per millimetre (`FocalPlaneXResolution`), times
/// the factor by which the longer side was reduced.
pub fn exif_focal(encoded: &[u8]) -> Option<f64> {
    let (width, height) = encoded_image_size(encoded)?;
    let (width, height) = (f64::from(width), f64::from(height));
    let exif = read_exif(encoded)?;
    let number = |tag| {
        // Some files have all tags in one directory.
        let field = exif.get_field(tag, In::PRIMARY);
        let field = field.or_else(|| exif.get_field(Tag(Context::Tiff, tag.number()), In::PRIMARY))?;
        let number = match &field.value {
            Value::Rational(numbers) => numbers.first()?.to_f64(),
            Value::SRational(numbers) => numbers.first()?.to_f64(),
            Value::SShort(numbers) => f64::from(*numbers.first()?),
            Value::SLong(numbers) => f64::from(*numbers.first()?),
            Value::Float(numbers) => f64::from(*numbers.first()?),
            Value::Double(numbers) => *numbers.first()?,
            value => f64::from(value.get_uint(0)?),
        };
        // 0 stands for an unknown number.
        (number > 0. && number.is_finite()).then_some(number)
    };
    if let Some(equivalent) = number(Tag::FocalLengthIn35mmFilm) {
        return Some(equivalent * width.hypot(height) / FILM_DIAGONAL);
    }
    let millimetres = match number(Tag::FocalPlaneResolutionUnit) {
        Some(3.) => 10.,
        Some(4.) => 1.,
        Some(5.) => 1e-3,
        _ => 25.4,
    };
    let stored = number(Tag::PixelXDimension).zip(number(Tag::PixelYDimension));
    let reduction = stored.map_or(1., |(x, y)| width.max(height) / x.max(y));
    Some(number(Tag::FocalLength)? * number(Tag::FocalPlaneXResolution)? / millimetres * reduction)
}

/// Returns the position that the EXIF data in `encoded`, the contents of a photo's file, tell, or `None` if they tell none. 0° north and
/// 0° east stand for an unknown position.
pub fn exif_position(encoded: &[u8]) -> Option<GeoPosition> {
    let exif = read_exif(encoded)?;
    let field = |tag| exif.get_field(tag, In::PRIMARY).map(|field| &field.value);
    let rationals = |tag| match field(tag)? {
        Value::Rational(numbers) => Some(numbers.iter().map(|number| number.to_f64()).collect::<Vec<_>>()),
        _ => None,
    };
    let is_negative = |tag, negative: u8| match field(tag) {
        Some(Value::Ascii(text)) => text.first().and_then(|text| text.first()) == Some(&negative),
        Some(Value::Byte(bytes)) => bytes.first() == Some(&negative),
        _ => false,
    };
    let signed = |value: f64, is_negative: bool| if is_negative { -value } else { value };
    let degrees = |tag, reference, negative| {
        let [degrees, minutes, seconds] = rationals(tag)?.try_into().ok()?;
        Some(signed(degrees + minutes / 60. + seconds / 3600., is_negative(reference, negative)))
    };
    let latitude = degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S')?;
    let longitude = degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W')?;
    let altitude = rationals(Tag::GPSAltitude).and_then(|numbers| numbers.first().copied());
    let altitude = altitude.filter(|altitude| altitude.is_finite());
    // 1 stands for below sea level.
    let altitude = altitude.map(|altitude| signed(altitude, is_negative(Tag::GPSAltitudeRef, 1)));
    GeoPosition::new(longitude, latitude, altitude).filter(|_| (longitude, latitude) != (0., 0.))
}

/// Returns the EXIF data in `encoded`, the contents of a photo's file, as far as they aren't damaged.
fn read_exif(encoded: &[u8]) -> Option<Exif> {
    let mut reader = Reader::new();
    reader.continue_on_error(true);
    let undamaged =
        |exif: Result<Exif, exif::Error>| exif.or_else(|why| why.distill_partial_result(|_| ())).ok();
    let mut tiff = match undamaged(reader.read_from_container(&mut Cursor::new(encoded))) {
        Some(exif) => exif.buf().to_vec(),
        None => exif_chunk(&mut open_decoder(encoded)?)?,
    };
    // libtiff declares the pointer to the Exif directory as an IFD (13). The reader only follows a LONG (4).
    for (pointer, long) in
        [([0x69, 0x87, 13, 0], [0x69, 0x87, 4, 0]), ([0x87, 0x69, 0, 13], [0x87, 0x69, 0, 4])]
    {
        if let Some(at) = tiff.windows(4).position(|bytes| bytes == pointer) {
            tiff[at..at + 4].copy_from_slice(&long);
        }
    }
    undamaged(reader.read_raw(tiff))
}

fn open_decoder(encoded: &[u8]) -> Option<impl ImageDecoder> {
    ImageReader::new(Cursor::new(encoded)).with_guessed_format().ok()?.into_decoder().ok()
}

/// Returns the EXIF data of a JPEG, PNG or WebP. Old versions of Pillow write the prefix that they have in JPEGs into other files, too.
pub(super) fn exif_chunk(decoder: &mut impl ImageDecoder) -> Option<Vec<u8>> {
    let chunk = decoder.exif_metadata().ok()??;
    Some(chunk.strip_prefix(b"Exif\0\0").map(<[u8]>::to_vec).unwrap_or(chunk))
}

/// Returns the EXIF data in `encoded`, the contents of a photo's file, without an orientation.
pub(super) fn upright_exif(encoded: &[u8]) -> Option<Vec<u8>> {
    let mut chunk = match open_decoder(encoded) {
        Some(mut decoder) => exif_chunk(&mut decoder)?,
        None => read_exif(encoded)?.buf().to_vec(),
    };
    let _ = Orientation::remove_from_exif_chunk(&mut chunk);
    Some(chunk)
}

/// Returns `true` if the XMP data in `encoded`, the contents of a photo's file, declare a panorama of 360°: `GPano:ProjectionType` is
/// `equirectangular`.
pub fn is_equirectangular(encoded: &[u8]) -> bool {
    let xmp = open_decoder(encoded).and_then(|mut decoder| decoder.xmp_metadata().ok()?).unwrap_or_default();
    // Either an attribute, `GPano:ProjectionType="equirectangular"`, or an element of this name.
    let text = String::from_utf8_lossy(&xmp);
    text.split("GPano:ProjectionType").skip(1).any(|value| {
        value.trim_start_matches([' ', '\t', '\r', '\n', '=', '"', '\'', '>']).starts_with("equirectangular")
    })
}
