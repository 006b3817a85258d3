//! The formats captures come in: the same cameras and pixels from each.

mod common;

use common::formats::{
    Format, HEIGHT, WIDTH, assert_same_cameras, cameras, in_images, names, pinhole, rewrite, transforms,
    write_colmap_binary, write_colmap_text,
};
use common::fox;
use glam::{DMat3, DVec3};
use globalsplat::data::{Capture, find_captures, open_capture, write_cameras_json};
use globalsplat::io::{read_image, tensor_from_rgb};
use globalsplat::scene::Intrinsics;
use image::{Rgb, RgbImage};
use serde_json::{Value, json};
use std::path::Path;
use tempfile::TempDir;

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

#[test]
fn views_and_captures_come_in_the_order_of_their_numbers() {
    let names: Vec<String> = (1..=12).map(|i| format!("r_{i}.png")).collect();
    let shuffled: Vec<&String> = [6, 1, 9, 0, 11, 4, 2, 10, 8, 3, 7, 5].map(|i| &names[i]).to_vec();
    let poses: Vec<_> = cameras().into_iter().cycle().take(names.len()).collect();
    let above = tempfile::tempdir().unwrap();
    for (i, format) in [None, Some(Format::Transforms), Some(Format::ColmapText), Some(Format::ColmapBinary)]
        .iter()
        .enumerate()
    {
        let folder = above.path().join(format!("scene_{}", 8 + i));
        std::fs::create_dir_all(folder.join("images")).unwrap();
        for name in &names {
            RgbImage::new(WIDTH, HEIGHT).save(folder.join("images").join(name)).unwrap();
        }
        let images: Vec<String> = shuffled.iter().map(|name| format!("images/{name}")).collect();
        write_cameras_json(&folder.join("cameras.json"), &images, &poses).unwrap();
        format.iter().for_each(|&format| rewrite(&folder, format));
        let found: Vec<String> =
            open_capture(&folder).unwrap().names().map(|name| name.replace("images/", "")).collect();
        match format {
            // The author's own order.
            None => assert!(found.iter().eq(shuffled.iter().copied()), "{found:?}"),
            Some(format) => assert_eq!(found, names, "{format:?}"),
        }
    }
    let captures: Vec<String> = find_captures(above.path()).unwrap().into_iter().map(|c| c.name).collect();
    assert_eq!(captures, ["scene_8", "scene_9", "scene_10", "scene_11"]);
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
