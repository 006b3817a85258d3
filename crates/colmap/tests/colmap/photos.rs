//! Photos as a capture takes them: converted, masked, or left out.

use crate::{failing_colmap, make};
use globalsplat_capture::read_image;
use globalsplat_colmap::CaptureOptions;
use image::codecs::png::PngEncoder;
use image::{
    DynamicImage, GrayImage, ImageEncoder, ImageFormat, ImageResult, Luma, Rgb, RgbImage, Rgba, RgbaImage,
};
use serde_json::{Value, from_slice, json};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A temporary folder with a folder `photos`, in which is a folder `masks`.
struct Folders(TempDir);

impl Folders {
    fn new() -> Self {
        let folders = Folders(tempfile::tempdir().unwrap());
        fs::create_dir_all(folders.at("photos/masks")).unwrap();
        folders
    }

    fn at(&self, name: impl AsRef<Path>) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a PNG of 16×8 pixels, another one for each `seed`.
    fn write(&self, name: impl AsRef<Path>, seed: u8) -> ImageResult<()> {
        let photo = RgbImage::from_fn(16, 8, |x, y| Rgb([x as u8 * 9, y as u8 * 9, seed]));
        photo.save_with_format(self.at(name), ImageFormat::Png)
    }

    /// Makes a capture of the folder `source` up to the first command of COLMAP, which fails. Returns the contents of its capture.json.
    fn import(&self, source: &str, masks: Option<&str>) -> Result<Value, String> {
        let options =
            CaptureOptions { masks: masks.map(|masks| self.at(masks)), ..CaptureOptions::default() };
        let capture = make(&self.at(source), &self.at("out"), &options, &failing_colmap());
        match capture.unwrap_err().to_string() {
            error if !error.starts_with("COLMAP's feature_extractor failed") => Err(error),
            _ => Ok(from_slice(&fs::read(self.at("out/capture.json")).unwrap()).unwrap()),
        }
    }
}

fn names(record: &Value) -> Vec<&str> {
    record["photos"].as_array().unwrap().iter().map(|photo| photo["name"].as_str().unwrap()).collect()
}

#[test]
fn useless_photos_are_skipped_and_named() {
    let folders = Folders::new();
    let at = |name: &str| folders.at("photos").join(name);
    ["#b", "b"].iter().for_each(|folder| fs::create_dir(at(folder)).unwrap());
    let photos = ["#.png", "#b/#.png", "a 1.png", "a_1.png", "b/2.png", "é.png"];
    for (seed, name) in photos.into_iter().enumerate() {
        folders.write(at(name), seed as u8).unwrap();
    }
    fs::copy(at("b/2.png"), at("b/3.png")).unwrap();
    RgbImage::from_pixel(16, 8, Rgb([3; 3])).save(at("black.png")).unwrap();
    fs::write(at("cut.png"), &fs::read(at("a 1.png")).unwrap()[..60]).unwrap();
    fs::write(at(".hidden.png"), "no photo").unwrap();
    let record = folders.import("photos", None).unwrap();
    // COLMAP's lists have comments after a `#`, and names between spaces.
    assert_eq!(names(&record), ["_.png", "_b/#.png", "a_1.png", "_a_1.png", "b/2.png", "é.png"]);
    assert_eq!(fs::read(folders.at("out/images/_a_1.png")).unwrap(), fs::read(at("a_1.png")).unwrap());
    let skipped = record["skipped"].as_array().unwrap();
    let reasons = [
        ("b/3.png", "identical to b/2.png"),
        ("black.png", "of a single color"),
        ("cut.png", "undecodable ("),
    ];
    assert_eq!(skipped.len(), reasons.len(), "{skipped:?}");
    for (photo, (name, reason)) in skipped.iter().zip(reasons) {
        assert!(photo["name"] == name && photo["reason"].as_str().unwrap().starts_with(reason), "{photo}");
    }
}

/// Names that Windows doesn't have, and file systems on which `A.png` and `a.png` are one file, as on most Macs.
#[cfg(target_os = "linux")]
#[test]
fn names_of_other_systems_are_replaced() {
    use std::os::unix::ffi::OsStrExt;
    let folders = Folders::new();
    for (seed, name) in ["A.png", "a.png", "a\\1.png", "a_1.png"].into_iter().enumerate() {
        folders.write(Path::new("photos").join(name), seed as u8).unwrap();
    }
    // Some file systems refuse this name.
    let foreign = Path::new("photos").join(std::ffi::OsStr::from_bytes(b"z\xe9.png"));
    let is_foreign = folders.write(foreign, 9).is_ok();
    let mut record = folders.import("photos", None).unwrap();
    // COLMAP takes a `\` for a `/`.
    assert_eq!(names(&record), ["A.png", "a.png", "a_1.png", "_a_1.png"]);
    for skipped in record["skipped"].as_array().unwrap() {
        assert_eq!(skipped["reason"], "named in another encoding than UTF-8", "{skipped}");
        assert!(is_foreign);
    }
    std::os::unix::fs::symlink("images", folders.at("out/IMAGES")).unwrap();
    // As if the call had been stopped before all photos were there.
    record["photos"] = Value::Null;
    fs::write(folders.at("out/capture.json"), record.to_string()).unwrap();
    let record = folders.import("photos", None).unwrap();
    assert_eq!(names(&record), ["A.png", "_a.png", "a_1.png", "_a_1.png"]);
}

#[test]
fn photos_that_colmap_may_not_read_are_converted_with_their_opacity_and_orientation() {
    let folders = Folders::new();
    let [photos, out] = ["photos", "out"].map(|name| folders.at(name));
    let transparent =
        RgbaImage::from_fn(16, 8, |x, y| Rgba([x as u8 * 15, y as u8 * 30, 90, if x < 8 { 0 } else { 255 }]));
    transparent.save(photos.join("a.webp")).unwrap();
    folders.write("photos/a.png", 1).unwrap();
    // The contents of a PNG under another extension, with a mask of half its size.
    folders.write("photos/b.jpg", 2).unwrap();
    let mask = GrayImage::from_fn(8, 4, |x, _| Luma([if x < 4 { 255 } else { 0 }]));
    mask.save(photos.join("masks/b.png")).unwrap();
    // EXIF with one entry: orientation (0x0112), a SHORT, is 6, a clockwise turn by 90°.
    let exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
    let rotated = RgbImage::from_fn(16, 8, |x, _| Rgb([if x < 8 { 0 } else { 250 }; 3]));
    rotated.save(photos.join("c.jpg")).unwrap();
    let jpeg = fs::read(photos.join("c.jpg")).unwrap();
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let jpeg = [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat();
    fs::write(photos.join("c.jpg"), jpeg).unwrap();

    let record = folders.import("photos", None).unwrap();
    assert_eq!(record["skipped"], json!([]));
    assert_eq!(names(&record), ["a.png", "a.jpg", "b.jpg.jpg", "c.jpg"]);
    let read = |name: &str| read_image(&out.join(name)).unwrap();
    let mask = read("masks/a.jpg.png");
    assert!(mask.enumerate_pixels().all(|(x, _, level)| level[0] == if x < 8 { 0 } else { 255 }));
    let converted = read("images/a.jpg");
    assert!(converted.get_pixel(12, 4)[0].abs_diff(180) < 12, "{:?}", converted.get_pixel(12, 4));
    let mask = read("masks/b.jpg.jpg.png");
    assert_eq!((mask.dimensions(), mask.get_pixel(2, 2)[0], mask.get_pixel(13, 5)[0]), ((16, 8), 255, 0));
    let (upright, photo) = (read("images/c.jpg"), &record["photos"][3]);
    assert_eq!((upright.dimensions(), &photo["width"], &photo["height"]), ((8, 16), &json!(8), &json!(16)));
    assert!(upright.get_pixel(4, 2).0[0] < 50 && upright.get_pixel(4, 13).0[0] > 200);
    // Other EXIF data, such as the position, are kept.
    let upright_exif = exif.map(|byte| if byte == 6 { 1 } else { byte });
    let written = fs::read(out.join("images/c.jpg")).unwrap();
    assert!(written.windows(exif.len()).any(|bytes| bytes == upright_exif));
    let alpha: Vec<bool> = (0..4).map(|photo| record["photos"][photo]["has_alpha"] == true).collect();
    assert_eq!(alpha, [false, true, false, false]);
}

/// Orientations 1 to 8 of EXIF, of photos whose upright size differs from the stored one or doesn't. Masks are upright, or turned as well.
#[test]
fn photos_and_masks_of_every_orientation_become_upright() {
    let folders = Folders::new();
    let write = |name: &str, image: &RgbImage, orientation: u8| {
        let mut encoder = PngEncoder::new(File::create(folders.at("photos").join(name)).unwrap());
        let exif = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0";
        encoder.set_exif_metadata([exif, &[orientation][..], &[0; 6]].concat()).unwrap();
        image.write_with_encoder(encoder).unwrap();
    };
    let upright = |orientation: u8, width: u32| {
        RgbImage::from_fn(width, 8, |x, y| Rgb([x as u8 * 15 + y as u8, y as u8 * 30, orientation]))
    };
    let cases = || (1..=8).flat_map(|orientation| [8, 16].map(|width| (orientation, width)));
    for (orientation, width) in cases() {
        let (image, (right, bottom)) = (upright(orientation, width), (width - 1, 7));
        let (w, h) = if orientation < 5 { (width, 8) } else { (8, width) };
        // Where the stored column and row are in the upright image (EXIF 2.32, 4.6.4).
        let stored = RgbImage::from_fn(w, h, |column, row| {
            let (x, y) = match orientation {
                1 => (column, row),
                2 => (right - column, row),
                3 => (right - column, bottom - row),
                4 => (column, bottom - row),
                5 => (row, column),
                6 => (right - row, column),
                7 => (right - row, bottom - column),
                _ => (row, bottom - column),
            };
            *image.get_pixel(x, y)
        });
        let name = format!("{orientation}_{width}.png");
        write(&name, &stored, orientation);
        let (mask, turn) = if width == 8 { (image, 1) } else { (stored, orientation) };
        write(&format!("masks/{name}"), &mask, turn);
    }
    let record = folders.import("photos", None).unwrap();
    assert_eq!(record["skipped"], json!([]));
    for (orientation, width) in cases() {
        let (name, image) = (format!("{orientation}_{width}.png"), upright(orientation, width));
        assert!(read_image(&folders.at("out/images").join(&name)).unwrap() == image, "{name}");
        let mask = read_image(&folders.at(format!("out/masks/{name}.png"))).unwrap();
        let luma = DynamicImage::from(image).into_luma8();
        assert!(DynamicImage::from(mask).into_luma8() == luma, "the mask of {name}");
    }
}

#[test]
fn masks_of_another_folder_replace_those_of_an_earlier_run() {
    let folders = Folders::new();
    fs::create_dir(folders.at("other")).unwrap();
    for (seed, name) in ["photos/a.png", "photos/b.png", "photos/masks/a.png"].into_iter().enumerate() {
        folders.write(name, seed as u8).unwrap();
    }
    // Photos without a mask count whole.
    let are_white = || {
        ["a", "b"].map(|name| {
            let mask = read_image(&folders.at(format!("out/masks/{name}.png.png"))).unwrap();
            mask.pixels().all(|pixel| pixel.0 == [255; 3])
        })
    };
    folders.import("photos", None).unwrap();
    assert_eq!(are_white(), [false, true]);
    let mask = folders.at("other/b.png.png");
    let small = RgbImage::new(8, 16);
    for (prepare, expected) in [
        (&|| {}, "other: the folder is without a mask for any photo, expected a.png.png"),
        (&|| small.save(&mask).unwrap(), "the mask is 8×16 pixels, expected 16×8 pixels"),
        (&|| fs::write(&mask, "no image").unwrap(), "b.png.png: the image"),
    ] as [(&dyn Fn(), &str); 3]
    {
        prepare();
        let error = folders.import("photos", Some("other")).unwrap_err();
        assert!(error.contains(expected), "{error}");
    }
    fs::copy(folders.at("photos/b.png"), &mask).unwrap();
    folders.import("photos", Some("other")).unwrap();
    assert_eq!(are_white(), [true, false]);
    // Other contents of a mask are noticed.
    GrayImage::from_pixel(16, 8, Luma([255])).save(&mask).unwrap();
    folders.import("photos", Some("other")).unwrap();
    assert_eq!(are_white(), [true, true]);
    let error = folders.import("photos", Some("out/masks")).unwrap_err();
    assert!(error.contains("the folder of masks is one of masks that `capture` wrote"), "{error}");
    let error = folders.import("photos", Some("photos")).unwrap_err();
    assert!(error.contains("the folder of masks is that of the photos"), "{error}");
    // The masks of all folders may be removed, and earlier versions recorded none as null.
    ["photos/masks", "out/masks"].iter().for_each(|name| fs::remove_dir_all(folders.at(name)).unwrap());
    let mut record = folders.import("photos", None).unwrap();
    assert_eq!(record["masks"].take(), json!({}));
    fs::write(folders.at("out/capture.json"), record.to_string()).unwrap();
    assert_eq!(folders.import("photos", None).unwrap()["masks"], json!({}));
}

#[test]
fn masks_that_no_capture_wrote_stay() {
    let folders = Folders::new();
    for (seed, name) in ["photos/a.png", "photos/b.png"].into_iter().enumerate() {
        folders.write(name, seed as u8).unwrap();
    }
    folders.import("photos", None).unwrap();
    // The user's, beside the photos of the capture.
    let mask = folders.at("out/masks/a.png.png");
    fs::create_dir_all(mask.parent().unwrap()).unwrap();
    GrayImage::from_fn(16, 8, |x, _| Luma([if x < 8 { 0 } else { 255 }])).save(&mask).unwrap();
    let before = fs::read(&mask).unwrap();
    fs::create_dir(folders.at("other")).unwrap();
    folders.write("other/a.png", 5).unwrap();
    let error = folders.import("photos", Some("other")).unwrap_err().replace('\\', "/");
    assert!(error.contains("masks/a.png.png: the mask is one that no capture wrote"), "{error}");
    // As an input, it is used as it is.
    let [first, second] = [(); 2].map(|()| folders.import("photos", Some("out/masks")).unwrap());
    assert_eq!(first["masks"], second["masks"]);
    assert!(folders.at("out/masks/b.png.png").exists() && fs::read(&mask).unwrap() == before);
    folders.import("photos", None).unwrap();
    assert_eq!(fs::read(&mask).unwrap(), before);
    RgbImage::new(8, 4).save(&mask).unwrap();
    let before = fs::read(&mask).unwrap();
    let error = folders.import("photos", Some("out/masks")).unwrap_err();
    assert!(error.contains("a.png.png: the mask is of another size"), "{error}");
    assert_eq!(fs::read(&mask).unwrap(), before);
}

/// Photos of a capture may be edited: they are copies.
#[test]
fn photos_are_copies() {
    let folders = Folders::new();
    for (seed, name) in ["photos/a.png", "photos/b.png"].into_iter().enumerate() {
        folders.write(name, seed as u8).unwrap();
    }
    let original = fs::read(folders.at("photos/a.png")).unwrap();
    folders.import("photos", None).unwrap();
    fs::write(folders.at("out/images/a.png"), "edited").unwrap();
    assert_eq!(fs::read(folders.at("photos/a.png")).unwrap(), original);
}

#[test]
fn photos_in_the_folder_of_images_are_left_as_they_are() {
    let folders = Folders::new();
    fs::create_dir_all(folders.at("out/images")).unwrap();
    for (seed, name) in ["a 1.png", "a_1.png", "b.png"].into_iter().enumerate() {
        folders.write(format!("out/images/{name}"), seed as u8).unwrap();
    }
    let [unsafe_name, kept] = ["a 1.png", "a_1.png"].map(|name| folders.at("out/images").join(name));
    let before = fs::read(&kept).unwrap();
    let error = folders.import("out/images", None).unwrap_err();
    assert!(error.contains("a 1.png: the photo is one that COLMAP can't read"), "{error}");
    assert!(fs::read(&kept).unwrap() == before && unsafe_name.is_file());
    [unsafe_name, folders.at("out/capture.json")].iter().for_each(|file| fs::remove_file(file).unwrap());
    assert_eq!(names(&folders.import("out/images", None).unwrap()), ["a_1.png", "b.png"]);
    assert_eq!(fs::read(&kept).unwrap(), before);
}
