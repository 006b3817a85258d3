//! Capture formats: each gives the same cameras and pixels.

use glam::{DMat3, DMat4, DQuat, DVec3};
use globalsplat_capture::{
    Camera, Capture, Holdout, Intrinsics, find_captures, open_capture, read_image, write_cameras_json,
};
use globalsplat_test_kit::formats::{
    Format, HEIGHT, WIDTH, assert_same_cameras, cameras, in_images, names, pinhole, rewrite, transforms,
    write_colmap_binary, write_colmap_text,
};
use globalsplat_test_kit::fox;
use image::{Rgb, RgbImage};
use serde_json::{Value, json};
use std::path::Path;
use tempfile::TempDir;

/// Writes photos whose pixels differ from view to view.
fn write_photos(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for (i, name) in names().iter().enumerate() {
        let photo = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb([x as u8 * 9, y as u8 * 12, 40 * i as u8]));
        photo.save(folder.join(name)).unwrap();
    }
}

/// Returns a `cameras.json` capture of [`cameras`].
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
        // A file that other tools leave there.
        std::fs::write(folder.path().join("point_cloud.ply"), b"ply").unwrap();
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert!(capture.names().is_sorted(), "{format:?}");
        for (a, b) in capture.load_all(None).unwrap().iter().zip(&expected) {
            assert!(a.image == b.image, "{format:?}: {}", a.name);
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
    let found: Vec<String> =
        find_captures(folder.path()).unwrap().captures.into_iter().map(|c| c.name).collect();
    assert_eq!(found, ["0", "2", "1", "3"]);
}

#[test]
fn views_and_captures_are_in_numeric_order() {
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
            // The order of the file.
            None => assert!(found.iter().eq(shuffled.iter().copied()), "{found:?}"),
            Some(format) => assert_eq!(found, names, "{format:?}"),
        }
    }
    let captures: Vec<String> =
        find_captures(above.path()).unwrap().captures.into_iter().map(|c| c.name).collect();
    assert_eq!(captures, ["scene_8", "scene_9", "scene_10", "scene_11"]);
}

/// Opens a `transforms.json` with [`cameras`] and `change`s, beside the photos.
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
fn transforms_specify_intrinsics_in_several_ways() {
    let with = |change: fn(&mut Intrinsics)| {
        let mut all = cameras();
        all.iter_mut().for_each(|camera| change(&mut camera.intrinsics));
        all
    };
    // Focal lengths from the angles of view.
    let capture = changed_transforms(|t| {
        remove(t, &["fl_x", "fl_y"]);
        t["camera_angle_x"] = json!(2. * (12f64 / 21.5).atan());
        t["camera_angle_y"] = json!(2. * (8f64 / 20.25).atan());
    });
    assert_same_cameras(&capture, &cameras());
    // One angle of view, no principal point or size, and the names of NeRF's synthetic scenes.
    let capture = changed_transforms(|t| {
        remove(t, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        t["camera_angle_x"] = json!(2. * (12f64 / 30.).atan());
        for (i, frame) in t["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["file_path"] = json!(format!("./images/{i:03}"));
        }
    });
    assert_same_cameras(&capture, &with(|k| *k = Intrinsics { fx: 30., fy: 30., cx: 12., cy: 8. }));
    // A frame's own fields override the shared ones, focal lengths override angles.
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
fn parameters_of_colmap_camera_models_are_read() {
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
    assert_ne!(pixels(&simple), pixels(&plain));
    let radial = |k1: f64, k2: f64| open(&format!("RADIAL 21.5 11.75 8.5 {k1} {k2}"));
    assert_eq!(pixels(&radial(0.2, 0.)), pixels(&simple));
    let both = radial(0.2, 0.3);
    let opencv = open("OPENCV 21.5 21.5 11.75 8.5 0.2 0.3 0 0");
    assert_same_cameras(&both, &with(21.5));
    assert_eq!(pixels(&both), pixels(&opencv));
    assert_ne!(pixels(&both), pixels(&simple));
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
    // All cameras look at the fox: the point nearest to all optical axes, Σ(I − zzᵀ)(p − c) = 0, is in the middle of every
    // photo.
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
        // The photos are upright: the world's up, z, is up in the photo.
        assert!(camera.c2w.y_axis.z < -0.5, "{}", camera.c2w);
    }
    let stored = read_image(&fox.join("images/0001.jpg")).unwrap();
    let view = &capture.load(&[0], None).unwrap()[0];
    assert_eq!(view.image.size(), (1920, 1080));
    let levels = view.image.to_rgb().into_raw().into_iter().zip(stored.into_raw());
    let moved = levels.map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / (3. * 1920. * 1080. * 255.);
    assert!(moved > 0.002 && moved < 0.1, "the lens moves pixels a little: {moved}");
}

/// Returns a folder with the photos of [`names`] in `images` and no description of them.
fn photos_alone() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_photos(&folder.path().join("images"));
    folder
}

fn write_transforms(folder: &Path, change: impl FnOnce(&mut Value)) {
    let mut contents = transforms(&in_images(&names()), &cameras());
    change(&mut contents);
    std::fs::write(folder.join("transforms.json"), contents.to_string()).unwrap();
}

/// Asserts that `capture` has exactly one warning, of one line, and that it contains all of `parts`.
#[track_caller]
fn assert_warns(capture: &Capture, parts: &[&str]) {
    let [line] = capture.warnings() else { panic!("{:?}", capture.warnings()) };
    parts.iter().for_each(|part| assert!(line.contains(part), "{part:?} is not in: {line}"));
    assert!(!line.contains('\n'), "{line}");
}

#[test]
fn missing_photos_are_left_out_with_a_warning() {
    for format in [None, Some(Format::Transforms), Some(Format::ColmapText), Some(Format::ColmapBinary)] {
        let folder = original();
        format.into_iter().for_each(|format| rewrite(folder.path(), format));
        assert!(open_capture(folder.path()).unwrap().warnings().is_empty());
        std::fs::remove_file(folder.path().join("images/002.png")).unwrap();
        let capture = open_capture(folder.path()).unwrap();
        let mut expected = cameras();
        expected.remove(2);
        assert_same_cameras(&capture, &expected);
        assert!(!capture.is_complete());
        assert_warns(&capture, &["1 of 5 photos are missing", "left out", "002.png"]);
        for name in ["000", "001", "003"] {
            std::fs::remove_file(folder.path().join(format!("images/{name}.png"))).unwrap();
        }
        let error = open_capture(folder.path()).unwrap_err().to_string();
        assert!(error.contains("the number of frames with an image is 1 of 5"), "{format:?}: {error}");
        assert!(error.contains("is missing, expected two or more"), "{error}");
    }
}

#[test]
fn the_first_format_that_can_be_read_is_taken() {
    let folder = photos_alone();
    // File that 3DGS writes beside its splats.
    let foreign = r#"[{"id": 0, "img_name": "000", "width": 24, "height": 16, "position": [0, 0, 0]}]"#;
    std::fs::write(folder.path().join("cameras.json"), foreign).unwrap();
    let error = open_capture(folder.path()).unwrap_err().to_string();
    assert!(error.contains("cameras.json: the file is not a description of cameras"), "{error}");
    write_colmap_text(&folder.path().join("sparse/0"), &names(), &cameras(), &pinhole(&cameras()[0]));
    let capture = open_capture(folder.path()).unwrap();
    assert_same_cameras(&capture, &cameras());
    assert_warns(
        &capture,
        &["cameras.json: the file is not a description", "sparse/0/images.txt is read instead"],
    );
    std::fs::write(folder.path().join("sparse/0/cameras.txt"), "nonsense").unwrap();
    let error = open_capture(folder.path()).unwrap_err();
    assert!(error.is_invalid_request());
    for part in
        ["none of its formats can be read", "cameras.json: the file", "cameras.txt: CAMERA_ID in line 1"]
    {
        assert!(error.to_string().contains(part), "{part:?} is not in: {error}");
    }
}

#[test]
fn the_error_for_an_unknown_folder_lists_the_formats() {
    let error = open_capture(photos_alone().path()).unwrap_err().to_string();
    for part in ["no known format", "cameras.json", "transforms_train.json", "sparse/0", "CHUNK.torch#KEY"] {
        assert!(error.contains(part), "{part:?} is not in: {error}");
    }
}

#[test]
fn per_frame_intrinsics_override_shared_ones() {
    let angle = 2. * (12f64 / 30.).atan();
    let folder = photos_alone();
    write_transforms(folder.path(), |_| ());
    let undistorted = open_capture(folder.path()).unwrap().load(&[0, 1], None).unwrap();
    write_transforms(folder.path(), |t| {
        for frame in t["frames"].as_array_mut().unwrap() {
            frame["camera_angle_x"] = json!(angle);
        }
        t["frames"][3]["camera_angle_y"] = json!(2. * (8f64 / 25.).atan());
        t["frames"][4]["fl_x"] = json!(40.);
        t["k1"] = json!(-0.2);
        t["frames"][1]["k2"] = json!(0.);
    });
    let capture = open_capture(folder.path()).unwrap();
    let mut expected = cameras();
    let focal = [[30., 30.], [30., 30.], [30., 30.], [30., 25.], [40., 40.]];
    for (camera, [fx, fy]) in expected.iter_mut().zip(focal) {
        camera.intrinsics = Intrinsics { fx, fy, ..camera.intrinsics };
    }
    assert_same_cameras(&capture, &expected);
    // The second frame has its own coefficients, all 0.
    let views = capture.load(&[0, 1], None).unwrap();
    assert!(views[0].image != undistorted[0].image && views[1].image == undistorted[1].image);
}

#[test]
fn of_several_models_the_largest_is_taken() {
    for (small, large) in [
        ("sparse/0", "sparse/1"),
        ("sparse/2", "sparse/10"),
        ("sparse", "sparse/1"),
        ("sparse/0", "colmap/sparse/3"),
    ] {
        let folder = photos_alone();
        write_colmap_text(&folder.path().join(large), &names(), &cameras(), &pinhole(&cameras()[0]));
        write_colmap_binary(&folder.path().join(small), &names()[..2], &cameras()[..2]);
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert_warns(
            &capture,
            &["the largest of 2 models is taken, with 5 photos", &format!("{small} (2 photos)")],
        );
    }
    // The path `sparse` itself opens the same capture.
    let folder = photos_alone();
    for (model, count) in [("sparse/0", 2), ("sparse/1", 5), ("sparse/2", 5)] {
        write_colmap_binary(&folder.path().join(model), &names()[..count], &cameras()[..count]);
    }
    let capture = open_capture(&folder.path().join("sparse")).unwrap();
    assert!(capture.len() == 5 && capture.file().ends_with("sparse/1/images.bin"));
}

#[test]
fn a_model_and_its_photos_may_lie_in_one_folder() {
    for binary in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        write_photos(folder.path());
        match binary {
            true => write_colmap_binary(folder.path(), &names(), &cameras()),
            false => write_colmap_text(folder.path(), &names(), &cameras(), &pinhole(&cameras()[0])),
        }
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert!(capture.warnings().is_empty() && capture.load_all(None).unwrap().len() == 5);
    }
    // Numbered captures beside each other are captures, not models of one capture.
    let above = tempfile::tempdir().unwrap();
    for i in 0..2 {
        let folder = above.path().join(i.to_string());
        write_photos(&folder);
        write_colmap_binary(&folder, &names(), &cameras());
    }
    assert_eq!(find_captures(above.path()).unwrap().captures.len(), 2);
}

#[test]
fn cameras_are_scaled_to_smaller_and_larger_photos() {
    let photo = |width: u32, height: u32| {
        RgbImage::from_fn(width, height, |x, y| Rgb([(x * 9) as u8, (y * 12) as u8, 7]))
    };
    for format in [Format::Transforms, Format::ColmapText, Format::ColmapBinary] {
        for folder_name in ["images", "images_2", "images_4"] {
            let folder = original();
            rewrite(folder.path(), format);
            std::fs::remove_dir_all(folder.path().join("images")).unwrap();
            let images = folder.path().join(folder_name);
            std::fs::create_dir(&images).unwrap();
            let mut expected = cameras();
            let sizes = [(24, 16), (12, 8), (48, 32), (6, 4), (12, 8)];
            for ((name, camera), (width, height)) in names().iter().zip(&mut expected).zip(sizes) {
                photo(width, height).save(images.join(name)).unwrap();
                let factor = f64::from(width) / 24.;
                let intrinsics = camera.intrinsics.resized(factor, factor);
                *camera = globalsplat_capture::Camera { width, height, intrinsics, ..*camera };
            }
            let capture = open_capture(folder.path()).unwrap();
            assert_same_cameras(&capture, &expected);
            assert_warns(&capture, &["4 of 5 photos", "12×8 pixels in place of 24×16", "scaled", "001.png"]);
            assert_eq!(capture.load(&[3], None).unwrap()[0].image.size(), (4, 6));
        }
    }
    // A photo of another aspect ratio is refused, by its name.
    let folder = original();
    rewrite(folder.path(), Format::ColmapText);
    photo(12, 12).save(folder.path().join("images/001.png")).unwrap();
    let error = open_capture(folder.path()).unwrap().load_all(None).unwrap_err().to_string();
    assert!(error.contains("001.png") && error.contains("12×12 pixels"), "{error}");
}

#[test]
fn names_are_found_however_they_are_written() {
    let folder = photos_alone();
    let write = |name: &dyn Fn(usize, &str) -> String| {
        write_transforms(folder.path(), |t| {
            for (i, frame) in t["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
                frame["file_path"] = json!(name(i, &names()[i]));
            }
        });
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert!(capture.warnings().is_empty(), "{:?}", capture.warnings());
        capture.render_names()
    };
    assert_eq!(
        write(&|i, name| format!("images{}{name}", if i < 2 { '/' } else { '\\' })).last().unwrap(),
        "004"
    );
    write(&|_, name| format!("C:\\Users\\me\\room\\images\\{name}"));
    write(&|_, name| format!("/home/me/room/images/{name}"));
    write(&|_, name| format!("../{}/images/{name}", folder.path().file_name().unwrap().to_str().unwrap()));
    std::fs::remove_file(folder.path().join("transforms.json")).unwrap();
    // Names in COLMAP with subfolders, spaces, parentheses and backslashes.
    for name in ["left\\0 (1).png", "a plan (2)\\b.png"] {
        let all: Vec<String> = (0..5).map(|i| name.replace('.', &format!(" {i}."))).collect();
        for (from, to) in names().iter().zip(&all) {
            let to = folder.path().join("images").join(to.replace('\\', "/"));
            std::fs::create_dir_all(to.parent().unwrap()).unwrap();
            std::fs::copy(folder.path().join("images").join(from), to).unwrap();
        }
        for spelled in [all.clone(), all.iter().map(|name| name.replace('\\', "/")).collect()] {
            write_colmap_text(&folder.path().join("sparse/0"), &spelled, &cameras(), &pinhole(&cameras()[0]));
            assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
        }
    }
}

#[test]
fn the_synthetic_layout_has_views_to_learn_from_and_views_to_hold_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    for (part, count) in [("train", 3), ("test", 2)] {
        write_photos(&path.join(part));
        let images: Vec<String> = (0..count).map(|i| format!("./{part}/{i:03}")).collect();
        let mut contents = transforms(&images, &cameras());
        remove(&mut contents, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        contents["camera_angle_x"] = json!(2. * (12f64 / 30.).atan());
        std::fs::write(path.join(format!("transforms_{part}.json")), contents.to_string()).unwrap();
    }
    let capture = open_capture(path).unwrap();
    assert_eq!((capture.len(), capture.has_test_part()), (5, true));
    assert!(capture.warnings().is_empty(), "{:?}", capture.warnings());
    assert_eq!(capture.split(Holdout::None), (vec![0, 1, 2], vec![3, 4]));
    assert_eq!(capture.split("every:3+1".parse().unwrap()), (vec![0, 2], vec![1]));
    assert_eq!(capture.scored_views(), [3, 4]);
    assert_eq!(capture.names().nth(3), Some("./test/000"));
    // Each file alone is a capture without splits.
    let alone = open_capture(&path.join("transforms_train.json")).unwrap();
    assert_eq!((alone.len(), alone.has_test_part()), (3, false));
    assert_eq!(find_captures(path).unwrap().captures.len(), 1);
    // Without its photos, the test split is missing.
    std::fs::remove_dir_all(path.join("test")).unwrap();
    let capture = open_capture(path).unwrap();
    assert!(!capture.has_test_part());
    assert_warns(&capture, &["transforms_test.json", "2 of 2 photos are missing"]);
}

#[test]
fn nerfstudios_lists_of_filenames_hold_photos_out() {
    let folder = photos_alone();
    let images = in_images(&names());
    let lists = |held_out: Value| {
        write_transforms(folder.path(), |contents| {
            contents["train_filenames"] = json!(images[..2]);
            contents["val_filenames"] = held_out.clone();
        });
    };
    lists(json!([format!("./{}", images[3])]));
    let capture = open_capture(folder.path()).unwrap();
    assert_eq!(capture.split(Holdout::None), (vec![0, 1], vec![2]));
    assert_eq!(capture.names().collect::<Vec<_>>(), [&images[0], &images[1], &images[3]]);
    assert_warns(&capture, &["transforms.json", "2 frames are left out"]);

    lists(json!([1]));
    let error = open_capture(folder.path()).unwrap_err().to_string();
    assert!(error.contains("val_filenames") && error.contains("a list of file_paths"), "{error}");
}

#[test]
fn cameras_of_models_that_are_not_read_do_no_harm_until_they_are_used() {
    let folder = photos_alone();
    let model = folder.path().join("sparse/0");
    write_colmap_text(&model, &names(), &cameras(), &pinhole(&cameras()[0]));
    let cameras_text = std::fs::read_to_string(model.join("cameras.txt")).unwrap();
    for unused in ["8 OPENCV_FISHEYE 24 16 1 1 1 1 0 0 0 0", "9 A_MODEL_TO_COME 0 0 1"] {
        std::fs::write(model.join("cameras.txt"), format!("{unused}\n{cameras_text}")).unwrap();
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
    }
    write_colmap_binary(&model, &names(), &cameras());
    let cameras_bytes = std::fs::read(model.join("cameras.bin")).unwrap();
    for (number, parameters, reason) in
        [(17i32, 2, "twice the height"), (16, 6, "alpha from 0 to 1"), (7, 5, "an angle below π")]
    {
        let camera = |id: u32| {
            let head =
                [&id.to_le_bytes()[..], &number.to_le_bytes(), &24u64.to_le_bytes(), &16u64.to_le_bytes()];
            [head.concat(), 8f64.to_le_bytes().repeat(parameters)].concat()
        };
        let unused = [&2u64.to_le_bytes()[..], &camera(8), &cameras_bytes[8..]].concat();
        std::fs::write(model.join("cameras.bin"), unused).unwrap();
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
        std::fs::write(model.join("cameras.bin"), [&1u64.to_le_bytes()[..], &camera(7)].concat()).unwrap();
        let error = open_capture(folder.path()).unwrap_err().to_string();
        assert!(error.contains("of camera 7 is") && error.contains(reason), "{number}: {error}");
    }
}

/// The model has poses of photos, frames of a rig, and the rig's poses of its cameras, as COLMAP has written them since 3.12.
#[test]
fn a_model_with_a_rig_has_the_poses_of_its_photos() {
    let pose = |[w, x, y, z]: [f64; 4], translation: [f64; 3]| {
        DMat4::from_rotation_translation(DQuat::from_xyzw(x, y, z, w).normalize(), translation.into())
    };
    // As in the model, which pycolmap 4.2.1 wrote.
    let right_from_left = pose([0.9, 0.1, 0.2, -0.3], [0.3, -0.1, 0.2]);
    for form in ["bin", "txt"] {
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("sparse/0");
        std::fs::create_dir_all(&model).unwrap();
        for name in ["cameras", "images", "frames", "rigs"] {
            let name = format!("{name}.{form}");
            let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/rig").join(&name);
            std::fs::copy(data, model.join(name)).unwrap();
        }
        let mut expected = vec![];
        for (side, focal) in [("left", 21.5), ("right", 23.)] {
            std::fs::create_dir_all(folder.path().join("images").join(side)).unwrap();
            for number in 0..3 {
                let photo = folder.path().join(format!("images/{side}/{number}.png"));
                RgbImage::new(WIDTH, HEIGHT).save(photo).unwrap();
                let t = f64::from(number);
                let left_from_world = pose([0.8, 0.3 * t, -0.2, 0.1 * t], [t, 0.5 * t, 1. - t]);
                let w2c = if side == "left" { left_from_world } else { right_from_left * left_from_world };
                let intrinsics = Intrinsics { fx: focal, ..cameras()[0].intrinsics };
                expected.push(Camera { intrinsics, c2w: w2c.inverse(), ..cameras()[0] });
            }
        }
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &expected);
    }
}

#[test]
fn the_scale_is_taken_out_of_rotations_and_said_once() {
    let scaled = |rows: &mut Value, factor: f64| {
        for row in rows.as_array_mut().unwrap().iter_mut().take(3) {
            row.as_array_mut()
                .unwrap()
                .iter_mut()
                .take(3)
                .for_each(|v| *v = json!(v.as_f64().unwrap() * factor));
        }
    };
    for factor in [0.5, 1.002, 1e-4, 300.] {
        let capture = changed_transforms(|t| {
            let frames = t["frames"].as_array_mut().unwrap();
            frames.iter_mut().for_each(|frame| scaled(&mut frame["transform_matrix"], factor));
        });
        assert_same_cameras(&capture, &cameras());
        assert_warns(&capture, &["5 of 5 rotations are scaled", "taken out", "images/000.png", "and 2 more"]);
    }
    let folder = original();
    let file = folder.path().join("cameras.json");
    let mut contents: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    scaled(&mut contents["views"][1]["c2w"], 2.);
    std::fs::write(&file, contents.to_string()).unwrap();
    let capture = open_capture(&file).unwrap();
    assert_same_cameras(&capture, &cameras());
    assert_warns(&capture, &["1 of 5 rotations are scaled, the first by 2.0", "images/001.png"]);
}

#[test]
fn text_is_read_as_every_system_writes_it() {
    let mark = "\u{feff}";
    for format in [None, Some(Format::Transforms), Some(Format::ColmapText)] {
        let folder = original();
        format.into_iter().for_each(|format| rewrite(folder.path(), format));
        let files: &[&str] = match format {
            None => &["cameras.json"],
            Some(Format::Transforms) => &["transforms.json"],
            _ => &["sparse/0/cameras.txt", "sparse/0/images.txt"],
        };
        for file in files.iter().map(|file| folder.path().join(file)) {
            let text = std::fs::read_to_string(&file).unwrap();
            let ending = if file.extension().unwrap() == "txt" { " \t\r\n" } else { "\r\n" };
            let text = mark.to_string() + text.replace('\n', ending).trim_end();
            std::fs::write(&file, text).unwrap();
        }
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
    }
    let folder = original();
    rewrite(folder.path(), Format::ColmapText);
    let file = folder.path().join("sparse/0/cameras.txt");
    let text = std::fs::read_to_string(&file).unwrap().replace("21.5 20.25", "2.15e+001 2025.0e-002");
    std::fs::write(&file, text).unwrap();
    assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
}

#[test]
fn keys_that_other_tools_add_change_nothing() {
    let capture = changed_transforms(|t| {
        t["applied_transform"] = json!([[0., 1., 0., 3.], [1., 0., 0., 0.], [0., 0., -1., 0.]]);
        t["ply_file_path"] = json!("sparse_pc.ply");
        t["camera_model"] = json!("OpenCV");
        t["is_fisheye"] = json!(false);
        t["frames"][0]["colmap_im_id"] = json!(1);
        t["frames"][0]["sharpness"] = json!(30.5);
    });
    assert_same_cameras(&capture, &cameras());
}

#[test]
fn the_rational_lens_is_the_same_in_both_formats() {
    let folder = original();
    let path = folder.path();
    let k = "21.5 20.25 11.75 8.5";
    let pixels = |lens: &str| {
        write_colmap_text(&path.join("sparse/0"), &names(), &cameras(), lens);
        open_capture(path).unwrap().load(&[1], None).unwrap().remove(0).image
    };
    std::fs::remove_file(path.join("cameras.json")).unwrap();
    let plain = pixels(&format!("PINHOLE {k}"));
    assert_eq!(pixels(&format!("FULL_OPENCV {k} 0 0 0 0 0 0 0 0")), plain);
    let polynomial = pixels(&format!("OPENCV {k} 0.2 0.3 0.01 -0.02"));
    assert_eq!(pixels(&format!("FULL_OPENCV {k} 0.2 0.3 0.01 -0.02 0 0 0 0")), polynomial);
    // The ratio (1 + 2r²)/(1 + 2r²) is 1.
    assert_eq!(pixels(&format!("FULL_OPENCV {k} 2 0 0 0 0 2 0 0")), plain);
    let rational = pixels(&format!("FULL_OPENCV {k} 0.2 0.3 0.01 -0.02 0.1 0.4 0.05 0.02"));
    assert_ne!(rational, polynomial);
    write_transforms(path, |t| {
        let keys = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
        for (key, value) in keys.iter().zip([0.2, 0.3, 0.01, -0.02, 0.1, 0.4, 0.05, 0.02]) {
            t[*key] = json!(value);
        }
        t["camera_model"] = json!("FULL_OPENCV");
    });
    let capture = open_capture(path).unwrap();
    assert!(capture.load(&[1], None).unwrap()[0].image == rational);
}

#[test]
fn find_captures_skips_unreadable_and_temporary_folders() {
    use std::os::unix::fs::PermissionsExt;
    let above = tempfile::tempdir().unwrap();
    let place = |name: &str| above.path().join(name);
    for name in ["room", ".room.globalsplat-partial", ".room.globalsplat-old", ".hidden/room"] {
        write_photos(&place(name).join("images"));
        write_cameras_json(&place(name).join("cameras.json"), &in_images(&names()), &cameras()).unwrap();
    }
    let closed = place("closed");
    std::fs::create_dir(&closed).unwrap();
    std::fs::set_permissions(&closed, std::fs::Permissions::from_mode(0o0)).unwrap();
    let found = find_captures(above.path()).unwrap();
    let names: Vec<&str> = found.captures.iter().map(|capture| capture.name.as_str()).collect();
    assert_eq!(names, ["room"]);
    // A user who may read everything, such as root, gets no warning.
    match std::fs::read_dir(&closed) {
        Ok(_) => assert!(found.warnings.is_empty()),
        Err(_) => assert!(found.warnings.len() == 1 && found.warnings[0].contains("closed can't be read")),
    }
    std::fs::set_permissions(&closed, std::fs::Permissions::from_mode(0o755)).unwrap();
}
