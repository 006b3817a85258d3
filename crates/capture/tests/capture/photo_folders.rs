//! Folders of photos without poses, and what the photos' metadata say.

use crate::assert_refused;
use crate::photos::{encode, encode_with_exif};
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use globalsplat_capture::{exif_focal, exif_position, is_equirectangular, list_photos};
use image::{ImageFormat, RgbImage};
use std::io::Cursor;

fn encode_black(format: ImageFormat) -> Vec<u8> {
    encode(&RgbImage::new(24, 16).into(), format)
}

#[test]
fn photos_are_told_from_other_files_by_their_contents() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let write = |name: &str, contents: &[u8]| {
        std::fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
        std::fs::write(root.join(name), contents).unwrap();
    };
    let (jpeg, png, tiff) =
        (encode_black(ImageFormat::Jpeg), encode_black(ImageFormat::Png), encode_black(ImageFormat::Tiff));
    let photos = ["10.JPG", "9.jpeg", "b/2.png", "b/c/1.tif", "no_extension", "png_named.jpg"];
    for (photo, contents) in photos.iter().zip([&jpeg, &jpeg, &png, &tiff, &jpeg, &png]) {
        write(photo, contents);
    }
    // Text, a film, a backup, a raw file, and a file that is cut short before its size.
    let others: [(&str, &[u8]); 5] = [
        ("b/notes.jpg", b"text"),
        ("film.mov", b"text"),
        ("9.jpeg_original", &jpeg),
        ("raw.dng", &tiff),
        ("cut.png", &png[..20]),
    ];
    others.iter().for_each(|(name, contents)| write(name, contents));
    for ignored in [".hidden.jpg", ".thumbnails/1.jpg", "b/Thumbs.db", "masks/10.png", "desktop.ini"] {
        write(ignored, &jpeg);
    }
    #[cfg(unix)]
    std::os::unix::fs::symlink(root.join("b"), root.join("raw_link")).unwrap();
    #[cfg(windows)]
    write("raw_link", b"text");
    let list = list_photos(root).unwrap();
    let expected = ["9.jpeg", "10.JPG", "b/2.png", "b/c/1.tif", "no_extension", "png_named.jpg"];
    assert_eq!(list.photos, expected.map(|name| root.join(name)));
    assert_eq!(list.others, ["9.jpeg_original", "b/notes.jpg", "cut.png", "film.mov", "raw.dng", "raw_link"]);
    let line = ": 6 of 12 files are no photos and left out: 9.jpeg_original, b/notes.jpg, cut.png and 3 more";
    assert!(list.warning.as_ref().unwrap().ends_with(line), "{:?}", list.warning);
    assert!(list_photos(&root.join("b/c")).unwrap().warning.is_none());
    let empty = root.join("none");
    assert_refused(list_photos(&empty), &["none"]);
    std::fs::create_dir(&empty).unwrap();
    let found = "none: the folder is without photos, of 0 files, expected photos, each a JPEG, PNG";
    assert_refused(list_photos(&empty), &[found]);
    std::fs::write(empty.join("walk.3GP"), "").unwrap();
    let expected =
        "photos, each a JPEG, PNG, WebP, TIFF, BMP, HEIC or AVIF, or one video itself: none/walk.3GP";
    let error = list_photos(&empty).unwrap_err().to_string().replace('\\', "/");
    let error = error.replace(&format!("{}/", root.display()).replace('\\', "/"), "");
    assert!(error.ends_with(expected), "{error}");
}

#[test]
fn exif_data_tell_the_focal_length() {
    let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
    let ratio = |tag, num, denom| field(tag, Value::Rational(vec![Rational { num, denom }]));
    let short = |tag, number| field(tag, Value::Short(vec![number]));
    let long = |tag, number| field(tag, Value::Long(vec![number]));
    let equivalent = short(Tag::FocalLengthIn35mmFilm, 26);
    let length = ratio(Tag::FocalLength, 425, 100);
    let unknown = short(Tag::FocalLengthIn35mmFilm, 0);
    // 4000×3000 pixels of 1.5 µm, reduced to a tenth in the file.
    let sensor = [
        ratio(Tag::FocalPlaneXResolution, 20_000, 3),
        short(Tag::FocalPlaneResolutionUnit, 3),
        long(Tag::PixelXDimension, 4000),
        long(Tag::PixelYDimension, 3000),
    ];
    let inches = [ratio(Tag::FocalPlaneXResolution, 2540, 1), short(Tag::FocalPlaneResolutionUnit, 2)];
    let cases = [
        // The diagonal has 500 pixels, and that of the film 43.27 mm.
        (vec![equivalent.clone(), length.clone()], Some(26. * 500. / (36f64 * 36. + 24. * 24.).sqrt())),
        ([vec![unknown.clone(), length.clone()], sensor.into()].concat(), Some(4.25 / 1.5e-3 / 10.)),
        ([vec![length.clone()], inches.into()].concat(), Some(425.)),
        (vec![length.clone()], None),
        (vec![length, unknown], None),
        (vec![short(Tag::Orientation, 1)], None),
    ];
    for (fields, expected) in &cases {
        let (mut writer, mut exif) = (Writer::new(), Cursor::new(vec![]));
        fields.iter().for_each(|field| writer.push_field(field));
        writer.write(&mut exif, true).unwrap();
        for (extension, bytes) in encode_with_exif(&RgbImage::new(400, 300).into(), exif.get_ref()) {
            let found = exif_focal(&bytes);
            let is_right =
                found.zip(*expected).map_or(found == *expected, |(a, b)| (a / b - 1.).abs() < 1e-6);
            assert!(is_right, "{extension} {fields:?}: {found:?} {expected:?}");
        }
    }
    assert_eq!(exif_focal(b"text"), None);
}

#[test]
fn exif_data_tell_the_position() {
    let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
    let ratios = |tag, ratios: &[(u32, u32)]| {
        field(tag, Value::Rational(ratios.iter().map(|&(num, denom)| Rational { num, denom }).collect()))
    };
    let text = |tag, letter: &str| field(tag, Value::Ascii(vec![letter.into()]));
    let west = [
        ratios(Tag::GPSLatitude, &[(33, 1), (51, 1), (2448, 100)]),
        text(Tag::GPSLatitudeRef, "S"),
        ratios(Tag::GPSLongitude, &[(70, 1), (30, 1), (0, 1)]),
        text(Tag::GPSLongitudeRef, "W"),
    ];
    let below = [ratios(Tag::GPSAltitude, &[(125, 10)]), field(Tag::GPSAltitudeRef, Value::Byte(vec![1]))];
    let east = [
        ratios(Tag::GPSLatitude, &[(3385, 100), (0, 1), (0, 1)]),
        ratios(Tag::GPSLongitude, &[(705, 10), (0, 1), (0, 1)]),
    ];
    let nowhere = [Tag::GPSLatitude, Tag::GPSLongitude].map(|tag| ratios(tag, &[(0, 1); 3]));
    let broken = [Tag::GPSLatitude, Tag::GPSLongitude].map(|tag| ratios(tag, &[(0, 0); 3]));
    for (fields, expected) in [
        (west.to_vec(), Some((-70.5, -33.8568, None))),
        ([&west[..], &below].concat(), Some((-70.5, -33.8568, Some(-12.5)))),
        (east.to_vec(), Some((70.5, 33.85, None))),
        (west[..2].to_vec(), None),
        (nowhere.to_vec(), None),
        (broken.to_vec(), None),
    ] {
        let (mut writer, mut exif) = (Writer::new(), Cursor::new(vec![]));
        fields.iter().for_each(|field| writer.push_field(field));
        writer.write(&mut exif, true).unwrap();
        for (extension, bytes) in encode_with_exif(&RgbImage::new(40, 30).into(), exif.get_ref()) {
            let found = exif_position(&bytes);
            let numbers = found.map(|position| (position.longitude, position.latitude, position.altitude));
            let is_right = numbers.zip(expected).map_or(numbers == expected, |(a, b)| {
                (a.0 - b.0).abs() < 1e-9 && (a.1 - b.1).abs() < 1e-9 && a.2 == b.2
            });
            assert!(is_right, "{extension} {fields:?}: {found:?}");
        }
    }
}

/// Entry of a directory in EXIF data: its tag, type, number of values, and value or offset.
type Entry = (u16, u16, u32, u32);

/// Returns EXIF data whose directory at `start` points to another one, of `entries`. Each names the offset of a `next` one. The rational
/// numbers 13/2 and 2/0 are at the offsets 8 and 12.
fn lay_out_exif(is_big: bool, start: u32, entries: &[Entry], next: [u32; 2]) -> Vec<u8> {
    let short = |value: u16| if is_big { value.to_be_bytes() } else { value.to_le_bytes() };
    let long = |value: u32| if is_big { value.to_be_bytes() } else { value.to_le_bytes() };
    let directory = |entries: &[Entry], next: u32| {
        let entry = |&(tag, kind, count, value): &Entry| {
            let value = if kind == 3 { [short(value as u16), [0; 2]].concat() } else { long(value).to_vec() };
            [&short(tag)[..], &short(kind), &long(count), &value].concat()
        };
        [&short(entries.len() as u16)[..], &entries.iter().flat_map(entry).collect::<Vec<_>>(), &long(next)]
            .concat()
    };
    let order = if is_big { b"MM" } else { b"II" };
    let mut bytes = [&order[..], &short(42), &long(start), &long(13), &long(2)].concat();
    bytes.resize(start as usize, 0);
    let pointer = (0x8769, 4, 1, start + 18);
    [bytes, directory(&[pointer], next[0]), directory(entries, next[1])].concat()
}

/// COLMAP and Pillow read what careless writers leave, too.
#[test]
fn damaged_exif_data_tell_what_is_left_of_them() {
    const BEYOND: u32 = u32::MAX;
    let equivalent = |kind: u16, count: u32, value: u32| (0xa405, kind, count, value);
    let (length, resolution, millimetres) = ((0x920a, 5, 1, 8), (0xa20e, 5, 1, 8), (0xa210, 3, 1, 4));
    let (by_26, by_6_5, by_pixels) = (300.462_606, 300.462_606 / 4., 6.5 * 6.5);
    let short = equivalent(3, 1, 26);
    let cases: [(&[Entry], [u32; 2], f64); 14] = [
        (&[short], [0, 0], by_26),
        // FLIR's cameras, piexif, and directories of thumbnails that are none.
        (&[short], [0, BEYOND], by_26),
        (&[short], [0, 8], by_26),
        (&[short], [BEYOND, 0], by_26),
        (&[short], [9, 0], by_26),
        // Other values are beyond the end, of an unknown type, or missing.
        (&[(0x927c, 7, 900, 9000), short], [0, 0], by_26),
        (&[(0x927c, 99, 900, 9000), (0x829a, 5, 0, 0), short], [0, 0], by_26),
        (&[equivalent(4, 1, 26)], [0, 0], by_26),
        (&[equivalent(5, 1, 8)], [0, 0], by_6_5),
        (&[equivalent(10, 1, 8)], [0, 0], by_6_5),
        (&[equivalent(9, 1, 26)], [0, 0], by_26),
        (&[equivalent(11, 1, 26f32.to_bits())], [0, 0], by_26),
        // A denominator of 0 stands for an unknown number.
        (&[equivalent(5, 1, 12), length, resolution, millimetres], [0, 0], by_pixels),
        (&[equivalent(3, 0, 26), length, resolution, millimetres], [BEYOND, BEYOND], by_pixels),
    ];
    for (is_big, start) in [(true, 20), (false, 20), (true, 21), (false, 33)] {
        let lay_out = |(entries, next, expected): &(&[Entry], _, _)| {
            (lay_out_exif(is_big, start, entries, *next), *expected)
        };
        let mut files: Vec<_> = cases.iter().map(lay_out).collect();
        let plain = files[0].0.clone();
        let (mut of_libtiff, mut at_top) = (plain.clone(), plain.clone());
        // The pointer is an IFD (13) instead of a LONG (4); its low byte comes first or second.
        of_libtiff[start as usize + 4 + usize::from(is_big)] = 13;
        let entries = start + 18;
        at_top[4..8].copy_from_slice(&if is_big { entries.to_be_bytes() } else { entries.to_le_bytes() });
        files.extend([
            (of_libtiff, by_26),
            (at_top, by_26),
            (plain[..plain.len() - 4].to_vec(), by_26),
            ([&plain, &b"garbage"[..]].concat(), by_26),
            // Older versions of Pillow keep the prefix that EXIF data have in a JPEG.
            ([b"Exif\0\0", &plain[..]].concat(), by_26),
        ]);
        for (number, (exif, expected)) in files.iter().enumerate() {
            for (extension, bytes) in encode_with_exif(&RgbImage::new(400, 300).into(), exif) {
                let found = exif_focal(&bytes).unwrap_or(0.);
                let name = format!("{number} in {extension}, {is_big}, {start}");
                assert!((found / expected - 1.).abs() < 1e-6, "{name}: {found} {expected}");
            }
        }
    }
}

#[test]
fn panoramas_are_known_by_their_xmp_data() {
    let is_panorama = |xmp: &str| {
        let mut jpeg = encode_black(ImageFormat::Jpeg);
        let packet = format!("http://ns.adobe.com/xap/1.0/\0<x:xmpmeta><rdf:Description {xmp}</x:xmpmeta>");
        let mut segment = vec![0xff, 0xe1];
        segment.extend((packet.len() as u16 + 2).to_be_bytes());
        segment.extend(packet.as_bytes());
        jpeg.splice(2..2, segment);
        is_equirectangular(&jpeg)
    };
    assert!(is_panorama("GPano:UsePanoramaViewer=\"True\" GPano:ProjectionType=\"equirectangular\"/>"));
    assert!(is_panorama("><GPano:ProjectionType> equirectangular</GPano:ProjectionType>"));
    assert!(!is_panorama("GPano:ProjectionType=\"cylindrical\" other=\"equirectangular\"/>"));
    assert!(!is_panorama("/>"));
    assert!(!is_equirectangular(&encode_black(ImageFormat::Png)) && !is_equirectangular(b"text"));
}
