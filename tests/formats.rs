//! The formats captures come in: the same cameras and pixels from each, lenses undone, photos of every kind.

mod common;

use common::formats::{Format, pinhole, rewrite, transforms, write_colmap_binary, write_colmap_text};
use common::{fox, largest_error};
use glam::{DMat3, DMat4, DQuat, DVec3, EulerRot};
use globalsplat::data::{Capture, find_captures, open_capture, write_cameras_json};
use globalsplat::io::{read_image, tensor_from_rgb};
use globalsplat::scene::{Camera, Intrinsics};
use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use std::io::Cursor;
use std::path::Path;
use tempfile::TempDir;

const WIDTH: u32 = 24;
const HEIGHT: u32 = 16;

/// Five cameras in general position.
fn cameras() -> Vec<Camera> {
    let intrinsics = Intrinsics { fx: 21.5, fy: 20.25, cx: 11.75, cy: 8.5 };
    (0..5)
        .map(|i| {
            let t = f64::from(i);
            let rotation = DQuat::from_euler(EulerRot::XYZ, 0.3 + 0.9 * t, 1.1 - 0.7 * t, 2.3 * t);
            let c2w = DMat4::from_rotation_translation(rotation, DVec3::new(t, 0.5 * t * t, -2. * t));
            Camera { intrinsics, c2w, width: WIDTH, height: HEIGHT }
        })
        .collect()
}

fn names() -> Vec<String> {
    (0..5).map(|i| format!("{i:03}.png")).collect()
}

fn in_images(names: &[String]) -> Vec<String> {
    names.iter().map(|name| format!("images/{name}")).collect()
}

/// Pixels that differ from view to view.
fn write_photos(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for (i, name) in names().iter().enumerate() {
        let photo = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb([x as u8 * 9, y as u8 * 12, 40 * i as u8]));
        photo.save(folder.join(name)).unwrap();
    }
}

/// A `cameras.json` capture of [`cameras`].
fn original() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_photos(&folder.path().join("images"));
    write_cameras_json(&folder.path().join("cameras.json"), &in_images(&names()), &cameras()).unwrap();
    folder
}

fn assert_same_cameras(found: &Capture, expected: &[Camera]) {
    assert_eq!(found.len(), expected.len());
    for (a, b) in found.cameras().iter().zip(expected) {
        assert_eq!((a.width, a.height), (b.width, b.height));
        let (k, l) = (a.intrinsics.to_rows(), b.intrinsics.to_rows());
        assert!(k.iter().zip(l).all(|(a, b)| (a - b).abs() < 1e-9), "{k:?} {l:?}");
        assert!(a.c2w.abs_diff_eq(b.c2w, 1e-9), "{} {}", a.c2w, b.c2w);
    }
}

#[test]
fn every_format_opens_to_the_same_capture() {
    for format in [Format::Transforms, Format::ColmapText, Format::ColmapBinary] {
        let folder = original();
        let expected = open_capture(folder.path()).unwrap().load_all(None).unwrap();
        rewrite(folder.path(), format);
        // What other tools leave there.
        std::fs::write(folder.path().join("point_cloud.ply"), b"ply").unwrap();
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert!(capture.names().is_sorted(), "{format:?}");
        for (a, b) in capture.load_all(None).unwrap().iter().zip(&expected) {
            assert!(a.image.equal(&b.image), "{format:?}: {}", a.name);
        }
        assert_eq!(capture.name, folder.path().file_name().unwrap().to_str().unwrap());
    }
}

#[test]
fn the_first_of_several_formats_is_chosen() {
    let folder = original();
    let path = folder.path();
    let model = path.join("sparse/0");
    let file = |name: &str| path.join(name);
    std::fs::write(file("transforms.json"), transforms(&in_images(&names()), &cameras()).to_string())
        .unwrap();
    write_colmap_text(&model, &names(), &cameras(), &pinhole(&cameras()[0]));
    write_colmap_binary(&model, &names(), &cameras());
    for chosen in ["cameras.json", "transforms.json", "sparse/0/images.bin", "sparse/0/images.txt"] {
        assert_eq!(open_capture(path).unwrap().file(), file(chosen));
        std::fs::remove_file(file(chosen)).unwrap();
    }
    let error = open_capture(path).unwrap_err().to_string();
    assert!(error.contains("of no known format") && error.contains("COLMAP"), "{error}");
}

#[test]
fn colmap_models_are_found_where_tools_put_them() {
    let places = [
        ("sparse/0", "images", ""),
        ("sparse", "images", ""),
        ("dense/0/sparse", "dense/0/images", ""),
        ("dense/sparse", "dense/images", ""),
        ("", "images", ""),
        ("sparse/0", "images", "sparse/0"),
        ("sparse", "images", "sparse"),
    ];
    for (place, photos, opened) in places {
        for binary in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            write_photos(&folder.path().join(photos));
            let model = folder.path().join(place);
            match binary {
                true => write_colmap_binary(&model, &names(), &cameras()),
                false => write_colmap_text(&model, &names(), &cameras(), &pinhole(&cameras()[0])),
            }
            let capture = open_capture(&folder.path().join(opened)).unwrap();
            assert_same_cameras(&capture, &cameras());
            assert_eq!(capture.load(&[4], None).unwrap()[0].name, "004.png");
        }
    }
}

#[test]
fn captures_of_all_formats_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let formats = [None, Some(Format::Transforms), Some(Format::ColmapText), Some(Format::ColmapBinary)];
    for (i, format) in formats.into_iter().enumerate() {
        let place = folder.path().join(if i % 2 == 0 { format!("{i}") } else { format!("below/{i}") });
        write_photos(&place.join("images"));
        write_cameras_json(&place.join("cameras.json"), &in_images(&names()), &cameras()).unwrap();
        format.into_iter().for_each(|format| rewrite(&place, format));
    }
    let found: Vec<String> = find_captures(folder.path()).unwrap().into_iter().map(|c| c.name).collect();
    assert_eq!(found, ["0", "2", "1", "3"]);
}

/// Opens `transforms.json` with [`cameras`] and `change`s, beside the photos.
fn changed_transforms(change: impl FnOnce(&mut Value)) -> Capture {
    let folder = original();
    let mut contents = transforms(&in_images(&names()), &cameras());
    change(&mut contents);
    let file = folder.path().join("transforms.json");
    std::fs::write(&file, contents.to_string()).unwrap();
    open_capture(&file).unwrap()
}

fn remove(value: &mut Value, keys: &[&str]) {
    for key in keys {
        value.as_object_mut().unwrap().remove(*key).expect("a key that was there");
    }
}

#[test]
fn lenses_of_transforms_may_be_told_in_many_ways() {
    let with = |change: fn(&mut Intrinsics)| {
        let mut all = cameras();
        all.iter_mut().for_each(|camera| change(&mut camera.intrinsics));
        all
    };
    // By angles of view.
    let capture = changed_transforms(|t| {
        remove(t, &["fl_x", "fl_y"]);
        t["camera_angle_x"] = json!(2. * (12f64 / 21.5).atan());
        t["camera_angle_y"] = json!(2. * (8f64 / 20.25).atan());
    });
    assert_same_cameras(&capture, &cameras());
    // By one of them, without a principal point or a size, and with the names of NeRF's synthetic scenes.
    let capture = changed_transforms(|t| {
        remove(t, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        t["camera_angle_x"] = json!(2. * (12f64 / 30.).atan());
        for (i, frame) in t["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["file_path"] = json!(format!("./images/{i:03}"));
        }
    });
    assert_same_cameras(&capture, &with(|k| *k = Intrinsics { fx: 30., fy: 30., cx: 12., cy: 8. }));
    // A frame's own fields come before the shared ones, focal lengths before angles.
    let capture = changed_transforms(|t| {
        t["camera_angle_x"] = json!(1.);
        remove(t, &["fl_y"]);
        t["frames"][2]["fl_x"] = json!(33.);
        t["frames"][2]["cx"] = json!(10.);
    });
    let mut expected = with(|k| k.fy = 21.5);
    expected[2].intrinsics = Intrinsics { fx: 33., fy: 33., cx: 10., cy: 8.5 };
    assert_same_cameras(&capture, &expected);
}

#[test]
fn frames_of_transforms_are_sorted_and_may_lack_their_photo() {
    let capture = changed_transforms(|t| {
        let frames = t["frames"].as_array_mut().unwrap();
        frames.reverse();
        frames[2]["file_path"] = json!("images/weeded_out.png");
    });
    let mut expected = cameras();
    expected.remove(2);
    assert_same_cameras(&capture, &expected);
    assert_eq!(
        capture.names().collect::<Vec<_>>(),
        in_images(&["000", "001", "003", "004"].map(|n| format!("{n}.png")))
    );
}

#[test]
fn rounded_poses_become_rigid() {
    let capture = changed_transforms(|t| {
        for value in t["frames"][1]["transform_matrix"].as_array_mut().unwrap() {
            for entry in value.as_array_mut().unwrap() {
                *entry = json!((entry.as_f64().unwrap() * 1e3).round() / 1e3);
            }
        }
    });
    let (found, exact) = (capture.cameras()[1].c2w, cameras()[1].c2w);
    assert!(!found.abs_diff_eq(exact, 1e-5) && found.abs_diff_eq(exact, 2e-3));
    let rotation = DMat3::from_mat4(found);
    assert!((rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, 1e-14));
    assert!((rotation.determinant() - 1.).abs() < 1e-14);
}

/// Where the ray (x, y, 1) is seen, in the words of OpenCV's documentation.
fn distort([k1, k2, p1, p2]: [f64; 4], x: f64, y: f64) -> (f64, f64) {
    let r2 = x.powi(2) + y.powi(2);
    let radial = 1. + k1 * r2 + k2 * r2.powi(2);
    (
        x * radial + 2. * p1 * x * y + p2 * (r2 + 2. * x.powi(2)),
        y * radial + p1 * (r2 + 2. * y.powi(2)) + 2. * p2 * x * y,
    )
}

/// The ray that is seen at (u, v), by going back what it was moved.
fn undistort(lens: [f64; 4], u: f64, v: f64) -> (f64, f64) {
    let (mut x, mut y) = (u, v);
    for _ in 0..200 {
        let (du, dv) = distort(lens, x, y);
        (x, y) = (x + u - du, y + v - dv);
    }
    let (du, dv) = distort(lens, x, y);
    assert!((du - u).abs() < 1e-12 && (dv - v).abs() < 1e-12);
    (x, y)
}

/// What is seen along the ray (x, y, 1).
fn scene(x: f64, y: f64) -> [f64; 3] {
    let wave = |t: f64| 127.5 + 120. * t.sin();
    [wave(6. * x + 2. * y), wave(7. * y - x), wave(4. * x - 5. * y)]
}

#[test]
fn distortion_is_removed_from_the_photos() {
    let (width, height) = (160, 120);
    let k = Intrinsics { fx: 110., fy: 115., cx: 83., cy: 58. };
    let lens @ [k1, k2, p1, p2] = [-0.15, 0.04, 0.01, -0.02];
    let camera = Camera { intrinsics: k, c2w: DMat4::IDENTITY, width, height };
    let cameras = [camera, Camera { c2w: DMat4::from_translation(DVec3::X), ..camera }];
    let ray = |x: u32, y: u32| ((f64::from(x) + 0.5 - k.cx) / k.fx, (f64::from(y) + 0.5 - k.cy) / k.fy);
    let picture = |through: &dyn Fn(f64, f64) -> (f64, f64)| {
        RgbImage::from_fn(width, height, |x, y| {
            let (x, y) = ray(x, y);
            let (x, y) = through(x, y);
            Rgb(scene(x, y).map(|value| value.round() as u8))
        })
    };
    let (seen, pinhole) = (picture(&|x, y| undistort(lens, x, y)), picture(&|x, y| (x, y)));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::create_dir(path.join("images")).unwrap();
    let names = ["a.png".to_string(), "b.png".to_string()];
    names.iter().for_each(|name| seen.save(path.join("images").join(name)).unwrap());
    let opencv = format!("OPENCV {} {} {} {} {k1} {k2} {p1} {p2}", k.fx, k.fy, k.cx, k.cy);
    let mut contents = transforms(&in_images(&names), &cameras);
    for (key, value) in ["k1", "k2", "p1", "p2"].iter().zip(lens) {
        contents[*key] = json!(value);
    }
    write_colmap_text(&path.join("colmap/sparse/0"), &names, &cameras, &opencv);
    std::os::unix::fs::symlink(path.join("images"), path.join("colmap/images")).unwrap();
    std::fs::write(path.join("transforms.json"), contents.to_string()).unwrap();
    let (seen, pinhole) = (tensor_from_rgb(&seen), tensor_from_rgb(&pinhole));
    assert!(largest_error(&seen, &pinhole) > 0.2, "a lens that shows");
    for capture in [open_capture(path).unwrap(), open_capture(&path.join("colmap")).unwrap()] {
        assert_same_cameras(&capture, &cameras);
        let found = &capture.load(&[1], None).unwrap()[0].image;
        // Where the photo shows what the pinhole camera sees.
        let mut checked = 0;
        for y in 0..height {
            for x in 0..width {
                let (u, v) = ray(x, y);
                let (u, v) = distort(lens, u, v);
                let (u, v) = (u * k.fx + k.cx, v * k.fy + k.cy);
                if u < 0.5 || v < 0.5 || u > f64::from(width) - 0.5 || v > f64::from(height) - 0.5 {
                    continue;
                }
                checked += 1;
                for c in 0..3 {
                    let at = |t: &tch::Tensor| t.double_value(&[c, i64::from(y), i64::from(x)]) * 255.;
                    // Rounded twice, and interpolated linearly over a pixel.
                    assert!(
                        (at(found) - at(&pinhole)).abs() <= 2.,
                        "({x}, {y}): {} {}",
                        at(found),
                        at(&pinhole)
                    );
                }
            }
        }
        assert!(checked > 9 * width * height / 10, "{checked} pixels");
    }
}

#[test]
fn colmaps_camera_models_mean_what_they_say() {
    let folder = original();
    let path = folder.path();
    let open = |lens: &str| {
        write_colmap_text(&path.join("sparse/0"), &names(), &cameras(), lens);
        open_capture(path).unwrap()
    };
    std::fs::remove_file(path.join("cameras.json")).unwrap();
    let with = |fy: f64| {
        let mut all = cameras();
        all.iter_mut().for_each(|camera| camera.intrinsics.fy = fy);
        all
    };
    let pixels = |capture: &Capture| capture.load(&[0], None).unwrap().remove(0).image;
    let plain = open("SIMPLE_PINHOLE 21.5 11.75 8.5");
    assert_same_cameras(&plain, &with(21.5));
    assert_same_cameras(&open("PINHOLE 21.5 20.25 11.75 8.5"), &with(20.25));
    let simple = open("SIMPLE_RADIAL 21.5 11.75 8.5 0.2");
    assert_same_cameras(&simple, &with(21.5));
    assert!(!pixels(&simple).equal(&pixels(&plain)));
    let radial = |k1: f64, k2: f64| open(&format!("RADIAL 21.5 11.75 8.5 {k1} {k2}"));
    assert!(pixels(&radial(0.2, 0.)).equal(&pixels(&simple)));
    let both = radial(0.2, 0.3);
    let opencv = open("OPENCV 21.5 21.5 11.75 8.5 0.2 0.3 0 0");
    assert_same_cameras(&both, &with(21.5));
    assert!(pixels(&both).equal(&pixels(&opencv)) && !pixels(&both).equal(&pixels(&simple)));
}

#[test]
fn a_real_capture_with_a_lens_opens() {
    let Some(fox) = fox() else { return };
    let capture = open_capture(&fox).unwrap();
    assert_eq!((capture.name.as_str(), capture.len()), ("fox", 50));
    let cameras = capture.cameras();
    for camera in &cameras {
        assert_eq!((camera.width, camera.height), (1080, 1920));
        assert_eq!(camera.intrinsics, Intrinsics { fx: 1375.52, fy: 1374.49, cx: 554.558, cy: 965.268 });
        let rotation = DMat3::from_mat4(camera.c2w);
        assert!((rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, 1e-12));
    }
    // All look at the fox: the point nearest to all optical axes, Σ(I − zzᵀ)(p − c) = 0, is in the middle of every photo.
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for camera in &cameras {
        let (z, c) = (camera.c2w.z_axis.truncate(), camera.c2w.w_axis.truncate());
        let across = DMat3::IDENTITY - DMat3::from_cols(z * z.x, z * z.y, z * z.z);
        (a, b) = (a + across, b + across * c);
    }
    let middle = a.inverse() * b;
    for camera in &cameras {
        let p = camera.c2w.inverse().transform_point3(middle);
        assert!(p.z > 1. && (p.x / p.z).abs() < 0.4 && (p.y / p.z).abs() < 0.7, "{p}");
        // Held upright: the world's up, z, is up in the photo.
        assert!(camera.c2w.y_axis.z < -0.5, "{}", camera.c2w);
    }
    let stored = tensor_from_rgb(&read_image(&fox.join("images/0001.jpg")).unwrap());
    let view = &capture.load(&[0], None).unwrap()[0];
    let moved = (&view.image - &stored).abs().mean(None).double_value(&[]);
    assert_eq!(view.image.size(), [3, 1920, 1080]);
    assert!(moved > 0.002 && moved < 0.1, "the lens moves pixels a little: {moved}");
}

/// A JPEG whose EXIF says that it is stored in `orientation`.
fn jpeg_with_orientation(photo: &RgbImage, orientation: u8) -> Vec<u8> {
    let mut jpeg = Cursor::new(vec![]);
    photo.write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    let mut segment = vec![0xff, 0xe1];
    segment.extend((exif.len() as u16 + 2).to_be_bytes());
    segment.extend(exif);
    let mut bytes = jpeg.into_inner();
    bytes.splice(2..2, segment);
    bytes
}

/// The first view of a capture whose photos are all `bytes`, declared to be `width` × `height`.
fn load_photo(
    bytes: &[u8],
    extension: &str,
    width: u32,
    height: u32,
) -> globalsplat::error::Result<tch::Tensor> {
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..5).map(|i| format!("{i}.{extension}")).collect();
    names.iter().for_each(|name| std::fs::write(folder.path().join(name), bytes).unwrap());
    let cameras = cameras().into_iter().map(|camera| Camera { width, height, ..camera }).collect::<Vec<_>>();
    let file = folder.path().join("transforms.json");
    std::fs::write(&file, transforms(&names, &cameras).to_string()).unwrap();
    Ok(open_capture(&file)?.load(&[0], None)?.remove(0).image)
}

#[test]
fn photos_on_their_side_are_turned_where_the_capture_means_them_so() {
    let photo = RgbImage::from_fn(24, 16, |x, y| Rgb([x as u8 * 10, y as u8 * 15, 90]));
    let stored = tensor_from_rgb(&{
        let bytes = jpeg_with_orientation(&photo, 1);
        image::load_from_memory(&bytes).unwrap().to_rgb8()
    });
    let load = |orientation: u8, width, height| {
        load_photo(&jpeg_with_orientation(&photo, orientation), "jpg", width, height)
    };
    // 6: the stored top row is the right column; 8: the left one; 5 mirrors across the diagonal.
    assert!(load(6, 16, 24).unwrap().equal(&stored.transpose(1, 2).flip([2])));
    assert!(load(8, 16, 24).unwrap().equal(&stored.transpose(1, 2).flip([1])));
    assert!(load(5, 16, 24).unwrap().equal(&stored.transpose(1, 2)));
    // Declared as stored: whoever made the capture didn't turn it, nor upside down.
    for orientation in [1, 3, 6, 8] {
        assert!(load(orientation, 24, 16).unwrap().equal(&stored), "{orientation}");
    }
    for (orientation, width, height) in [(1, 16, 24), (3, 16, 24), (6, 20, 24)] {
        let error = load(orientation, width, height).unwrap_err().to_string();
        assert!(error.contains("24×16 pixels") && error.contains(&format!("{width}×{height}")), "{error}");
    }
}

#[test]
fn photos_of_every_kind_load() {
    let at = |x: u32, y: u32| (x * 10 + y) as u8;
    let grey = GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([at(x, y)]));
    let alpha = |y: u32| [0, 255, 128][y as usize % 3];
    let grey_alpha = image::GrayAlphaImage::from_fn(WIDTH, HEIGHT, |x, y| image::LumaA([at(x, y), alpha(y)]));
    let rgba = image::RgbaImage::from_fn(WIDTH, HEIGHT, |x, y| image::Rgba([at(x, y), 200, 30, alpha(y)]));
    let deep = image::ImageBuffer::<Rgb<u16>, _>::from_fn(WIDTH, HEIGHT, |x, y| {
        Rgb([u16::from(at(x, y)) * 257 + 100, 65_535, 257 * 30 - 100])
    });
    let deep_grey =
        image::ImageBuffer::<Luma<u16>, _>::from_fn(WIDTH, HEIGHT, |x, y| Luma([u16::from(at(x, y)) * 257]));
    let over_black = |value: u8, y: u32| (f64::from(value) * f64::from(alpha(y)) / 255.).round() as u8;
    let expect = |of: &dyn Fn(u32, u32) -> [u8; 3]| {
        tensor_from_rgb(&RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb(of(x, y))))
    };
    let repeated = expect(&|x, y| [at(x, y); 3]);
    let kinds: [(DynamicImage, tch::Tensor); 5] = [
        (grey.clone().into(), repeated.shallow_clone()),
        (grey_alpha.into(), expect(&|x, y| [over_black(at(x, y), y); 3])),
        (rgba.into(), expect(&|x, y| [at(x, y), 200, 30].map(|value| over_black(value, y)))),
        (deep.into(), expect(&|x, y| [at(x, y), 255, 30])),
        (deep_grey.into(), repeated.shallow_clone()),
    ];
    for (photo, expected) in kinds {
        let mut png = Cursor::new(vec![]);
        photo.write_to(&mut png, ImageFormat::Png).unwrap();
        let found = load_photo(png.get_ref(), "png", WIDTH, HEIGHT).unwrap();
        assert!(found.equal(&expected), "{:?} is {} off", photo.color(), largest_error(&found, &expected));
    }
    let mut jpeg = Cursor::new(vec![]);
    grey.write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
    let found = load_photo(jpeg.get_ref(), "jpeg", WIDTH, HEIGHT).unwrap();
    assert!(largest_error(&found, &repeated) < 0.05 && found.select(0, 0).equal(&found.select(0, 2)));
}
