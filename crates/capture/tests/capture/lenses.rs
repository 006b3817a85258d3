//! Lenses: the camera models of COLMAP, and the pinhole views of photos that other lenses took.

use crate::{assert_refused, assert_warns, open_transforms};
use glam::{DVec2, DVec3};
use globalsplat_capture::{
    Camera, Holdout, ImageSize, Intrinsics, Lens, Photo, decode_photo, open_capture, read_camera_path,
    read_image,
};
use globalsplat_test_kit::formats::{assert_same_cameras, cameras, names, write_colmap_text};
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use tempfile::TempDir;

/// A random camera of a model of COLMAP, with rays of random pixels computed by pycolmap 4.2.1.
#[derive(Deserialize)]
struct ReferenceCamera {
    model: String,
    size: ImageSize,
    params: Vec<f64>,
    /// Pixels u and v, and rays x, y and z.
    points: Vec<[f64; 5]>,
}

#[test]
fn every_model_of_colmap_agrees_with_pycolmap() {
    let mut reference: Value = serde_json::from_str(include_str!("../data/lens_models.json")).unwrap();
    let cameras: Vec<ReferenceCamera> = serde_json::from_value(reference["cameras"].take()).unwrap();
    let models: BTreeSet<&String> = cameras.iter().map(|camera| &camera.model).collect();
    assert_eq!((cameras.len(), models.len()), (54, 18), "three cameras of every model");
    for camera in &cameras {
        let name = format!("{} {:?}", camera.model, camera.params);
        let lens = Lens::from_colmap(&camera.model, &camera.params, camera.size).expect(&name);
        for &[u, v, x, y, z] in &camera.points {
            let (pixel, ray) = (DVec2::new(u, v), DVec3::new(x, y, z));
            // A length doesn't change the direction.
            for ray in [ray, ray * 7.5] {
                let found = lens.project(ray).unwrap_or_else(|| panic!("{name}: {ray}"));
                assert!((found - pixel).length() < 1e-6, "{name}: {found} for {pixel}");
            }
            let found = lens.unproject(pixel).unwrap_or_else(|| panic!("{name}: {pixel}"));
            // The error in pixels is less than that in radians times the image's size.
            let error = (found - ray).length() * f64::from(camera.size.width.max(camera.size.height));
            assert!(error < 1e-6, "{name}: {found} for {ray}");
        }
    }
}

/// Returns the color of the sky in a direction of the world.
fn sky(direction: DVec3) -> DVec3 {
    let wave = |x, y, z| 127.5 + 100. * (1.5 * direction.normalize().dot(DVec3::new(x, y, z))).sin();
    DVec3::new(wave(1., 0.3, 0.), wave(0., 1., -0.4), wave(-0.2, 0., 1.))
}

/// Writes photos of the sky that `lens` takes at the poses of [`cameras`]. Pixels that the lens doesn't define repeat those at the border
/// of what it does.
fn write_photos(folder: &Path, lens: &Lens) {
    std::fs::create_dir_all(folder).unwrap();
    let ImageSize { height, width } = lens.size();
    let center = lens.project(DVec3::Z).unwrap();
    let ray =
        |pixel: DVec2| (0..).find_map(|n| lens.unproject(center.lerp(pixel, 0.995f64.powi(n)))).unwrap();
    let pixel = |i: u32| DVec2::new(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
    let rays: Vec<DVec3> = (0..width * height).map(|i| ray(pixel(i))).collect();
    for (name, camera) in names().iter().zip(cameras()) {
        let photo = RgbImage::from_fn(width, height, |x, y| {
            let color = sky(camera.c2w.transform_vector3(rays[(y * width + x) as usize]));
            Rgb(color.to_array().map(|level| level.round() as u8))
        });
        photo.save(folder.join(name)).unwrap();
    }
}

/// Returns a COLMAP capture of the sky whose photos have the lens `model`, such as `SIMPLE_FISHEYE 100 80 80`.
fn capture_of(model: &str, size: [u32; 2]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (name, parameters) = model.split_once(' ').unwrap();
    let parameters: Vec<f64> = parameters.split(' ').map(|number| number.parse().unwrap()).collect();
    let lens = Lens::from_colmap(name, &parameters, size.into()).unwrap();
    write_photos(&folder.path().join("images"), &lens);
    let [height, width] = size;
    let cameras: Vec<_> = cameras().into_iter().map(|camera| Camera { width, height, ..camera }).collect();
    write_colmap_text(&folder.path().join("sparse/0"), &names(), &cameras, model);
    folder
}

/// Checks that every pixel of `photo` that counts has the color of the sky along its ray, and that the others are black. Returns the
/// fraction of pixels that count.
fn check_colors(photo: &Photo, tolerance: f64) -> f64 {
    let Photo { camera, mask, .. } = photo;
    let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
    let mut counted = 0;
    for (x, y, found) in photo.image.to_rgb().enumerate_pixels() {
        match mask.as_ref().map_or(255, |mask| mask[(y * camera.width + x) as usize]) {
            0 => assert_eq!(found.0, [0; 3]),
            255 => {
                counted += 1;
                let ray = DVec3::new((f64::from(x) + 0.5 - cx) / fx, (f64::from(y) + 0.5 - cy) / fy, 1.);
                let expected = sky(camera.c2w.transform_vector3(ray));
                let error = (DVec3::from(found.0.map(f64::from)) - expected).abs().max_element();
                assert!(error < tolerance, "{found:?} for {expected} at ({x}, {y}) of {}", photo.name);
            }
            weight => panic!("a weight of {weight}"),
        }
    }
    f64::from(counted) / f64::from(camera.width * camera.height)
}

const THIN_PRISM: &str = "THIN_PRISM_FISHEYE 125 124 89 61 -0.03 0.01 0.001 -0.002 0.001 0 0.002 -0.001";

#[test]
fn views_show_the_colors_of_the_rays_of_the_photo() {
    // Fractions of the pixels of a photo's views that count, at least and at most. Views of perspective lenses and faces of a photo of all
    // directions count in full.
    for (model, size, names, share) in [
        ("EQUIRECTANGULAR 160 80", [80, 160], 6, [1., 1.]),
        ("OPENCV 110 115 83 58 -0.15 0.04 0.01 -0.01", [120, 160], 1, [1., 1.]),
        ("FULL_OPENCV 110 115 83 58 -0.15 0.04 0.01 -0.01 0.02 0.3 -0.08 0.04", [120, 160], 1, [1., 1.]),
        ("OPENCV_FISHEYE 105 106 79 61 0.03 -0.01 0.002 0", [120, 160], 1, [0.7, 1.]),
        ("RADIAL_FISHEYE 52 80 39 0.02 0.005", [77, 160], 2, [0.6, 1.]),
        ("FISHEYE 40 40 81 79", [160, 160], 5, [0.6, 1.]),
        (THIN_PRISM, [120, 180], 1, [0.7, 1.]),
        ("EUCM 70 70 81 40 0.55 1.1", [80, 160], 2, [0.6, 1.]),
        ("DIVISION 50 52 81 59 -0.25", [120, 160], 5, [0.4, 1.]),
        // The radial distortion turns back at 74 degrees. Up to there, ever more rays share a pixel.
        ("RADIAL_FISHEYE 50 62 57 -0.2 0", [115, 125], 5, [0.4, 0.9]),
    ] {
        let folder = capture_of(model, size);
        let capture = open_capture(folder.path()).unwrap();
        assert_eq!(capture.len(), 5 * names, "{model}");
        let photos = capture.load_all(None).unwrap();
        let tolerance = if model.contains("-0.2 0") { 20. } else { 3. };
        let shares: Vec<f64> = photos.iter().map(|photo| check_colors(photo, tolerance)).collect();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        assert!(share[0] <= mean && mean <= share[1], "{model}: {shares:?}");
        assert_eq!(photos.iter().any(|photo| photo.mask.is_some()), share[0] < 1., "{model}");
        for (index, photo) in photos.iter().enumerate().step_by(7) {
            let center = cameras()[index / names].c2w.w_axis;
            assert!(photo.camera.c2w.w_axis.abs_diff_eq(center, 1e-9), "{model}");
            let (alone, mask) = capture.photo_with_mask(index).unwrap();
            let mask = mask.map(|mask| mask.pixels().map(|weight| weight[0]).collect());
            assert!(alone == photo.image.to_rgb() && mask == photo.mask, "{model}");
            let encoded = capture.encoded(index).unwrap();
            let encoded = decode_photo(&encoded, "encoded".as_ref(), alone.dimensions()).unwrap();
            assert_eq!(encoded.pixels, alone, "{model}");
        }
    }
}

#[test]
fn views_of_a_photo_are_named_loaded_and_held_out_together() {
    let folder = capture_of("EQUIRECTANGULAR 320 160", [160, 320]);
    let capture = open_capture(folder.path()).unwrap();
    assert_warns(&capture, &["5 of 5 photos have a fisheye or 360° lens and become 30 pinhole views"]);
    let faces = ["front", "right", "back", "left", "up", "down"];
    let expected = (0..5).flat_map(|i| faces.map(move |face| format!("{i:03}@{face}.png")));
    assert!(capture.names().eq(expected.clone()), "{:?}", capture.names().collect::<Vec<_>>());
    let files = expected.map(|name| name.replace(".png", ""));
    assert!(capture.render_names().into_iter().eq(files));

    let (shown, held_out) = capture.split("every:3+1".parse().unwrap());
    assert_eq!(held_out, [6, 7, 8, 9, 10, 11, 24, 25, 26, 27, 28, 29]);
    assert_eq!(shown, [0, 1, 2, 3, 4, 5, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23]);
    assert_eq!(capture.split(Holdout::None), ((0..30).collect(), vec![]));

    // Views come in the order of their indices, even twice.
    let all = capture.load_all(Some([32, 48].into())).unwrap();
    let indices = [29, 3, 0, 24, 3, 8];
    let some = capture.load(&indices, Some([32, 48].into())).unwrap();
    for (photo, index) in some.iter().zip(indices) {
        assert_eq!(photo.name, capture.names().nth(index).unwrap());
        assert!(photo.image == all[index].image && photo.mask == all[index].mask);
    }
    // The checksum depends on the view.
    assert_ne!(capture.checksum([0]).unwrap(), capture.checksum([1]).unwrap());
}

#[test]
fn lenses_of_transforms_are_those_of_colmap() {
    let fisheye = "OPENCV_FISHEYE 52 53 39 31 0.03 -0.01 0.002 0.001";
    let fisheye_keys =
        json!({"camera_model": "OPENCV_FISHEYE", "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001});
    let is_fisheye = json!({"is_fisheye": true, "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001});
    let polynomial = [0.03, -0.01, 0.002, 0.001, 0., 0.];
    let list = json!({"camera_model": "opencv_fisheye", "distortion_params": polynomial});
    let longer_list = [polynomial, [0.; 6]].concat();
    let longer_list = json!({"camera_model": "FISHEYE624", "distortion_params": longer_list});
    let full_opencv = json!({
        "camera_model": "FULL_OPENCV",
        "k1": -0.15, "k2": 0.04, "p1": 0.01, "p2": -0.02, "k3": 0.02, "k4": 0.3, "k5": -0.08, "k6": 0.04,
    });
    let equirectangular = json!({"w": 320, "h": 160, "camera_model": "EQUIRECTANGULAR"});
    let set_lens = |t: &mut Value, keys: &Value| {
        let pinhole = json!({"fl_x": 52, "fl_y": 53, "cx": 39, "cy": 31, "w": 80, "h": 60});
        let all = [&pinhole, keys].into_iter().flat_map(|keys| keys.as_object().unwrap());
        all.for_each(|(key, value)| t[key] = value.clone());
    };
    for (lens, size, keys) in [
        ("EQUIRECTANGULAR 320 160", [160, 320], &equirectangular),
        ("FULL_OPENCV 52 53 39 31 -0.15 0.04 0.01 -0.02 0.02 0.3 -0.08 0.04", [60, 80], &full_opencv),
        (fisheye, [60, 80], &fisheye_keys),
        (fisheye, [60, 80], &is_fisheye),
        (fisheye, [60, 80], &list),
        (fisheye, [60, 80], &longer_list),
    ] {
        let folder = capture_of(lens, size);
        let found = open_transforms(folder.path(), |t| set_lens(t, keys)).unwrap();
        let expected = open_capture(&folder.path().join("sparse")).unwrap();
        assert_same_cameras(&found, &expected.cameras());
        let [found, expected] = [found, expected].map(|capture| capture.load_all(None).unwrap());
        for (found, expected) in found.iter().zip(&expected) {
            assert!(found.image == expected.image && found.mask == expected.mask, "{}", found.name);
        }
    }
    // A frame may have a lens of its own. Here, one is said to be a pinhole camera.
    let folder = capture_of(fisheye, [60, 80]);
    let expected = open_capture(&folder.path().join("sparse")).unwrap().load_all(None).unwrap();
    let mixed = open_transforms(folder.path(), |t| {
        set_lens(t, &fisheye_keys);
        (t["frames"][2]["camera_model"], t["frames"][2]["k1"]) = (json!("PINHOLE"), json!(0));
    });
    let mixed = mixed.unwrap();
    let photos = mixed.load_all(None).unwrap();
    let stored = read_image(&folder.path().join("images/002.png")).unwrap();
    assert!(photos[2].image.to_rgb() == stored && photos[1].image == expected[1].image);
    assert_warns(&mixed, &["4 of 5 photos have a fisheye or 360° lens and become 4 pinhole views"]);
}

#[test]
fn photos_of_other_sizes_and_poses_of_paths_keep_the_field_of_view() {
    let folder = capture_of("FISHEYE 40 40 81 79", [160, 160]);
    let expected = open_capture(folder.path()).unwrap().load(&[0], None).unwrap();
    for name in names() {
        let file = folder.path().join("images").join(name);
        let half = imageops::resize(&read_image(&file).unwrap(), 80, 80, FilterType::Triangle);
        half.save(file).unwrap();
    }
    let capture = open_capture(folder.path()).unwrap();
    assert!(capture.warnings()[0].contains("their intrinsics are scaled"), "{:?}", capture.warnings());
    let found = capture.load(&[0], None).unwrap();
    assert_eq!(found[0].camera.intrinsics.fx, 20.);
    let [(found_height, _), (height, _)] = [&found[0], &expected[0]].map(|photo| photo.image.size());
    assert!(found_height.abs_diff(height / 2) <= 1, "{found_height} {height}");
    check_colors(&found[0], 6.);
    // A path has one camera for each pose.
    let path = read_camera_path(folder.path(), None).unwrap();
    assert_eq!(path.cameras.len(), 5);
    assert!(path.cameras.iter().all(|camera| camera.intrinsics.fx == 40. && camera.width == 160));
    let sphere = capture_of("EQUIRECTANGULAR 320 160", [160, 320]);
    assert_refused(read_camera_path(sphere.path(), None), &["the camera of 000.png is EQUIRECTANGULAR"]);
}

#[test]
fn parameters_that_describe_no_lens_are_refused() {
    let (nan, inf) = (f64::NAN, f64::INFINITY);
    // The map 1 / (1 − 3r²) has a pole inside the image, and is steep on either side of it.
    let pole = [250., 250., 165., 115., 0., 0., 0., 0., 0., -3., 0., 0.];
    let cases: [(&str, &[f64], &[&str]); 19] = [
        ("LENS", &[1.], &["model is LENS", "one of SIMPLE_PINHOLE", "EQUIRECTANGULAR"]),
        ("FISHEYE", &[100., 160., 120.], &["the parameters is [100.0", "4 parameters for FISHEYE"]),
        ("SIMPLE_FISHEYE", &[-100., 160., 120.], &["focal length fx is -100", "above 0"]),
        ("SIMPLE_FISHEYE", &[100., 900., 120.], &["principal point cx is 900", "0 to 320"]),
        ("FISHEYE", &[100., nan, 160., 120.], &["focal length fy is NaN"]),
        ("OPENCV_FISHEYE", &[100., 100., 160., 120., nan, 0., 0., 0.], &["the distortion is k [NaN", "0 %"]),
        // The lens folds at 8 degrees.
        ("SIMPLE_RADIAL_FISHEYE", &[100., 160., 120., -17.], &["k [-17.0", "0 % of the photo have a ray"]),
        ("THIN_PRISM_FISHEYE", &[inf; 12], &["focal length fx is inf"]),
        ("FOV", &[100., 100., 160., 120., 3.2], &["omega 3.2", "below π"]),
        ("FOV", &[100., 100., 160., 120., nan], &["omega NaN"]),
        ("DIVISION", &[100., 100., 160., 120., nan], &["k NaN", "0 %"]),
        ("EUCM", &[100., 100., 160., 120., 1.5, 1.], &["alpha 1.5", "from 0 to 1"]),
        ("EUCM", &[100., 100., 160., 120., 0.5, nan], &["beta NaN"]),
        ("EQUIRECTANGULAR", &[320., 240.], &["the size is 320×240 pixels", "twice the height"]),
        ("EQUIRECTANGULAR", &[99., 50.], &["the parameters is [99, 50]", "the size, [320, 160]"]),
        // The map x − x³ turns back at x = 0.577, which lies inside the image.
        ("SIMPLE_RADIAL", &[250., 165., 115., -1.], &["the distortion is k1 -1,", "folds the image over"]),
        ("SIMPLE_RADIAL", &[250., 165., 115., nan], &["k1 NaN,"]),
        ("SIMPLE_RADIAL", &[250., 165., 115., inf], &["k1 inf,"]),
        ("FULL_OPENCV", &pole, &["over [-3.0, 0.0, 0.0]"]),
    ];
    for (model, parameters, parts) in cases {
        let height = if parameters[0] == 99. { 160 } else { 240 };
        let refused = Lens::from_colmap(model, parameters, [height, 320].into()).unwrap_err();
        let error = format!("{} is {}, expected {}", refused.0, refused.1, refused.2);
        parts.iter().for_each(|part| assert!(error.contains(part), "{part:?} is not in: {error}"));
    }
}
