//! Photos of a capture: EXIF orientation, and pixel formats.

use crate::assert_refused;
use globalsplat_capture::{Camera, Result, decode_photo, open_capture, read_image_size};
use globalsplat_test_kit::formats::{HEIGHT, WIDTH, cameras, transforms};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::codecs::webp::WebPEncoder;
use image::imageops::{flip_horizontal, rotate90, rotate270};
use image::{ColorType, DynamicImage, GrayImage, ImageEncoder, ImageFormat, Luma, Rgb, RgbImage};
use std::io::Cursor;
use std::process::Command;

/// Returns a JPEG, a PNG and a WebP of `photo` with the metadata `exif`, each with its extension.
pub fn encode_with_exif(photo: &DynamicImage, exif: &[u8]) -> [(&'static str, Vec<u8>); 3] {
    fn encode(photo: &DynamicImage, mut encoder: impl ImageEncoder, exif: &[u8]) {
        encoder.set_exif_metadata(exif.to_vec()).unwrap();
        photo.write_with_encoder(encoder).unwrap();
    }
    let [mut jpeg, mut png, mut webp] = [vec![], vec![], vec![]];
    encode(photo, JpegEncoder::new(&mut jpeg), exif);
    encode(photo, PngEncoder::new(&mut png), exif);
    encode(photo, WebPEncoder::new_lossless(&mut webp), exif);
    [("jpg", jpeg), ("png", png), ("webp", webp)]
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
    let photo = DynamicImage::from(GrayImage::from_fn(24, 16, |x, y| Luma([x as u8 * 5 + y as u8 * 8])));
    let encode = |orientation: u8| {
        let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0";
        // Older versions of Pillow write such a prefix.
        let prefix = if orientation == 8 { b"Exif\0\0" } else { &b""[..] };
        encode_with_exif(&photo, &[prefix, exif, &[orientation, 0, 0, 0, 0, 0, 0, 0]].concat())
    };
    let stored = encode(1).map(|(extension, bytes)| load_photo(&bytes, extension, 24, 16).unwrap());
    // Orientation 6: the stored top row is the right column; 8: the left one; 5 mirrors across the diagonal. 3 is a half turn,
    // which keeps the size.
    type Turn = fn(&RgbImage) -> RgbImage;
    let mirror: Turn = |stored| flip_horizontal(&rotate90(stored));
    for (orientation, turn) in [(3, None), (5, Some(mirror)), (6, Some(rotate90)), (8, Some(rotate270))] {
        for ((extension, bytes), stored) in encode(orientation).iter().zip(&stored) {
            let load = |width, height| load_photo(bytes, extension, width, height);
            match turn {
                Some(turn) => assert!(load(16, 24).unwrap() == turn(stored), "{extension} {orientation}"),
                None => assert_refused(load(16, 24), &["24×16 pixels", "16×24"]),
            }
            assert_refused(load(20, 24), &["24×16 pixels", "20×24"]);
            // If the size is declared as stored, the capture's cameras fit the unrotated photo.
            assert!(load(24, 16).unwrap() == *stored, "{extension} {orientation}");
        }
    }
}

#[test]
fn photos_of_every_color_type_load() {
    let at = |x: u32, y: u32| (x * 10 + y) as u8;
    let gray = GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([at(x, y)]));
    let alpha = |y: u32| [0, 255, 128][y as usize % 3];
    let gray_alpha = image::GrayAlphaImage::from_fn(WIDTH, HEIGHT, |x, y| image::LumaA([at(x, y), alpha(y)]));
    let rgba = image::RgbaImage::from_fn(WIDTH, HEIGHT, |x, y| image::Rgba([at(x, y), 200, 30, alpha(y)]));
    let deep = image::ImageBuffer::<Rgb<u16>, _>::from_fn(WIDTH, HEIGHT, |x, y| {
        Rgb([u16::from(at(x, y)) * 257 + 100, 65_535, 257 * 30 - 100])
    });
    let deep_gray = DynamicImage::from(gray.clone()).into_luma16();
    let over_black = |value: u8, y: u32| (f64::from(value) * f64::from(alpha(y)) / 255.).round() as u8;
    let expect = |rgb: &dyn Fn(u32, u32) -> [u8; 3]| RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb(rgb(x, y)));
    let repeated = DynamicImage::from(gray.clone()).into_rgb8();
    let kinds: [(DynamicImage, RgbImage); 5] = [
        (gray.clone().into(), repeated.clone()),
        (gray_alpha.into(), expect(&|x, y| [over_black(at(x, y), y); 3])),
        (rgba.into(), expect(&|x, y| [at(x, y), 200, 30].map(|value| over_black(value, y)))),
        (deep.into(), expect(&|x, y| [at(x, y), 255, 30])),
        (deep_gray.into(), repeated.clone()),
    ];
    for (photo, expected) in kinds {
        for (extension, format) in LOSSLESS {
            // The encoder of TIFFs refuses opacity of gray pixels, and that of BMPs drops it.
            if ["bmp", "tif"].contains(&extension) && photo.color() == ColorType::La8 {
                continue;
            }
            let found = load_photo(&encode(&photo, format), extension, WIDTH, HEIGHT).unwrap();
            assert!(found == expected, "{extension}, {:?}", photo.color());
        }
    }
    let jpeg = encode(&gray.into(), ImageFormat::Jpeg);
    let found = load_photo(&jpeg, "jpeg", WIDTH, HEIGHT).unwrap();
    assert_eq!(found.dimensions(), repeated.dimensions());
    assert!(found.as_raw().iter().zip(repeated.as_raw()).all(|(a, b)| a.abs_diff(*b) < 13));
    assert!(found.pixels().all(|pixel| pixel[0] == pixel[2]));
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
    use SamplingFactor::{F_1_1, F_2_1, F_2_2, F_4_1};
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
    let pixels = noise(45, 37).into_raw();
    let kinds: [(usize, ColorType, Vec<u8>, &[SamplingFactor]); 3] = [
        (1, ColorType::Luma, pixels.iter().step_by(3).copied().collect(), &[F_1_1, F_2_1, F_2_2, F_4_1]),
        (3, ColorType::Rgb, pixels.clone(), &[F_1_1, F_2_1, F_2_2, F_4_1]),
        // The decoder doesn't support subsampling with four components.
        (4, ColorType::Cmyk, pixels.chunks(3).flat_map(|p| [p[0], p[1], p[2], 40]).collect(), &[F_1_1]),
    ];
    let mut jpegs = vec![];
    for (colors, kind, bytes, samplings) in &kinds {
        for (&sampling, progressive) in samplings.iter().flat_map(|one| [(one, false), (one, true)]) {
            for restart in [0, 3] {
                let mut jpeg = vec![];
                let mut encoder = Encoder::new(&mut jpeg, 90);
                encoder.set_progressive(progressive);
                encoder.set_sampling_factor(sampling);
                if restart > 0 {
                    encoder.set_restart_interval(restart);
                }
                encoder.set_optimized_huffman_tables(restart == 0);
                encoder.encode(bytes, 45, 37, *kind).unwrap();
                jpegs.push((format!("{colors} {sampling:?} {restart} progressive {progressive}"), jpeg));
            }
        }
    }
    jpegs
}

#[test]
fn jpegs_cut_short_are_refused_by_name() {
    let decode = |bytes: &[u8]| decode_photo(bytes, "cut.jpg".as_ref(), (45, 37)).map(|photo| photo.pixels);
    for (kind, jpeg) in jpegs() {
        let whole = decode(&jpeg).unwrap_or_else(|e| panic!("{kind}: {e}"));
        let (data, end) = jpeg.split_at(jpeg.len() - 2);
        assert_eq!(end, [0xff, 0xd9]);
        let longer = decode(&[&jpeg, &[1, 2, 3][..]].concat()).unwrap_or_else(|e| panic!("{kind}: {e}"));
        assert_eq!(longer, whole, "{kind}");
        for cut in (jpeg.len() / 16..data.len() - 1).step_by(41).chain([data.len()]) {
            for end in [&[][..], &[0; 4096]] {
                assert_refused(decode(&[&data[..cut], end].concat()), &["cut.jpg: the image is "]);
            }
        }
    }
}

/// Formats that keep every pixel, with their extensions.
const LOSSLESS: [(&str, ImageFormat); 4] = [
    ("png", ImageFormat::Png),
    ("tif", ImageFormat::Tiff),
    ("webp", ImageFormat::WebP),
    ("bmp", ImageFormat::Bmp),
];

pub fn encode(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![]);
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

#[test]
fn photos_of_other_formats_cut_short_are_refused_by_name() {
    let mut files = vec![("lossy.webp", bytes_of_hex(LOSSY_WEBP))];
    files.extend(LOSSLESS.map(|(extension, format)| (extension, encode(&noise(24, 16).into(), format))));
    for (name, bytes) in files {
        let decode = |bytes: &[u8]| decode_photo(bytes, name.as_ref(), (24, 16));
        decode(&bytes).unwrap();
        // The last 20 bytes of a PNG carry no image data.
        for cut in (0..bytes.len() - 20).step_by(7) {
            assert_refused(decode(&bytes[..cut]), &[&format!("{name}: the image is ")]);
        }
    }
}

/// PNG with 24×16 pixels of 16 colors in a palette, as hexadecimal.
const PALETTE_PNG: &str = "89504e470d0a1a0a0000000d4948445200000018000000100403000000fe0aa2a600000030504c5445b4d20078d2003cd200\
    b48c00788c003c8c0000d200008c00b446007846003c4600004600b400007800003c0000000000c5d2909e0000002349444154789c63fccfc0f01e8698\
    1890006e0ecb1ef2f4dc2355cf7b0686b324ea010020e70e8d4441c80f0000000049454e44ae426082";

/// Lossy WebP with 24×16 pixels, the left half transparent, as hexadecimal.
const LOSSY_WEBP: &str = "52494646a200000057454250565038580a000000100000001700000f0000414c504814000000010f30ff1111424840f8bfd603dd82\
    88fe0736035650382068000000d003009d012a180010003e6d2c9345a422a19804004006c4b6004e99423b9bc9409639f831f70000feffd1ccd13fe8b966\
    3b7ab8479282ee615374978fffec95afb239ef25d35e1db971e4cfe0cee79dfbbfead0c3ce4254a821ee87a9c0d95a62e5195df9f40000";

fn bytes_of_hex(digits: &str) -> Vec<u8> {
    (0..digits.len()).step_by(2).map(|i| u8::from_str_radix(&digits[i..i + 2], 16).unwrap()).collect()
}

#[test]
fn only_photos_of_plain_colors_are_as_stored() {
    let image = DynamicImage::from(noise(45, 37));
    let png = |image: DynamicImage| encode(&image, ImageFormat::Png);
    let opaque = png(image.to_rgba8().into());
    assert!(decode_photo(&opaque, "photo".as_ref(), (45, 37)).unwrap().alpha.is_none());
    let mut files = vec![
        ("a palette".to_string(), bytes_of_hex(PALETTE_PNG), false),
        ("gray".into(), png(image.to_luma8().into()), false),
        ("opacity".into(), opaque, false),
        ("16 bits".into(), png(image.to_rgb16().into()), false),
        ("RGB".into(), png(image), true),
    ];
    files.extend(jpegs().into_iter().map(|(kind, jpeg)| (kind.clone(), jpeg, kind.starts_with('3'))));
    for (kind, bytes, expected) in files {
        let found = decode_photo(&bytes, "photo".as_ref(), (45, 37)).unwrap().is_verbatim;
        assert_eq!(found, expected, "{kind}");
    }
}

#[test]
fn lossy_webp_has_colors_and_opacity() {
    let webp = bytes_of_hex(LOSSY_WEBP);
    let photo = decode_photo(&webp, "lossy.webp".as_ref(), (24, 16)).unwrap();
    let alpha = photo.alpha.unwrap();
    assert!(alpha.enumerate_pixels().all(|(x, _, alpha)| alpha[0] == if x < 12 { 0 } else { 255 }));
    // By another decoder, up to rounding: the color where the photo is opaque, black where it isn't.
    for (x, expected) in [(0, [0; 3]), (13, [135, 121, 96]), (23, [228, 124, 93])] {
        let found = photo.pixels.get_pixel(x, 8).0;
        assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) < 6), "{x}: {found:?}");
    }
    assert!(!photo.is_verbatim);
}

#[test]
fn floating_point_pixels_are_refused() {
    let tiff = encode(&DynamicImage::from(noise(9, 9)).to_rgb32f().into(), ImageFormat::Tiff);
    let found = "deep.tif: the image is with floating-point pixels, expected 8 or 16 bits";
    assert_refused(decode_photo(&tiff, "deep.tif".as_ref(), (9, 9)), &[found]);
}

#[test]
fn photos_have_256_megapixels_at_most() {
    let mut bmp = encode(&noise(9, 9).into(), ImageFormat::Bmp);
    // 200 megapixels, as of phones, whose data are missing; and a number that no sensor has.
    for (width, height, expected) in [
        (16_320u32, 12_240u32, "undecodable ("),
        (16_000, 16_001, "16000×16001 pixels, more than 256 megapixels, "),
    ] {
        bmp[18..26].copy_from_slice(&[width.to_le_bytes(), height.to_le_bytes()].concat());
        assert_refused(
            decode_photo(&bmp, "large.bmp".as_ref(), (width, height)),
            &[&format!("large.bmp: the image is {expected}")],
        );
    }
}

#[track_caller]
fn assert_red_and_blue(image: &RgbImage, red: (u32, u32), blue: (u32, u32)) {
    for ((x, y), expected) in [(red, [220, 30, 20]), (blue, [20, 40, 230])] {
        let found = image.get_pixel(x, y).0;
        assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) < 20), "{found:?} for {expected:?}");
    }
}

#[test]
fn heic_and_avif_are_decoded_by_libheif() {
    let folder = tempfile::tempdir().unwrap();
    let [png, file] = ["photo.png", "photo.heif"].map(|name| folder.path().join(name));
    let photo = RgbImage::from_fn(96, 64, |x, _| Rgb(if x < 48 { [220, 30, 20] } else { [20, 40, 230] }));
    photo.save(&png).unwrap();
    for (extension, options) in [("heic", &["-q", "90"][..]), ("avif", &["-A", "-q", "90"])] {
        let encoded = Command::new("heif-enc").args(options).arg(&png).arg("-o").arg(&file).output();
        if !encoded.is_ok_and(|output| output.status.success()) {
            let why = "no heif-enc that writes HEIC and AVIF is on the PATH";
            return globalsplat_test_kit::skip("libheif", why);
        }
        let mut heif = std::fs::read(&file).unwrap();
        assert_eq!(read_image_size(&file).unwrap(), (96, 64));
        assert_red_and_blue(&load_photo(&heif, extension, 96, 64).unwrap(), (8, 30), (90, 30));
        for cut in (24..heif.len()).step_by(heif.len() / 8) {
            let error = decode_photo(&heif[..cut], "cut.heic".as_ref(), (96, 64));
            assert_refused(error, &["cut.heic: the image is undecodable ("]);
        }
        // A rotation by a quarter turn in place of a description of the channels, both of which have a box of 16 bytes.
        let channels = heif.windows(4).position(|bytes| bytes == b"pixi").unwrap();
        heif[channels..][..8].copy_from_slice(b"irot\x01\0\0\0");
        std::fs::write(&file, &heif).unwrap();
        assert_eq!(read_image_size(&file).unwrap(), (64, 96));
        // Counterclockwise: the left half comes to the bottom.
        assert_red_and_blue(&load_photo(&heif, extension, 64, 96).unwrap(), (30, 90), (30, 8));
    }
}

#[test]
fn a_heic_without_pixels_is_refused_in_a_sentence() {
    // A header of 64×48 pixels and no data.
    let part =
        |kind: &[u8], contents: &[u8]| [&(contents.len() as u32 + 8).to_be_bytes(), kind, contents].concat();
    let size = part(b"ispe", &[0, 0, 0, 0, 0, 0, 0, 64, 0, 0, 0, 48]);
    let properties = part(b"iprp", &part(b"ipco", &size));
    let heic =
        [part(b"ftyp", b"heic\0\0\0\0mif1"), part(b"meta", &[&[0; 4], &properties[..]].concat())].concat();
    let expected = "expected a JPEG or PNG, or libheif on the PATH";
    let parts = ["photo.heic: the image is undecodable (", expected];
    assert_refused(decode_photo(&heic, "photo.heic".as_ref(), (64, 48)), &parts);
}
