//! Masks of photos: where they are found, and what becomes of them.

use crate::{assert_refused, assert_warns, open_transforms};
use globalsplat_capture::{Capture, Photo, open_capture};
use globalsplat_test_kit::formats::{HEIGHT, WIDTH, cameras, names, pinhole, write_colmap_text};
use image::{DynamicImage, GrayImage, Luma, Rgba, RgbaImage};
use serde_json::json;
use std::path::Path;
use tempfile::TempDir;

/// Returns a mask of many levels.
fn levels() -> GrayImage {
    GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([(x * 11 + y * y) as u8]))
}

fn save(image: impl Into<DynamicImage>, path: &Path) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image.into().save(path).unwrap();
}

/// Writes five photos to `images`, all of them [`levels`] in colors.
fn folder_of_photos(names: &[String]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let photo = DynamicImage::from(levels()).into_rgb8();
    names.iter().for_each(|name| save(photo.clone(), &folder.path().join("images").join(name)));
    folder
}

fn mask_of(capture: &Capture, view: usize) -> Option<Vec<u8>> {
    capture.load(&[view], None).unwrap().remove(0).mask
}

#[test]
fn masks_are_found_where_tools_put_them() {
    // nerfstudio names them, for any of its frames.
    let nerfstudio = folder_of_photos(&names());
    save(levels(), &nerfstudio.path().join("masks/some.png"));
    let named = open_transforms(nerfstudio.path(), |t| t["frames"][1]["mask_path"] = json!("masks/some.png"));
    // COLMAP adds an extension to the name of the photo, others replace its own, or add a word, too.
    let names = ["left/0.jpg", "left/1.png", "right/0.jpg", "right/1.png", "2.png"].map(String::from);
    let colmap = folder_of_photos(&names);
    write_colmap_text(&colmap.path().join("sparse/0"), &names, &cameras(), &pinhole(&cameras()[0]));
    for mask in ["left/0.jpg.png", "left/1.png_mask.png", "right/0.png", "right/1_mask.png"] {
        save(levels(), &colmap.path().join("masks").join(mask));
    }
    for (capture, expected) in [(named, [1].as_slice()), (open_capture(colmap.path()), &[1, 2, 3, 4])] {
        let capture = capture.unwrap();
        let masked: Vec<usize> = (0..5).filter(|&view| mask_of(&capture, view).is_some()).collect();
        assert_eq!((masked.as_slice(), capture.mask_count()), (expected, expected.len()));
        assert_eq!(mask_of(&capture, masked[0]).unwrap(), levels().into_raw());
        assert!(capture.warnings().is_empty(), "{:?}", capture.warnings());
    }
}

#[test]
fn a_folder_of_masks_replaces_those_of_the_capture() {
    let folder = folder_of_photos(&names());
    let given = folder.path().join("given");
    save(GrayImage::from_pixel(WIDTH, HEIGHT, Luma([9])), &folder.path().join("own/000.png"));
    let own = open_transforms(folder.path(), |t| t["frames"][0]["mask_path"] = json!("own/000.png")).unwrap();
    assert_eq!(mask_of(&own, 0).unwrap()[0], 9);
    assert_refused(own.clone().with_masks(&given), &["given can't be read"]);
    std::fs::create_dir(&given).unwrap();
    let found = "given: the folder is without a mask for any photo, expected images/000.png.png";
    assert_refused(own.clone().with_masks(&given), &[found]);
    let error = own.clone().with_masks(&folder.path().join("images"));
    assert_refused(error, &["images/000.png: the mask is the photo itself"]);
    // With or without the folders of the photos' names.
    for names in [["images/001.png.png", "images/002.tif"], ["001.png", "002.png.bmp"]] {
        names.iter().for_each(|name| save(levels(), &given.join(name)));
        let capture = own.clone().with_masks(&given).unwrap();
        let masked = [0, 1, 2, 3, 4].map(|view| mask_of(&capture, view).is_some());
        assert_eq!(masked, [false, true, true, false, false], "{names:?}");
        let count = "given: 3 of 5 photos have no mask and count whole: ";
        assert_warns(&capture, &[count, "images/000.png, images/003.png, images/004.png"]);
        std::fs::remove_dir_all(&given).unwrap();
    }
}

/// The photo is its own mask, so that both must become the same.
#[test]
fn masks_lose_distortion_and_are_fitted_as_their_photos() {
    let folder = folder_of_photos(&names());
    names().iter().for_each(|name| save(levels(), &folder.path().join("masks").join(name)));
    let (lens, plain) = ("OPENCV 21.5 20.25 11.75 8.5 -0.1 0.02 0.01 -0.01", pinhole(&cameras()[0]));
    for lens in [lens, &plain] {
        write_colmap_text(&folder.path().join("sparse/0"), &names(), &cameras(), lens);
        let capture = open_capture(folder.path()).unwrap();
        for size in [None, Some([10, 12].into()), Some([32, 20].into()), Some([16, 24].into())] {
            // A lens that several photos share, and that of a single one.
            for photos in [capture.load_all(size).unwrap(), capture.load(&[2], size).unwrap()] {
                for Photo { image, mask, .. } in photos {
                    let pixels = image.size().0 * image.size().1;
                    assert!(mask.as_deref() == Some(&image.as_bytes()[..pixels]), "{lens} {size:?}");
                }
            }
        }
    }
}

#[test]
fn opacity_is_a_mask_and_multiplies_another() {
    let folder = folder_of_photos(&names());
    let photo =
        |alpha: fn(u32) -> u8| RgbaImage::from_fn(WIDTH, HEIGHT, |x, _| Rgba([200, 100, 50, alpha(x)]));
    let images = folder.path().join("images");
    save(photo(|x| if x < 12 { 0 } else { 255 }), &images.join("000.png"));
    save(photo(|_| 255), &images.join("001.png"));
    save(photo(|x| x as u8 * 10), &images.join("002.png"));
    save(levels(), &folder.path().join("masks/2.png"));
    save(GrayImage::from_pixel(WIDTH, HEIGHT, Luma([255])), &folder.path().join("masks/3.png"));
    let capture = open_transforms(folder.path(), |t| {
        [2, 3].into_iter().for_each(|i| t["frames"][i]["mask_path"] = json!(format!("masks/{i}.png")));
    });
    let capture = capture.unwrap();
    let half: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| if i % WIDTH < 12 { 0 } else { 255 }).collect();
    assert_eq!(mask_of(&capture, 0).unwrap(), half);
    let product = |(x, _, level): (u32, u32, &Luma<u8>)| {
        (f64::from(level[0]) * f64::from(x as u8 * 10) / 255.).round() as u8
    };
    assert_eq!(mask_of(&capture, 2).unwrap(), levels().enumerate_pixels().map(product).collect::<Vec<_>>());
    // Over white, all pixels count. The second photo's red is 200, that of the last one 80.
    let red = capture.clone().with_background(255).load_all(None).unwrap();
    assert!(red.iter().all(|photo| photo.mask.is_none()));
    let over_white = |(x, _, level): (u32, u32, &Luma<u8>)| {
        let of_photo = 255. + (200. - 255.) * f64::from(x * 10) / 255.;
        255. + (of_photo - 255.) * f64::from(level[0]) / 255.
    };
    let expected: Vec<f64> = levels().enumerate_pixels().map(over_white).collect();
    let [_, _, photo, ..] = &red[..] else { panic!() };
    let found = &photo.image.as_bytes()[..(WIDTH * HEIGHT) as usize];
    assert!(
        expected.iter().zip(found).all(|(a, b)| (a - f64::from(*b)).abs() < 2.),
        "{expected:?} {found:?}"
    );
    // Over black, with the same weights.
    let black = capture.clone().over_black().load(&[2, 3], None).unwrap();
    let products = black[0].mask.clone().unwrap();
    assert_eq!(Some(&products), mask_of(&capture, 2).as_ref());
    for (found, product) in black[0].image.as_bytes().iter().zip(products) {
        let expected = 200. * f64::from(product) / 255.;
        assert!((f64::from(*found) - expected).abs() < 1.5, "{found} {expected}");
    }
    assert!(black[1].image == capture.load(&[3], None).unwrap()[0].image);
    // If every pixel counts, there is no mask.
    assert!([1, 3, 4].iter().all(|&view| mask_of(&capture, view).is_none()));
    // Two alpha channels with and without effect, an alpha channel with a mask, and a mask.
    assert_eq!(capture.mask_count(), 4);
}

#[test]
fn masks_of_another_size_are_resized_if_the_aspect_agrees() {
    let folder = folder_of_photos(&names());
    let mask = folder.path().join("masks/1.png");
    let open = || open_transforms(folder.path(), |t| t["frames"][1]["mask_path"] = json!("masks/1.png"));
    // White to the left of column 6 of 12.
    save(GrayImage::from_fn(12, 8, |x, _| Luma([if x < 6 { 255 } else { 0 }])), &mask);
    let capture = open().unwrap();
    assert_warns(&capture, &["the masks of 1 of 5 photos have another size and are resized: images/001.png"]);
    let resized = mask_of(&capture, 1).unwrap();
    for x in [0, 8, 15, 23] {
        // The filter overshoots near the edge.
        let (found, expected) = (resized[5 * WIDTH as usize + x], if x < 12 { 255u8 } else { 0 });
        assert!(found.abs_diff(expected) < 10, "{x}: {found}");
    }
    for (width, height) in [(16, 24), (24, 20), (12, 16)] {
        save(GrayImage::new(width, height), &mask);
        let found = format!("1.png: the mask is {width}×{height} pixels");
        assert_refused(open(), &[&found, "expected 24×16 pixels as images/001.png"]);
    }
}

#[test]
fn a_missing_or_damaged_mask_is_refused_by_name() {
    let folder = folder_of_photos(&names());
    let [masks, photo] = ["masks", "images/003.png"].map(|name| folder.path().join(name));
    std::fs::create_dir(&masks).unwrap();
    std::fs::write(masks.join("damaged.png"), "no image").unwrap();
    let open = |path| open_transforms(folder.path(), |t| t["frames"][3]["mask_path"] = path);
    let missing = "mask_path of frame 3 is \"masks/3.png\", which is missing, expected an image";
    for (path, found) in [
        (json!("masks/3.png"), missing),
        // The name of the photo if the folder is left out, as it may be for photos.
        (json!("masks/images/003.png"), "is \"masks/images/003.png\", which is missing"),
        (json!(7), "mask_path of frame 3 is 7, expected the path of an image"),
        (json!("masks/damaged.png"), "masks/damaged.png: the image is undecodable"),
    ] {
        assert_refused(open(path), &[found]);
    }
    assert_eq!(open(json!(null)).unwrap().mask_count(), 0);
    // A photo that is missing, too, is left out.
    std::fs::remove_file(photo).unwrap();
    assert_eq!(open(json!("masks/3.png")).unwrap().len(), 4);
}

#[test]
fn masks_are_read_however_they_are_written() {
    let folder = folder_of_photos(&names());
    let level = |x: u32, white: u8| if x > 6 { white } else { 0 };
    let gray = |white: u8| GrayImage::from_fn(WIDTH, HEIGHT, |x, _| Luma([level(x, white)]));
    let plain = DynamicImage::from(gray(255));
    // White cut out of something transparent.
    let cut_out = RgbaImage::from_fn(WIDTH, HEIGHT, |x, _| Rgba([255, 255, 255, level(x, 255)]));
    // Programs write arrays of booleans with the levels 0 and 1.
    let masks =
        [plain.clone(), gray(1).into(), plain.to_rgb8().into(), cut_out.into(), plain.to_rgba8().into()];
    for (mask, name) in masks.into_iter().zip(names()) {
        save(mask, &folder.path().join("masks").join(name));
    }
    let capture = open_transforms(folder.path(), |_| ()).unwrap();
    let capture = capture.with_masks(&folder.path().join("masks")).unwrap();
    for view in 0..5 {
        assert_eq!(mask_of(&capture, view).as_deref(), Some(plain.as_bytes()), "{view}");
    }
}

#[test]
fn masked_out_photos_are_known_and_masks_are_part_of_the_checksum() {
    let folder = folder_of_photos(&names());
    let masks = folder.path().join("masks");
    let plain = open_transforms(folder.path(), |_| ()).unwrap();
    let mut checksums = vec![];
    for (level, count) in [(0, 1), (10, 0), (20, 0)] {
        save(GrayImage::from_pixel(WIDTH, HEIGHT, Luma([level])), &masks.join("002.png"));
        let masked = plain.clone().with_masks(&masks).unwrap();
        let photos = masked.load_all(None).unwrap();
        assert_eq!(photos.iter().filter(|photo| photo.is_masked_out()).count(), count);
        checksums.extend([&plain, &masked].map(|capture| capture.checksum(0..5).unwrap()));
    }
    let [a, b, c, d, e, f] = checksums[..] else { unreachable!() };
    assert!(a == c && c == e && a != b && b != d && d != f && b != f, "{checksums:?}");
}
