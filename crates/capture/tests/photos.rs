//! Photos of a capture: undistortion, EXIF orientation, and pixel formats.

use glam::{DMat4, DVec3};
use globalsplat_capture::{Camera, Intrinsics, Result, decode_photo, open_capture};
use globalsplat_test_kit::formats::{
    HEIGHT, WIDTH, assert_same_cameras, cameras, in_images, transforms, write_colmap_text,
};
use image::imageops::{flip_horizontal, rotate90, rotate270};
use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage};
use serde_json::json;
use std::io::Cursor;

/// Returns the distorted image coordinates of the ray (x, y, 1), by OpenCV's rational model and in the notation of its documentation.
fn distort([k1, k2, p1, p2, k3, k4, k5, k6]: [f64; 8], x: f64, y: f64) -> (f64, f64) {
    let r2 = x.powi(2) + y.powi(2);
    let radial = (1. + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3))
        / (1. + k4 * r2 + k5 * r2.powi(2) + k6 * r2.powi(3));
    (
        x * radial + 2. * p1 * x * y + p2 * (r2 + 2. * x.powi(2)),
        y * radial + p1 * (r2 + 2. * y.powi(2)) + 2. * p2 * x * y,
    )
}

/// Returns the x and y of the ray (x, y, 1) whose distorted image coordinates are (u, v), by fixed-point iteration.
fn undistort(lens: [f64; 8], u: f64, v: f64) -> (f64, f64) {
    let (mut x, mut y) = (u, v);
    for _ in 0..200 {
        let (du, dv) = distort(lens, x, y);
        (x, y) = (x + u - du, y + v - dv);
    }
    let (du, dv) = distort(lens, x, y);
    assert!((du - u).abs() < 1e-12 && (dv - v).abs() < 1e-12);
    (x, y)
}

/// Returns the largest absolute difference between the bytes of two images of the same size.
fn largest_difference(a: &RgbImage, b: &RgbImage) -> u8 {
    assert_eq!(a.dimensions(), b.dimensions());
    a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

/// Returns the colour that the ray (x, y, 1) sees, three levels from 7.5 to 247.5.
fn scene(x: f64, y: f64) -> [f64; 3] {
    let wave = |t: f64| 127.5 + 120. * t.sin();
    [wave(6. * x + 2. * y), wave(7. * y - x), wave(4. * x - 5. * y)]
}

#[test]
fn distortion_is_removed_from_the_photos() {
    check_lens([-0.15, 0.04, 0.01, -0.02, 0., 0., 0., 0.]);
    check_lens([0.1, -0.05, 0.01, -0.02, 0.02, 0.3, -0.08, 0.04]);
}

fn check_lens(lens: [f64; 8]) {
    let (width, height) = (160, 120);
    let k = Intrinsics { fx: 110., fy: 115., cx: 83., cy: 58. };
    let camera = Camera { intrinsics: k, c2w: DMat4::IDENTITY, width, height };
    let cameras = [camera, Camera { c2w: DMat4::from_translation(DVec3::X), ..camera }];
    let ray = |x: u32, y: u32| ((f64::from(x) + 0.5 - k.cx) / k.fx, (f64::from(y) + 0.5 - k.cy) / k.fy);
    let render = |ray_of: &dyn Fn(f64, f64) -> (f64, f64)| {
        RgbImage::from_fn(width, height, |x, y| {
            let (x, y) = ray(x, y);
            let (x, y) = ray_of(x, y);
            Rgb(scene(x, y).map(|value| value.round() as u8))
        })
    };
    let (distorted, pinhole) = (render(&|x, y| undistort(lens, x, y)), render(&|x, y| (x, y)));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::create_dir(path.join("images")).unwrap();
    let names = ["a.png".to_string(), "b.png".to_string()];
    names.iter().for_each(|name| distorted.save(path.join("images").join(name)).unwrap());
    let (model, count) = if lens[4..] == [0.; 4] { ("OPENCV", 4) } else { ("FULL_OPENCV", 8) };
    let coefficients = lens[..count].iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let opencv = format!("{model} {} {} {} {} {coefficients}", k.fx, k.fy, k.cx, k.cy);
    let mut contents = transforms(&in_images(&names), &cameras);
    contents["camera_model"] = json!(model);
    for (key, value) in ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"].iter().zip(lens) {
        contents[*key] = json!(value);
    }
    write_colmap_text(&path.join("colmap/sparse/0"), &names, &cameras, &opencv);
    std::os::unix::fs::symlink(path.join("images"), path.join("colmap/images")).unwrap();
    std::fs::write(path.join("transforms.json"), contents.to_string()).unwrap();
    assert!(largest_difference(&distorted, &pinhole) > 50, "the lens hardly distorts");
    for capture in [open_capture(path).unwrap(), open_capture(&path.join("colmap")).unwrap()] {
        assert_same_cameras(&capture, &cameras);
        let found = capture.load(&[1], None).unwrap()[0].image.to_rgb();
        // Number of pixels whose ray falls inside the distorted photo. Other pixels aren't compared.
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
                let (a, b) = (found.get_pixel(x, y), pinhole.get_pixel(x, y));
                // Levels are rounded twice, and interpolated linearly between the photo's pixels.
                assert!(a.0.iter().zip(b.0).all(|(a, b)| a.abs_diff(b) <= 2), "({x}, {y}): {a:?} {b:?}");
            }
        }
        assert!(checked > 9 * width * height / 10, "{checked} pixels");
    }
}

/// Returns a JPEG whose EXIF data has `orientation`.
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

/// Loads the first view of a capture whose photos are all `bytes`, declared to be `width` × `height`.
fn load_photo(bytes: &[u8], extension: &str, width: u32, height: u32) -> Result<RgbImage> {
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..5).map(|i| format!("{i}.{extension}")).collect();
    names.iter().for_each(|name| std::fs::write(folder.path().join(name), bytes).unwrap());
    let cameras = cameras().into_iter().map(|camera| Camera { width, height, ..camera }).collect::<Vec<_>>();
    let file = folder.path().join("transforms.json");
    std::fs::write(&file, transforms(&names, &cameras).to_string()).unwrap();
    Ok(open_capture(&file)?.load(&[0], None)?.remove(0).image.to_rgb())
}

#[test]
fn exif_orientation_is_applied_if_the_declared_size_matches() {
    let photo = RgbImage::from_fn(24, 16, |x, y| Rgb([x as u8 * 10, y as u8 * 15, 90]));
    let stored = image::load_from_memory(&jpeg_with_orientation(&photo, 1)).unwrap().to_rgb8();
    let load = |orientation: u8, width, height| {
        load_photo(&jpeg_with_orientation(&photo, orientation), "jpg", width, height)
    };
    // The top row as stored is the right column with orientation 6, and the left column with 8. Orientation 5 transposes the photo.
    assert!(load(6, 16, 24).unwrap() == rotate90(&stored));
    assert!(load(8, 16, 24).unwrap() == rotate270(&stored));
    assert!(load(5, 16, 24).unwrap() == flip_horizontal(&rotate90(&stored)));
    // If the size is declared as stored, the capture's cameras fit the unrotated photo.
    for orientation in [1, 3, 6, 8] {
        assert!(load(orientation, 24, 16).unwrap() == stored, "{orientation}");
    }
    for (orientation, width, height) in [(1, 16, 24), (3, 16, 24), (6, 20, 24)] {
        let error = load(orientation, width, height).unwrap_err().to_string();
        assert!(error.contains("24×16 pixels") && error.contains(&format!("{width}×{height}")), "{error}");
    }
}

#[test]
fn photos_of_every_color_type_load() {
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
    let expect = |rgb: &dyn Fn(u32, u32) -> [u8; 3]| RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb(rgb(x, y)));
    let repeated = expect(&|x, y| [at(x, y); 3]);
    let kinds: [(DynamicImage, RgbImage); 5] = [
        (grey.clone().into(), repeated.clone()),
        (grey_alpha.into(), expect(&|x, y| [over_black(at(x, y), y); 3])),
        (rgba.into(), expect(&|x, y| [at(x, y), 200, 30].map(|value| over_black(value, y)))),
        (deep.into(), expect(&|x, y| [at(x, y), 255, 30])),
        (deep_grey.into(), repeated.clone()),
    ];
    for (photo, expected) in kinds {
        let mut png = Cursor::new(vec![]);
        photo.write_to(&mut png, ImageFormat::Png).unwrap();
        let found = load_photo(png.get_ref(), "png", WIDTH, HEIGHT).unwrap();
        assert!(found == expected, "{:?} is {} off", photo.color(), largest_difference(&found, &expected));
    }
    let mut jpeg = Cursor::new(vec![]);
    grey.write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
    let found = load_photo(jpeg.get_ref(), "jpeg", WIDTH, HEIGHT).unwrap();
    assert!(
        largest_difference(&found, &repeated) < 13 && found.pixels().all(|pixel| pixel.0[0] == pixel.0[2])
    );
}

/// Returns an image of pseudorandom levels. They compress badly, so that every block of a JPEG takes many bytes.
fn noise(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        Rgb([1, 2, 3]
            .map(|k: u32| ((x * 7919 + y * 104_729 + k * 31).wrapping_mul(2_654_435_761) >> 24) as u8))
    })
}

/// Returns JPEGs of every supported kind: sequential and progressive, with one, three and four components, with and without
/// chroma subsampling, with and without restart markers. The description of each begins with its number of components.
fn jpegs() -> Vec<(String, Vec<u8>)> {
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
    let pixels = noise(45, 37).into_raw();
    let mut jpegs = vec![];
    for (progressive, colours) in
        [false, true].into_iter().flat_map(|p| [1, 3, 4].map(|colours| (p, colours)))
    {
        for sampling in
            [SamplingFactor::F_1_1, SamplingFactor::F_2_1, SamplingFactor::F_2_2, SamplingFactor::F_4_1]
        {
            // The decoder doesn't support subsampling with four components.
            if colours == 4 && !matches!(sampling, SamplingFactor::F_1_1) {
                continue;
            }
            for restart in [0, 3] {
                let (kind, bytes): (ColorType, Vec<u8>) = match colours {
                    1 => (ColorType::Luma, pixels.iter().step_by(3).copied().collect()),
                    3 => (ColorType::Rgb, pixels.clone()),
                    _ => (ColorType::Cmyk, pixels.chunks(3).flat_map(|p| [p[0], p[1], p[2], 40]).collect()),
                };
                let mut jpeg = vec![];
                let mut encoder = Encoder::new(&mut jpeg, 90);
                encoder.set_progressive(progressive);
                encoder.set_sampling_factor(sampling);
                if restart > 0 {
                    encoder.set_restart_interval(restart);
                }
                encoder.set_optimized_huffman_tables(restart == 0);
                encoder.encode(&bytes, 45, 37, kind).unwrap();
                jpegs.push((format!("{colours} {sampling:?} {restart} progressive {progressive}"), jpeg));
            }
        }
    }
    jpegs
}

#[test]
fn truncated_jpegs_are_refused_by_name() {
    let decode = |bytes: &[u8]| decode_photo(bytes, "cut.jpg".as_ref(), (45, 37)).map(|photo| photo.pixels);
    for (kind, jpeg) in jpegs() {
        let whole = decode(&jpeg).unwrap_or_else(|e| panic!("{kind}: {e}"));
        let (data, end) = jpeg.split_at(jpeg.len() - 2);
        assert_eq!(end, [0xff, 0xd9]);
        // The end marker carries no image data.
        for end in [&[][..], &[0xff], &[0xff, 0xd9, 1, 2, 3]] {
            assert_eq!(
                decode(&[data, end].concat()).unwrap_or_else(|e| panic!("{kind}: {e}")),
                whole,
                "{kind}"
            );
        }
        for cut in (jpeg.len() / 16..data.len() - 1).step_by(41).chain([data.len() - 2]) {
            // A progressive JPEG is complete after any of its scans, if a marker follows.
            if (cut - 1..=cut).any(|at| matches!(data[at..], [0xff, 0xc4 | 0xda, ..])) {
                continue;
            }
            for end in [&[][..], end, &[0; 4096]] {
                let error = decode(&[&data[..cut], end].concat());
                let error = match error {
                    Err(error) => error.to_string(),
                    Ok(_) => {
                        panic!("{kind} of {} bytes was accepted after {cut} bytes and {end:?}", jpeg.len())
                    }
                };
                assert!(error.starts_with("cut.jpg: the image is "), "{error}");
            }
        }
    }
}

#[test]
fn truncated_pngs_are_refused_by_name() {
    let mut png = Cursor::new(vec![]);
    noise(45, 37).write_to(&mut png, ImageFormat::Png).unwrap();
    let png = png.into_inner();
    let decode = |bytes: &[u8]| decode_photo(bytes, "cut.png".as_ref(), (45, 37));
    decode(&png).unwrap();
    // The last 20 bytes carry no image data: two checksums of 4 bytes each, and the last chunk of 12 bytes.
    for cut in (0..png.len() - 20).step_by(37) {
        let error = decode(&png[..cut]).expect_err("the file is truncated").to_string();
        assert!(error.starts_with("cut.png: the image is "), "{error}");
    }
}

/// PNG with 24×16 pixels and a palette of 16 colours, in hexadecimal.
const PALETTE_PNG: &str = "89504e470d0a1a0a0000000d4948445200000018000000100403000000fe0aa2a600000030504c5445b4d20078d2003cd200\
    b48c00788c003c8c0000d200008c00b446007846003c4600004600b400007800003c0000000000c5d2909e0000002349444154789c63fccfc0f01e8698\
    1890006e0ecb1ef2f4dc2355cf7b0686b324ea010020e70e8d4441c80f0000000049454e44ae426082";

#[test]
fn as_stored_is_true_only_for_8_bit_rgb() {
    let palette: Vec<u8> = (0..PALETTE_PNG.len())
        .step_by(2)
        .map(|i| u8::from_str_radix(&PALETTE_PNG[i..i + 2], 16).unwrap())
        .collect();
    let as_stored = |bytes: &[u8], size| decode_photo(bytes, "photo".as_ref(), size).unwrap().as_stored;
    assert!(!as_stored(&palette, (WIDTH, HEIGHT)));
    for (kind, jpeg) in jpegs() {
        assert_eq!(as_stored(&jpeg, (45, 37)), kind.starts_with('3'), "{kind}");
    }
    for (image, expected) in [
        (DynamicImage::from(noise(9, 9)), true),
        (DynamicImage::from(noise(9, 9)).to_luma8().into(), false),
        (DynamicImage::from(noise(9, 9)).to_rgba8().into(), false),
        (DynamicImage::from(noise(9, 9)).to_rgb16().into(), false),
    ] {
        let mut png = Cursor::new(vec![]);
        image.write_to(&mut png, ImageFormat::Png).unwrap();
        assert_eq!(as_stored(png.get_ref(), (9, 9)), expected, "{:?}", image.color());
    }
}
