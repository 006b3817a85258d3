//! Folders of photos without poses, and what the photos' metadata say.

use crate::assert_refused;
use crate::photos::{encode, encode_with_exif};
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use globalsplat_capture::{exif_focal, is_equirectangular, list_photos};
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
    std::os::unix::fs::symlink(root.join("b"), root.join("link")).unwrap();
    let list = list_photos(root).unwrap();
    let expected = ["9.jpeg", "10.JPG", "b/2.png", "b/c/1.tif", "no_extension", "png_named.jpg"];
    assert_eq!(list.photos, expected.map(|name| root.join(name)));
    assert_eq!(list.others, ["9.jpeg_original", "b/notes.jpg", "cut.png", "film.mov", "link", "raw.dng"]);
    let line = ": 6 of 12 files are no photos and left out: 9.jpeg_original, b/notes.jpg, cut.png and 3 more";
    assert!(list.warning.as_ref().unwrap().ends_with(line), "{:?}", list.warning);
    assert!(list_photos(&root.join("b/c")).unwrap().warning.is_none());
    let empty = root.join("none");
    assert_refused(list_photos(&empty), &["none"]);
    std::fs::create_dir(&empty).unwrap();
    let found = "none: the folder is without photos, of 0 files, expected photos, each a JPEG, PNG";
    assert_refused(list_photos(&empty), &[found]);
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
