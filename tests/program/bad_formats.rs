//! Invalid captures in other tools' formats give one sentence that names file, field, what was found and what was expected, and
//! exit code 2.

use crate::common::formats::{Format, rewrite};
use crate::common::program::{Sandbox, arg, assert_says};
use globalsplat::data::open_capture;
use serde_json::{Value, json};

/// Asserts that the room in `format`, with `file` changed, is refused, and that the message contains all of `parts` and the
/// file.
fn refused(format: Format, file: &str, change: impl FnOnce(&mut Vec<u8>), parts: &[&str]) {
    let (sandbox, file) = (Sandbox::new(), format!("room/{file}"));
    rewrite(&sandbox.path("room"), format);
    let mut bytes = sandbox.read(&file);
    change(&mut bytes);
    sandbox.write(&file, bytes);
    let error = open_capture(&sandbox.path("room")).expect_err("a capture that can't be right");
    assert!(error.is_invalid_request(), "exit code 2: {error:?}");
    let error = error.to_string();
    assert_eq!(error.lines().count(), 1, "one sentence: {error}");
    assert_says(&error, &[parts, &[arg(&sandbox.path(&file))]].concat());
}

fn refused_transforms(change: impl FnOnce(&mut Value), parts: &[&str]) {
    let change = |bytes: &mut Vec<u8>| {
        let mut json = serde_json::from_slice(bytes).unwrap();
        change(&mut json);
        *bytes = json.to_string().into_bytes();
    };
    refused(Format::Transforms, "transforms.json", change, parts);
}

#[test]
fn transforms_with_invalid_contents() {
    let broken = |text: &'static str, parts: &[&str]| {
        refused(Format::Transforms, "transforms.json", |bytes| *bytes = text.into(), parts);
    };
    broken("{\"frames\": [", &["the file is no JSON", "\"transform_matrix\""]);
    broken("[]", &["frames is missing", "a list of frames"]);
    broken("{\"frames\": 3}", &["frames is 3", "a list of frames"]);
    broken("{\"frames\": []}", &["number of views is 0", "two or more"]);
    broken("{\"frames\": [3]}", &["file_path of frame 0 is missing", "the path of an image"]);
    refused_transforms(
        |t| t["frames"][3]["file_path"] = json!(["a"]),
        &["file_path of frame 3 is a list of 1", "the path of an image"],
    );
}

#[test]
fn transforms_with_poses_that_are_none() {
    let pose = |change: fn(&mut Value), parts: &[&str]| {
        let parts: Vec<&str> = [&["transform_matrix of frame 2"], parts].concat();
        refused_transforms(|t| change(&mut t["frames"][2]["transform_matrix"]), &parts);
    };
    pose(|m| *m = json!([[1., 0.], [0., 1.]]), &["a list of 2", "a 4×4 matrix"]);
    pose(|m| m[1] = json!([0., 1., 0.]), &["a 4×4 matrix"]);
    pose(|m| m[1][2] = json!("0"), &["row 1, column 2 of", "is \"0\"", "a number"]);
    pose(|m| m[1][2] = Value::Null, &["NaN", "finite numbers"]);
    pose(|m| m[0][0] = json!(1.5), &["isn't rigid", "a rotation"]);
    // Within the tolerance of a cameras.json, but beyond that of this format, whose values have more digits.
    pose(|m| m[0][1] = json!(m[0][1].as_f64().unwrap() + 0.0024), &["isn't rigid", "nearest rotation"]);
    // Scaled along one axis, and then sheared.
    pose(|m| (0..3).for_each(|i| m[i][0] = json!(m[i][0].as_f64().unwrap() * 0.5)), &["isn't rigid"]);
    pose(
        |m| (0..3).for_each(|i| m[i][0] = json!(m[i][0].as_f64().unwrap() + 0.5 * m[i][1].as_f64().unwrap())),
        &["isn't rigid"],
    );
    let mirror = |m: &mut Value| {
        m.as_array_mut()
            .unwrap()
            .iter_mut()
            .take(3)
            .for_each(|row| row[1] = json!(-row[1].as_f64().unwrap()));
    };
    pose(mirror, &["mirrors"]);
}

#[test]
fn transforms_with_lenses_that_are_none() {
    let set = |key: &'static str, value: Value, parts: &[&str]| refused_transforms(|t| t[key] = value, parts);
    set("w", json!(0), &["w is 0", "a number of pixels"]);
    set("h", json!(39.5), &["h is 39.5", "a number of pixels"]);
    set("fl_x", json!("wide"), &["fl_x is \"wide\"", "a number"]);
    set("fl_x", json!(-20.), &["focal length fx of frame 0 is -20", "above 0"]);
    set("cx", json!(90.), &["principal point cx of frame 0 is 90", "0 to 40"]);
    set("k1", Value::Null, &["k1 is null or NaN", "a number"]);
    set("k5", json!(0.1), &["k5 is 0.1", "FULL_OPENCV as camera_model"]);
    set("k1", json!(-9.), &["the distortion of frame 0 is k1 -9", "folds", "every pixel"]);
    set("camera_model", json!("VR180_L"), &["camera_model is \"VR180_L\"", "PINHOLE", "EQUIRECTANGULAR"]);
    set("camera_model", json!("EUCM"), &["the parameters of frame 0 is [", "6 parameters for EUCM"]);
    set("is_fisheye", json!("yes"), &["is_fisheye is \"yes\"", "true or false"]);
    set("distortion_params", json!([0.1, 0.]), &["distortion_params is 2 numbers", "k1, k2, k3, k4, p1, p2"]);
    set("distortion_params", json!(0.1), &["distortion_params is 0.1", "a list of numbers"]);
    refused_transforms(
        |t| t["frames"][4]["fl_x"] = json!([1.]),
        &["fl_x of frame 4 is a list of 1", "a number"],
    );
    let without_focal = |t: &mut Value| {
        t.as_object_mut().unwrap().retain(|key, _| !key.starts_with("fl_"));
    };
    refused_transforms(without_focal, &["fl_x of frame 0 is missing", "camera_angle_x"]);
    refused_transforms(
        |t| {
            without_focal(t);
            t["camera_angle_x"] = json!(4.);
        },
        &["camera_angle_x is 4", "between 0 and π"],
    );
}

/// Calls [`refused`] for a text file of a COLMAP model, with `from` replaced by `to`.
fn refused_text(name: &str, from: &str, to: &str, parts: &[&str]) {
    let change = |bytes: &mut Vec<u8>| {
        let text = String::from_utf8(bytes.clone()).unwrap();
        assert!(text.contains(from), "{from:?} is not in: {text}");
        *bytes = text.replacen(from, to, 1).into_bytes();
    };
    refused(Format::ColmapText, &format!("sparse/0/{name}.txt"), change, parts);
}

#[test]
fn colmap_text_with_cameras_that_are_none() {
    let cameras = |from: &str, to: &str, parts: &[&str]| refused_text("cameras", from, to, parts);
    let known = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, FULL_OPENCV";
    cameras("PINHOLE", "ORTHOPHOTO", &["model of camera 7 is ORTHOPHOTO", known]);
    cameras("PINHOLE", "RADIAL", &["the parameters of camera 7 is [36.0, 36.0, 20.0, 20.0]", "5 parameters"]);
    cameras("7 PINHOLE", "seven PINHOLE", &["CAMERA_ID in line 3 is \"seven\"", "a whole number"]);
    cameras("PINHOLE 40 40", "PINHOLE 40 4e1", &["HEIGHT in line 3 is \"4e1\"", "a whole number"]);
    cameras("PINHOLE 40 40", "PINHOLE 40 0", &["height of camera 7 is 0", "a number of pixels"]);
    cameras("40 40 36", "40 40 nan", &["focal length fx of camera 7 is NaN", "above 0"]);
    cameras("40 40 36", "40 40 36x", &["PARAMS in line 3 is \"36x\"", "a number"]);
    cameras(" 40 40 36 36 20 20", "", &["WIDTH in line 3 is missing", "a whole number"]);
    let twice = "7 PINHOLE 40 40 36 36 20 20";
    cameras(twice, &format!("{twice}\n{twice}"), &["camera ids is 7 twice", "each once"]);
    let folding = "7 SIMPLE_RADIAL 40 40 36 20 20 -9";
    cameras(twice, folding, &["the distortion of camera 7 is k1 -9", "folds"]);
}

#[test]
fn colmap_text_with_images_that_are_none() {
    let images = |from: &str, to: &str, parts: &[&str]| refused_text("images", from, to, parts);
    images(
        " 7 004.png",
        " 8 004.png",
        &["camera id of image 5 (004.png) is 8", "one of the 1", "cameras.txt"],
    );
    // The fifth of nine cameras is in the middle: no rotation, no translation.
    images(
        "\n5 1 ",
        "\n5 0 ",
        &["rotation of image 5 (004.png) is [0.0,", "a quaternion (w, x, y, z) of length 1"],
    );
    images("\n5 1 ", "\n5 NaN ", &["rotation of image 5 (004.png) is [NaN,", "a quaternion"]);
    images("\n5 1 ", "\n5 one ", &["QW in line 10 is \"one\"", "a number"]);
    images(" 7 004.png", "inf 7 004.png", &["TZ in line 10 is", "inf\"", "a number"]);
    images("\n5 1 ", "\n-5 1 ", &["IMAGE_ID in line 10 is \"-5\"", "a whole number"]);
    // Without the second line of each image, the next image is read where its points should be.
    images("004.png\n\n", "004.png\n", &["POINTS2D in line 11 is 10 words", "an empty line"]);
}

#[test]
fn colmap_binaries_with_values_that_are_none() {
    let put = |name: &str, at: usize, value: &[u8], parts: &[&str]| {
        let change = |bytes: &mut Vec<u8>| bytes[at..at + value.len()].copy_from_slice(value);
        refused(Format::ColmapBinary, &format!("sparse/0/{name}.bin"), change, parts);
    };
    // Layout: a count, then from byte 8 on: id, model, width, height, parameters.
    let cameras = |at: usize, value: &[u8], parts: &[&str]| put("cameras", at, value, parts);
    cameras(0, &u64::MAX.to_le_bytes(), &["number of cameras is 18446744073709551615", "1 at most"]);
    cameras(0, &2u64.to_le_bytes(), &["number of cameras is 2", "1 at most"]);
    cameras(0, &0u64.to_le_bytes(), &["the length is 64 bytes, 56 too many", "expected 8"]);
    cameras(12, &5i32.to_le_bytes(), &["the parameters of camera 7", "cut short"]);
    cameras(12, &99i32.to_le_bytes(), &["model of camera 7 is number 99", "SIMPLE_RADIAL, RADIAL"]);
    cameras(12, &(-1i32).to_le_bytes(), &["model of camera 7 is number -1"]);
    cameras(12, &4i32.to_le_bytes(), &["the parameters of camera 7", "cut short", "after 64 bytes"]);
    cameras(16, &(1u64 << 40).to_le_bytes(), &["width of camera 7 is 1099511627776", "a number of pixels"]);
    cameras(32, &f64::NAN.to_le_bytes(), &["focal length fx of camera 7 is NaN"]);
    // Layout: a count, then from byte 8 on: id, quaternion, translation, camera id, name, points.
    let images = |at: usize, value: &[u8], parts: &[&str]| put("images", at, value, parts);
    images(0, &(1u64 << 61).to_le_bytes(), &["number of images is 2305843009213693952", "at most"]);
    images(12, &f64::NAN.to_le_bytes(), &["rotation of image 9 (008.png) is [NaN", "a quaternion"]);
    images(44, &f64::INFINITY.to_le_bytes(), &["translation of image 9 (008.png) is [inf", "finite numbers"]);
    images(68, &3u32.to_le_bytes(), &["camera id of image 9 (008.png) is 3", "cameras.bin"]);
    images(72, &[0xff], &["name of image 9 is no text", "UTF-8"]);
    images(72, &[b'x'; 8], &["name of image 9 is no text", "ended by a 0"]);
    images(80, &u64::MAX.to_le_bytes(), &["number of points of image 9 is 18446744073709551615", "at most"]);
    let longer = |bytes: &mut Vec<u8>| bytes.push(0);
    refused(Format::ColmapBinary, "sparse/0/images.bin", longer, &["the length is", "1 too many"]);
    let endless = |bytes: &mut Vec<u8>| bytes.truncate(75);
    refused(Format::ColmapBinary, "sparse/0/images.bin", endless, &["number of images is 9", "0 at most"]);
}

#[test]
fn damaged_colmap_binaries_never_panic() {
    for name in ["cameras.bin", "images.bin"] {
        let (sandbox, file) = (Sandbox::new(), format!("room/sparse/0/{name}"));
        rewrite(&sandbox.path("room"), Format::ColmapBinary);
        let whole = sandbox.read(&file);
        let open = |bytes: &[u8]| {
            sandbox.write(&file, bytes);
            open_capture(&sandbox.path("room")).map(drop).map_err(|error| {
                assert!(error.is_invalid_request() && error.to_string().contains("sparse/0/"), "{error}");
                error.to_string()
            })
        };
        for length in 0..whole.len() {
            let error = open(&whole[..length]).expect_err("a model that is cut short");
            assert!(error.contains(name), "{length} bytes: {error}");
        }
        let noticed = (0..whole.len()).filter(|&i| {
            let mut bytes = whole.clone();
            bytes[i] ^= 0xff;
            open(&bytes).is_err()
        });
        // The unnoticed changes are of last digits, ids, points, and quaternions, which may have any length.
        let noticed = noticed.count();
        assert!(whole.len() >= 64 && noticed > whole.len() / 5, "{noticed} of {}", whole.len());
    }
}

#[test]
fn warnings_list_skipped_input_in_one_line() {
    let sandbox = Sandbox::new();
    rewrite(&sandbox.path("room"), Format::Transforms);
    std::fs::remove_file(sandbox.path("room/images/004.png")).unwrap();
    for line in ["inspect @room", "eval --splat @room/truth.ply --scene @room", "pack @room --out @chunks"] {
        let (_, message) = sandbox.succeed_with_messages(line);
        let warning = "1 of 9 photos are missing and left out: images/004.png";
        assert_eq!(message.lines().filter(|line| line.contains(warning)).count(), 1, "{line}: {message}");
    }
}
