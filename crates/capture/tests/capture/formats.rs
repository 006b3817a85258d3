//! Capture formats: each gives the same cameras and pixels.

use crate::{assert_refused, assert_warns, open_transforms, photos_alone, write_photos};
use glam::DMat3;
use globalsplat_capture::{
    Camera, Holdout, Intrinsics, find_captures, list_photos, open_capture, read_camera_path,
    write_cameras_json,
};
use globalsplat_files::InputFiles;
use globalsplat_test_kit::formats::{
    Format, assert_same_cameras, cameras, in_images, names, pinhole, rewrite, transforms,
    write_colmap_binary, write_colmap_text,
};
use globalsplat_test_kit::fox;
use image::RgbImage;
use serde_json::{Value, json};
use std::path::Path;
use tempfile::TempDir;

/// All formats; `None` is `cameras.json`.
const FORMATS: [Option<Format>; 4] =
    [None, Some(Format::Transforms), Some(Format::ColmapText), Some(Format::ColmapBinary)];

/// Writes a capture of [`cameras`] to `folder`.
fn write_capture(folder: &Path, format: Option<Format>) {
    write_photos(&folder.join("images"), &names());
    write_cameras_json(&folder.join("cameras.json"), &in_images(&names()), &cameras()).unwrap();
    format.into_iter().for_each(|format| rewrite(folder, format));
}

fn capture_in(format: Option<Format>) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_capture(folder.path(), format);
    folder
}

/// Writes a COLMAP model of the first `count` of [`cameras`].
fn write_model(model: &Path, is_binary: bool, count: usize) {
    match is_binary {
        true => write_colmap_binary(model, &names()[..count], &cameras()[..count]),
        false => write_colmap_text(model, &names()[..count], &cameras()[..count], &pinhole(&cameras()[0])),
    }
}

fn names_of_captures(folder: &Path) -> Vec<String> {
    find_captures(folder).unwrap().paths.iter().map(|path| open_capture(path).unwrap().name).collect()
}

#[test]
fn every_format_opens_to_the_same_capture() {
    let expected = open_capture(capture_in(None).path()).unwrap().load_all(None).unwrap();
    for format in FORMATS {
        let folder = capture_in(format);
        // A file that other tools leave there.
        std::fs::write(folder.path().join("point_cloud.ply"), b"ply").unwrap();
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        for (a, b) in capture.load_all(None).unwrap().iter().zip(&expected) {
            assert!(a.image == b.image, "{format:?}: {}", a.name);
        }
        assert_eq!(capture.name, folder.path().file_name().unwrap().to_str().unwrap());
    }
}

#[test]
fn the_first_of_several_formats_is_chosen() {
    let folder = capture_in(None);
    let path = folder.path();
    open_transforms(path, |_| ()).unwrap();
    write_model(&path.join("sparse/0"), false, 5);
    write_model(&path.join("sparse/0"), true, 5);
    for chosen in ["cameras.json", "transforms.json", "sparse/0/images.bin", "sparse/0/images.txt"] {
        assert_eq!(open_capture(path).unwrap().file(), path.join(chosen));
        std::fs::remove_file(path.join(chosen)).unwrap();
    }
    let known =
        ["of no known format", "cameras.json", "transforms_train.json", "sparse/0", "CHUNK.torch#KEY"];
    assert_refused(open_capture(path), &known);
}

#[test]
fn poses_of_programs_that_export_them_for_colmap_are_named() {
    for (name, contents, expected) in [
        (
            "a.xml",
            "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\">\n  <chunk label=\"1\">",
            "Metashape, expected its COLMAP export",
        ),
        (
            "blocks.xml",
            "<?xml version=\"1.0\"?>\n<BlocksExchange version=\"2.1\">",
            "ContextCapture, expected the COLMAP export",
        ),
        (
            "p.csv",
            "#cameras 5\n# Name; X; Y; Alt; Heading; Pitch; Roll; f\n",
            "RealityCapture, expected its COLMAP export",
        ),
        (
            "images/0.xmp",
            "<x:xmpmeta><rdf:Description xcr:Version=\"3\"",
            "RealityCapture, expected its COLMAP",
        ),
        (
            "opensfm/reconstruction.json",
            "[{\"cameras\": {\"v2\": {\"projection_type\": \"",
            "OpenSfM, expected its COLMAP export",
        ),
        (
            "bundle.out",
            "# Bundle file v0.3\n5 0\n",
            "Bundler, expected the COLMAP export of the program that wrote it",
        ),
        ("scene.nvm", "NVM_V3 \n\n5\n", "VisualSFM, expected the COLMAP export of the program that wrote it"),
    ] {
        let folder = photos_alone();
        let file = folder.path().join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, contents).unwrap();
        let parts = [
            "of no known format, and ",
            &format!("{name} has poses of {expected}"),
            "or photos alone for `globalsplat capture`",
        ];
        assert_refused(open_capture(folder.path()), &parts);
        assert_refused(open_capture(&file), &[expected]);
        std::fs::write(&file, "something else").unwrap();
        assert_refused(open_capture(folder.path()), &["of no known format, expected a cameras.json"]);
    }
}

/// LLFF's photos belong to the rows of its poses by their names, whatever folder has them; masks lie beside them or in a folder.
#[test]
fn poses_of_llff_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("poses_bounds.npy");
    let intrinsics = Intrinsics { fx: 20., fy: 20., cx: 12., cy: 8. };
    let expected: Vec<Camera> = cameras().iter().map(|camera| Camera { intrinsics, ..*camera }).collect();
    let numbers = |change: &dyn Fn(&mut [f64; 17])| -> Vec<f64> {
        let row = |camera: &Camera| {
            let [right, down, forward, center] = [0, 1, 2, 3].map(|i| camera.c2w.col(i));
            let rows = [0, 1, 2].map(|i| [down[i], right[i], -forward[i], center[i], [16., 24., 20.][i]]);
            let mut row = [0.5; 17];
            row[..15].copy_from_slice(rows.as_flattened());
            change(&mut row);
            row
        };
        expected.iter().flat_map(row).collect()
    };
    let write = |shape: &str, numbers: &[f64]| {
        let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
        let header = format!("{header:<117}\n");
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes());
        let start = [b"\x93NUMPY\x01\x00".as_slice(), &118u16.to_le_bytes(), header.as_bytes()].concat();
        std::fs::write(&file, start.into_iter().chain(bytes).collect::<Vec<_>>()).unwrap();
    };
    let right = numbers(&|_| ());
    write("(5, 17)", &right);
    assert_refused(
        open_capture(folder.path()),
        &["the folder is without photos, expected images, or images_4"],
    );
    // By their bytes, image10 comes before image9.
    let names = ["image0.png", "image1.png", "image10.png", "image9.png", "image_mask.png"].map(String::from);
    write_photos(&folder.path().join("images_8"), &names[1..]);
    write_photos(&folder.path().join("images_2"), &names);
    for path in [folder.path(), &file] {
        let capture = open_capture(path).unwrap();
        assert_same_cameras(&capture, &expected);
        assert!(
            capture.names().eq(names.iter()) && capture.warnings().is_empty() && capture.mask_count() == 0
        );
    }
    write_photos(&folder.path().join("images_2"), &["image9_mask.png".into()]);
    write_photos(&folder.path().join("masks"), &["image1_mask.png".into()]);
    let capture = open_capture(folder.path()).unwrap();
    assert_eq!((capture.len(), capture.mask_count()), (5, 2));
    assert_eq!(read_camera_path(folder.path(), None).unwrap().cameras.len(), 5);
    for (shape, numbers, expected) in [
        ("(5, 15)", right.clone(), "the shape is [5, 15], expected [photos, 17]"),
        (
            "(4, 17)",
            right[..68].to_vec(),
            "the number of poses is 4, expected 5, as many as there are photos",
        ),
        (
            "(99999999999, 17)",
            right.clone(),
            "the shape is [99999999999, 17], expected one whose numbers fit",
        ),
        ("(5, 17)", numbers(&|row| row[0] += 1.), "c2w of view 0 is"),
        (
            "(5, 17)",
            numbers(&|row| row[9] = f64::NAN),
            "the size of view 0 is [16.0, NaN], expected a height and width",
        ),
        ("(5, 17)", numbers(&|row| row[14] = -1.), "focal length fx of view 0 is -1"),
    ] {
        write(shape, &numbers);
        assert_refused(open_capture(folder.path()), &["poses_bounds.npy: ", expected]);
    }
}

/// Raw data of Polycam are read by the poses and images that it has corrected, if there are some.
#[test]
fn polycams_keyframes_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let keyframes = folder.path().join("keyframes");
    let write = |kind: &str, change: &dyn Fn(&mut Value)| {
        for (name, camera) in names().iter().zip(cameras()) {
            let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
            let mut entry = json!({ "fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": 24, "height": 16, "blur_score": 90. });
            let c2w = transforms(&names(), &[camera])["frames"][0]["transform_matrix"].take();
            (0..12).for_each(|i| entry[format!("t_{}{}", i / 4, i % 4)] = c2w[i / 4][i % 4].clone());
            change(&mut entry);
            let file = keyframes.join(format!("{kind}cameras")).join(name).with_extension("json");
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, entry.to_string()).unwrap();
        }
    };
    write("", &|_| ());
    // Left by macOS, and by a correction that failed.
    std::fs::write(keyframes.join("cameras/._000.json"), "resources").unwrap();
    std::fs::create_dir(keyframes.join("corrected_cameras")).unwrap();
    ["images", "depth", "confidence"]
        .iter()
        .for_each(|photos| write_photos(&keyframes.join(photos), &names()));
    for path in [folder.path(), &keyframes] {
        let capture = open_capture(path).unwrap();
        assert_same_cameras(&capture, &cameras());
        assert!(capture.warnings().is_empty() && capture.load_all(None).unwrap()[4].name == "004.png");
    }
    write_photos(folder.path(), &["thumbnail.jpg".into()]);
    for parent in [folder.path(), &keyframes] {
        assert_eq!(list_photos(parent).unwrap().photos.len(), 5);
    }
    write("", &|entry| entry["t_03"] = json!(9.));
    write("corrected_", &|_| ());
    assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
    write_photos(&keyframes.join("corrected_images"), &names()[1..]);
    let capture = open_capture(folder.path()).unwrap();
    assert_same_cameras(&capture, &cameras()[1..]);
    assert_warns(&capture, &["corrected_cameras: 1 of 5 photos are missing and left out: 000"]);
    for (key, value, expected) in [
        ("t_12", json!(null), "t_12 is null or NaN, expected a number"),
        ("t_11", json!(7.), "c2w of view 0 is a matrix that isn't rigid"),
        ("fx", json!(-1.), "focal length fx of view 0 is -1"),
        ("width", json!(0.5), "width is 0.5, expected a number of pixels"),
    ] {
        write("corrected_", &|entry| entry[key] = value.clone());
        assert_refused(open_capture(folder.path()), &["corrected_cameras/001.json: ", expected]);
    }
    // Cameras don't need photos.
    write("corrected_", &|_| ());
    std::fs::remove_dir_all(keyframes.join("corrected_images")).unwrap();
    assert_eq!(read_camera_path(folder.path(), None).unwrap().cameras.len(), 5);
}

#[test]
fn the_first_format_that_can_be_read_is_taken() {
    let folder = photos_alone();
    let path = folder.path();
    // File that ODM writes beside its poses.
    std::fs::create_dir(path.join("opensfm")).unwrap();
    std::fs::write(path.join("opensfm/reconstruction.json"), "[{\"cameras\": {\"v2\": {").unwrap();
    std::fs::write(path.join("cameras.json"), r#"{"v2": {"projection_type": "brown"}}"#).unwrap();
    let hint = "opensfm/reconstruction.json has poses of OpenSfM, expected its COLMAP export";
    assert_refused(open_capture(path), &["cameras.json: ", hint]);
    std::fs::remove_dir_all(path.join("opensfm")).unwrap();
    // File that 3DGS writes beside its splats.
    let foreign = r#"[{"id": 0, "img_name": "000", "width": 24, "height": 16, "position": [0, 0, 0]}]"#;
    std::fs::write(path.join("cameras.json"), foreign).unwrap();
    let refused = "cameras.json: the file is not a description of cameras";
    assert_refused(open_capture(path), &[refused]);
    write_model(&path.join("sparse/0"), false, 5);
    let capture = open_capture(path).unwrap();
    assert_same_cameras(&capture, &cameras());
    assert_warns(&capture, &[refused, "sparse/0/images.txt is read instead"]);
    std::fs::write(path.join("sparse/0/cameras.txt"), "nonsense").unwrap();
    assert!(open_capture(path).unwrap_err().is_invalid_request());
    let parts = ["none of its formats can be read", refused, "cameras.txt: CAMERA_ID in line 1"];
    assert_refused(open_capture(path), &parts);
}

#[test]
fn colmap_models_are_found_where_tools_put_them() {
    for (place, photos, opened) in [
        ("sparse/0", "images", ""),
        ("sparse", "images", ""),
        ("dense/0/sparse", "dense/0/images", ""),
        ("dense/sparse", "dense/images", ""),
        ("", "images", ""),
        ("", "", ""),
        ("sparse/0", "images", "sparse/0"),
        ("sparse", "images", "sparse"),
    ] {
        for is_binary in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            write_photos(&folder.path().join(photos), &names());
            write_model(&folder.path().join(place), is_binary, 5);
            let capture = open_capture(&folder.path().join(opened)).unwrap();
            assert_same_cameras(&capture, &cameras());
            assert!(capture.warnings().is_empty() && capture.load_all(None).unwrap()[4].name == "004.png");
            // No output may replace the record of `globalsplat capture`.
            let record = folder.path().join("capture.json");
            std::fs::write(&record, "{}").unwrap();
            let mut inputs = InputFiles::default();
            capture.add_input_files(&mut inputs);
            assert!(place != "sparse/0" || inputs.check_file(&record).is_err());
        }
    }
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
        write_model(&folder.path().join(large), false, 5);
        write_model(&folder.path().join(small), true, 2);
        let capture = open_capture(folder.path()).unwrap();
        assert_same_cameras(&capture, &cameras());
        let left_out = format!("{small} (2 photos)");
        assert_warns(&capture, &["the largest of 2 models is taken, with 5 photos", &left_out]);
    }
    // The path `sparse` itself opens the same capture.
    let folder = photos_alone();
    for (model, count) in [("sparse/0", 2), ("sparse/1", 5), ("sparse/2", 5)] {
        write_model(&folder.path().join(model), true, count);
    }
    let capture = open_capture(&folder.path().join("sparse")).unwrap();
    assert!(capture.len() == 5 && capture.file().ends_with("sparse/1/images.bin"));
}

#[test]
fn captures_are_found_in_numeric_order() {
    let above = tempfile::tempdir().unwrap();
    let place = |name: &str| above.path().join(name);
    for (name, format) in ["scene_10", "below/1", "scene_9", "below/0"].iter().zip(FORMATS) {
        write_capture(&place(name), format);
    }
    // Left by interrupted work, or hidden.
    for name in [".scene_9.globalsplat-partial", ".hidden/room"] {
        write_capture(&place(name), None);
    }
    #[cfg(unix)]
    std::os::unix::fs::symlink(place("scene_9"), place("scene_11")).unwrap();
    std::fs::create_dir(place("closed")).unwrap();
    #[cfg(unix)]
    std::fs::set_permissions(place("closed"), std::os::unix::fs::PermissionsExt::from_mode(0o0)).unwrap();
    let expected = ["0", "1", "scene_9", "scene_10", "scene_9"];
    assert_eq!(names_of_captures(above.path()), expected[..if cfg!(unix) { 5 } else { 4 }]);
    // A user who may read everything, such as root, gets no warning.
    let warnings = find_captures(above.path()).unwrap().warnings;
    match std::fs::read_dir(place("closed")) {
        Ok(_) => assert!(warnings.is_empty()),
        Err(_) => assert!(warnings.len() == 1 && warnings[0].contains("closed can't be read")),
    }
    // Numbered models with their photos are captures, not models of one capture.
    let numbered = tempfile::tempdir().unwrap();
    for name in ["0", "1"] {
        write_photos(&numbered.path().join(name), &names());
        write_model(&numbered.path().join(name), true, 5);
    }
    assert_eq!(names_of_captures(numbered.path()), ["0", "1"]);
}

#[test]
fn views_are_in_numeric_order() {
    let name = |i: u32| format!("r_{i}.png");
    let names: Vec<String> = (1..=12).map(name).collect();
    let shuffled = [7, 2, 10, 1, 12, 5, 3, 11, 9, 4, 8, 6].map(name).to_vec();
    let poses: Vec<_> = cameras().into_iter().cycle().take(names.len()).collect();
    for format in FORMATS {
        let folder = tempfile::tempdir().unwrap();
        write_photos(&folder.path().join("images"), &names);
        write_cameras_json(&folder.path().join("cameras.json"), &in_images(&shuffled), &poses).unwrap();
        format.into_iter().for_each(|format| rewrite(folder.path(), format));
        let capture = open_capture(folder.path()).unwrap();
        let found: Vec<String> = capture.names().map(|name| name.replace("images/", "")).collect();
        // The order of the file, for `cameras.json`.
        assert_eq!(&found, if format.is_none() { &shuffled } else { &names }, "{format:?}");
    }
}

fn remove(value: &mut Value, keys: &[&str]) {
    for key in keys {
        value.as_object_mut().unwrap().remove(*key).expect("a key that was there");
    }
}

/// Returns the angle of view of `size` pixels with a focal length.
fn angle(size: f64, focal: f64) -> Value {
    json!(2. * (size / 2. / focal).atan())
}

#[test]
fn transforms_specify_intrinsics_in_several_ways() {
    let original = cameras()[0].intrinsics;
    let Intrinsics { cx, cy, .. } = original;
    let with_focal = |fx: f64, fy: f64| Intrinsics { fx, fy, cx, cy };
    type Change = fn(&mut Value);
    let angles: Change = |t| {
        remove(t, &["fl_x", "fl_y"]);
        (t["camera_angle_x"], t["camera_angle_y"]) = (angle(24., 21.5), angle(16., 20.25));
    };
    // One angle of view, no principal point or size, and the names of NeRF's synthetic scenes.
    let synthetic: Change = |t| {
        remove(t, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        t["camera_angle_x"] = angle(24., 30.);
        (0..5).for_each(|i| t["frames"][i]["file_path"] = json!(format!("./images/{i:03}")));
    };
    // A frame's own fields override the shared ones, focal lengths override angles.
    let own: Change = |t| {
        t["camera_angle_x"] = json!(1.);
        remove(t, &["fl_y"]);
        (t["frames"][2]["fl_x"], t["frames"][2]["cx"]) = (json!(33.), json!(10.));
    };
    // An angle of a frame overrides a focal length of all frames.
    let own_angles: Change = |t| {
        (0..5).for_each(|i| t["frames"][i]["camera_angle_x"] = angle(24., 30.));
        t["frames"][3]["camera_angle_y"] = angle(16., 25.);
        t["frames"][4]["fl_x"] = json!(40.);
    };
    let keys_of_other_tools: Change = |t| {
        t["applied_transform"] = json!([[0., 1., 0., 3.], [1., 0., 0., 0.], [0., 0., -1., 0.]]);
        t["ply_file_path"] = json!("sparse_pc.ply");
        (t["camera_model"], t["is_fisheye"]) = (json!("OpenCV"), json!(false));
        (t["frames"][0]["colmap_im_id"], t["frames"][0]["sharpness"]) = (json!(1), json!(30.5));
        // instant-ngp reads three rows alone.
        t["frames"][1]["transform_matrix"].as_array_mut().unwrap().pop();
    };
    let (equal, wide) = (with_focal(21.5, 21.5), with_focal(30., 30.));
    for (change, expected) in [
        (angles, [original; 5]),
        (synthetic, [Intrinsics { fx: 30., fy: 30., cx: 12., cy: 8. }; 5]),
        (own, [equal, equal, Intrinsics { cx: 10., ..with_focal(33., 33.) }, equal, equal]),
        (own_angles, [wide, wide, wide, with_focal(30., 25.), with_focal(40., 40.)]),
        (keys_of_other_tools, [original; 5]),
    ] {
        let cameras = cameras().into_iter().zip(expected);
        let expected: Vec<_> = cameras.map(|(camera, intrinsics)| Camera { intrinsics, ..camera }).collect();
        assert_same_cameras(&open_transforms(photos_alone().path(), change).unwrap(), &expected);
    }
    // The second frame has its own coefficients, all 0.
    let folder = photos_alone();
    let views = |change: Change| open_transforms(folder.path(), change).unwrap().load(&[0, 1], None).unwrap();
    let undistorted = views(|_| ());
    let distorted = views(|t| (t["k1"], t["frames"][1]["k2"]) = (json!(-0.2), json!(0.)));
    assert!(distorted[0].image != undistorted[0].image && distorted[1].image == undistorted[1].image);
}

#[test]
fn rounded_poses_become_rigid() {
    let entries = |matrix: &mut Value, rows: usize, change: &dyn Fn(f64) -> f64| {
        for row in matrix.as_array_mut().unwrap().iter_mut().take(rows) {
            let entries = row.as_array_mut().unwrap().iter_mut().take(rows);
            entries.for_each(|entry| *entry = json!(change(entry.as_f64().unwrap())));
        }
    };
    let folder = photos_alone();
    let capture = open_transforms(folder.path(), |t| {
        entries(&mut t["frames"][1]["transform_matrix"], 4, &|entry| (entry * 1e3).round() / 1e3);
    });
    let (found, exact) = (capture.unwrap().cameras()[1].c2w, cameras()[1].c2w);
    assert!(!found.abs_diff_eq(exact, 1e-5) && found.abs_diff_eq(exact, 2e-3));
    let rotation = DMat3::from_mat4(found);
    let gram = rotation.transpose() * rotation;
    assert!(gram.abs_diff_eq(DMat3::IDENTITY, 1e-14) && rotation.determinant() > 0.);

    // A scale is taken out, and a line says so.
    for factor in [0.5, 1.002, 1e-4, 300.] {
        let capture = open_transforms(folder.path(), |t| {
            for i in 0..5 {
                entries(&mut t["frames"][i]["transform_matrix"], 3, &|entry| entry * factor);
            }
        });
        let capture = capture.unwrap();
        assert_same_cameras(&capture, &cameras());
        assert_warns(&capture, &["5 of 5 rotations are scaled", "taken out", "images/000.png", "and 2 more"]);
    }
    let folder = capture_in(None);
    let file = folder.path().join("cameras.json");
    let mut contents: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    entries(&mut contents["views"][1]["c2w"], 3, &|entry| entry * 2.);
    std::fs::write(&file, contents.to_string()).unwrap();
    let capture = open_capture(&file).unwrap();
    assert_same_cameras(&capture, &cameras());
    assert_warns(&capture, &["1 of 5 rotations are scaled, the first by 2.0", "images/001.png"]);
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
    }
    // The photos are upright: the world's up, z, is up in the photo.
    assert!(cameras.iter().all(|camera| camera.c2w.y_axis.z < -0.5));
    assert_eq!(capture.load(&[0], None).unwrap()[0].image.size(), (1920, 1080));
}

#[test]
fn missing_photos_are_left_out_with_a_warning() {
    for format in FORMATS {
        let folder = capture_in(format);
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
        let parts = ["the number of frames with an image is 1 of 5", "is missing, expected two or more"];
        assert_refused(open_capture(folder.path()), &parts);
    }
}

#[test]
fn cameras_are_scaled_to_smaller_and_larger_photos() {
    for format in FORMATS.into_iter().flatten() {
        for folder_name in ["images", "images_2", "images_4"] {
            let folder = capture_in(Some(format));
            std::fs::remove_dir_all(folder.path().join("images")).unwrap();
            let images = folder.path().join(folder_name);
            std::fs::create_dir(&images).unwrap();
            let mut expected = cameras();
            let sizes = [(24, 16), (12, 8), (48, 32), (6, 4), (12, 8)];
            for ((name, camera), (width, height)) in names().iter().zip(&mut expected).zip(sizes) {
                RgbImage::new(width, height).save(images.join(name)).unwrap();
                let factor = f64::from(width) / 24.;
                let intrinsics = camera.intrinsics.resized(factor, factor);
                *camera = Camera { width, height, intrinsics, ..*camera };
            }
            let capture = open_capture(folder.path()).unwrap();
            assert_same_cameras(&capture, &expected);
            assert_warns(&capture, &["4 of 5 photos", "12×8 pixels in place of 24×16", "scaled", "001.png"]);
            assert_eq!(capture.load(&[3], None).unwrap()[0].image.size(), (4, 6));
        }
    }
    // A photo of another aspect ratio is refused, by its name.
    let folder = capture_in(Some(Format::ColmapText));
    RgbImage::new(12, 12).save(folder.path().join("images/001.png")).unwrap();
    assert_refused(open_capture(folder.path()).unwrap().load_all(None), &["001.png", "12×12 pixels"]);
}

#[test]
fn the_synthetic_layout_has_views_to_learn_from_and_views_to_hold_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    for (part, count) in [("train", 3), ("test", 2)] {
        write_photos(&path.join(part), &names());
        let images: Vec<String> = (0..count).map(|i| format!("./{part}/{i:03}")).collect();
        let mut contents = transforms(&images, &cameras());
        remove(&mut contents, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        contents["camera_angle_x"] = angle(24., 30.);
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
    assert_eq!(find_captures(path).unwrap().paths.len(), 1);
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
    let open = |held_out: Value| {
        open_transforms(folder.path(), |t| {
            (t["train_filenames"], t["val_filenames"]) = (json!(images[..2]), held_out);
        })
    };
    let capture = open(json!([format!("./{}", images[3])])).unwrap();
    assert_eq!(capture.split(Holdout::None), (vec![0, 1], vec![2]));
    assert_eq!(capture.names().collect::<Vec<_>>(), [&images[0], &images[1], &images[3]]);
    assert_warns(&capture, &["transforms.json", "2 frames are left out"]);
    assert_refused(open(json!([1])), &["val_filenames", "a list of file_paths"]);
}

#[test]
fn cameras_without_images_do_no_harm() {
    let folder = photos_alone();
    let model = folder.path().join("sparse/0");
    write_model(&model, false, 5);
    let cameras_text = std::fs::read_to_string(model.join("cameras.txt")).unwrap();
    for unused in ["8 OPENCV_FISHEYE 24 16 1 1 1 1 0 0 0 0", "9 A_MODEL_TO_COME 0 0 1"] {
        std::fs::write(model.join("cameras.txt"), format!("{unused}\n{cameras_text}")).unwrap();
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
    }
}

/// Files may begin with a byte order mark, and have the line ends of Windows, spaces at line ends and numbers in other forms.
#[test]
fn text_is_read_as_every_system_writes_it() {
    for (format, files) in [
        (None, &["cameras.json"][..]),
        (Some(Format::Transforms), &["transforms.json"]),
        (Some(Format::ColmapText), &["sparse/0/cameras.txt", "sparse/0/images.txt"]),
    ] {
        let folder = capture_in(format);
        for file in files.iter().map(|file| folder.path().join(file)) {
            let text = std::fs::read_to_string(&file).unwrap().replace("21.5 20.25", "2.15e+001 2025.0e-002");
            let ending = if file.extension().unwrap() == "txt" { " \t\r\n" } else { "\r\n" };
            std::fs::write(&file, "\u{feff}".to_string() + text.replace('\n', ending).trim_end()).unwrap();
        }
        assert_same_cameras(&open_capture(folder.path()).unwrap(), &cameras());
    }
}
