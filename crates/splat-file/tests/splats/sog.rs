//! SOG: the values of its images, and invalid files.

use super::common::{
    Random, assert_bytes_refused, assert_refused, assert_says, bytes_of, largest_error, written,
};
use globalsplat_splat_file::{Splat, read_splat, read_splat_without_invalid, splat_files};
use image_webp::{ColorType, WebPDecoder, WebPEncoder};
use serde_json::{Value, json};
use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

fn pixels(path: &Path) -> (u32, Vec<[u8; 4]>) {
    let mut decoder = WebPDecoder::new(Cursor::new(fs::read(path).unwrap())).unwrap();
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let mut bytes = vec![0; decoder.output_buffer_size().unwrap()];
    decoder.read_image(&mut bytes).unwrap();
    let pixel = |pixel: &[u8]| [pixel[0], pixel[1], pixel[2], pixel.get(3).copied().unwrap_or(255)];
    (decoder.dimensions().0, bytes.chunks_exact(channels).map(pixel).collect())
}

fn write_pixels(path: &Path, width: u32, pixels: &[[u8; 4]]) {
    let mut file = vec![];
    let height = pixels.len() as u32 / width;
    WebPEncoder::new(&mut file).encode(pixels.as_flattened(), width, height, ColorType::Rgba8).unwrap();
    fs::write(path, file).unwrap();
}

/// Returns three Gaussians whose largest component of the rotation is w, x and z, and the path of their `meta.json`.
fn three(folder: &Path) -> (Splat, PathBuf) {
    let splat = Splat::new(
        1,
        vec![[0., -1., 10.], [1., 0., 20.], [-3., 1., 30.]],
        vec![[-1., -2., -3.], [-4., -5., -6.], [-1., -1., -1.]],
        vec![[0.9, 0.1, 0.2, 0.3], [0.1, -0.9, 0.2, 0.3], [0.1, 0.2, 0.3, 0.9]],
        vec![0., 2., -30.],
        (0..12).map(|k| [0, 1, 2].map(|channel| (3 * k + channel) as f32 / 40. - 0.4)).collect(),
    )
    .unwrap();
    let path = written(folder, "meta.json", &splat);
    (splat, path)
}

/// The images have the values that the format's description says, for each Gaussian in the same pixel.
#[test]
fn a_sog_is_as_documented() {
    let folder = tempfile::tempdir().unwrap();
    let (splat, path) = three(folder.path());
    let meta: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    assert_eq!([&meta["version"], &meta["count"], &meta["antialias"]], [&json!(2), &json!(3), &json!(false)]);
    let image = |name: &str| pixels(&folder.path().join(name));
    let (width, quats) = image("quats.webp");
    assert_eq!((width, quats.len()), (2, 4));
    // Gaussians by their second coordinate of the position, from 0 at the lower bound to 65,535 at the upper bound.
    let [low, high] = ["means_l.webp", "means_u.webp"].map(|name| image(name).1);
    let y = |pixel: usize| u16::from_le_bytes([low[pixel][1], high[pixel][1]]);
    let pixel_of: Vec<usize> = [0u16, 32_768, 65_535]
        .iter()
        .map(|expected| (0..3).find(|&pixel| y(pixel) == *expected).unwrap())
        .collect();
    assert_eq!(meta["means"]["mins"][1], json!(-(2f64.ln())));
    assert_eq!(meta["means"]["maxs"][2], json!(31f64.ln()));
    let length = 0.95f64.sqrt();
    let byte = |part: f64| ((part / length / 2f64.sqrt() + 0.5) * 255.).round() as u8;
    let [a, b, c] = [0.1, 0.2, 0.3].map(byte);
    assert_eq!(quats[pixel_of[0]], [a, b, c, 252]);
    assert_eq!(quats[pixel_of[1]], [byte(-0.1), byte(-0.2), byte(-0.3), 253], "the sign of x is positive");
    assert_eq!(quats[pixel_of[2]], [a, b, c, 255]);
    let codebook = |entry: &Value| -> Vec<f32> { serde_json::from_value(entry["codebook"].clone()).unwrap() };
    let (scales, colors, rest) = (codebook(&meta["scales"]), codebook(&meta["sh0"]), codebook(&meta["shN"]));
    assert_eq!([scales.len(), colors.len(), rest.len()], [256; 3]);
    let (scale_pixels, color_pixels) = (image("scales.webp").1, image("sh0.webp").1);
    let (labels, centroids) = (image("shN_labels.webp").1, image("shN_centroids.webp"));
    assert_eq!(centroids.0, 64 * 3);
    for (index, &pixel) in pixel_of.iter().enumerate() {
        let values = |codebook: &[f32], pixel: [u8; 4]| [0, 1, 2].map(|k| codebook[usize::from(pixel[k])]);
        assert_eq!(values(&scales, scale_pixels[pixel]), splat.log_scales[index]);
        assert_eq!(values(&colors, color_pixels[pixel]), splat.sh_of(index)[0]);
        assert_eq!(color_pixels[pixel][3], [128, 225, 0][index], "opacity");
        let label = usize::from(u16::from_le_bytes([labels[pixel][0], labels[pixel][1]]));
        for k in 0..3 {
            assert_eq!(values(&rest, centroids.1[label * 3 + k]), splat.sh_of(index)[1 + k]);
        }
    }
    let files = splat_files(&path);
    assert!(files.contains(&folder.path().join("quats.webp")) && files.len() == 9, "{files:?}");
}

/// The archive holds the same files, and archives with compressed entries are read, too.
#[test]
fn bundles_hold_the_same_files() {
    let folder = tempfile::tempdir().unwrap();
    let (splat, path) = three(folder.path());
    let bundle = written(folder.path(), "a.sog", &splat);
    let unbundled = read_splat(&path).unwrap();
    assert_eq!(read_splat(&bundle).unwrap(), unbundled);
    let mut archive = zip::ZipArchive::new(fs::File::open(&bundle).unwrap()).unwrap();
    assert_eq!(archive.len(), 8);
    let mut compressed = zip::ZipWriter::new(fs::File::create(folder.path().join("b.sog")).unwrap());
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).unwrap();
        let beside = fs::read(folder.path().join(entry.name())).unwrap();
        let options = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        compressed.start_file(entry.name(), options).unwrap();
        let mut contents = vec![];
        std::io::copy(&mut entry, &mut contents).unwrap();
        assert_eq!(contents, beside, "{}", entry.name());
        std::io::copy(&mut &contents[..], &mut compressed).unwrap();
    }
    compressed.finish().unwrap();
    assert_eq!(read_splat(&folder.path().join("b.sog")).unwrap(), unbundled);
    assert!(largest_error(unbundled.means.as_flattened(), splat.means.as_flattened()) < 25.);
}

/// Changes the `meta.json` at `path`.
fn change_meta(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut meta = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    change(&mut meta);
    fs::write(path, meta.to_string()).unwrap();
}

#[test]
fn bad_metas() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = three(folder.path());
    let whole = fs::read(&path).unwrap();
    for (pointer, value, message) in [
        ("/version", json!(1), "the version in meta.json is 1, expected 2"),
        ("/count", json!(-3), "-3"),
        ("/count", json!(5), "pixels of means_l.webp is 4, expected 5"),
        ("/count", json!(u64::MAX), "expected 18446744073709551615"),
        ("/scales", json!({}), "codebook"),
        ("/scales/codebook", json!([1.]), "an index in scales.webp"),
        ("/quats/files", json!(["../quats.webp"]), "expected a name without a folder"),
        ("/shN/bands", json!(4), "shN.bands is 4, expected 1 to 3"),
        ("/shN/bands", json!(2), "the width of shN_centroids.webp is 192, expected 512"),
        ("/shN/count", json!(2), "an index in shN_labels.webp is 2, expected less than 2"),
        ("/shN/count", json!(65), "shN_centroids.webp is 192 pixels"),
        ("/shN/count", json!(u64::MAX / 3 + 1), "shN.count is 6148914691236517206, expected 1 to 65536"),
        ("/means/maxs", json!([200., 1., 40.]), "the position of Gaussian"),
        // Version 1 has no number.
        ("", json!([1]), "the version in meta.json is missing"),
        ("", json!({"means": {"shape": [3, 3]}}), "the version in meta.json is missing"),
    ] {
        fs::write(&path, &whole).unwrap();
        change_meta(&path, |meta| *meta.pointer_mut(pointer).unwrap() = value);
        assert_refused(&path, &[message]);
    }
}

#[test]
fn bad_images_and_archives() {
    let folder = tempfile::tempdir().unwrap();
    let (splat, path) = three(folder.path());
    let file = folder.path().join("quats.webp");
    let (width, mut quats) = pixels(&file);
    quats[1][3] = 251;
    write_pixels(&file, width, &quats);
    assert_refused(&path, &["the rotation of Gaussian 1 is NaN"]);
    assert_eq!(read_splat_without_invalid(&path).unwrap().len(), 2);
    write_pixels(&file, 1000, &vec![[9; 4]; 1_000_000]);
    assert_refused(&path, &["quats.webp is of 1000×1000 pixels, expected about as many"]);
    // As many pixels as the Gaussians that the file claims, from a few bytes, which only positions may not be.
    let small = tempfile::tempdir().unwrap();
    let (_, bomb) = three(small.path());
    for name in ["means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp", "shN_labels.webp"] {
        write_pixels(&small.path().join(name), 700, &vec![[0, 0, 0, 255]; 700 * 700]);
    }
    change_meta(&bomb, |meta| meta["count"] = json!(700 * 700));
    assert_refused(&bomb, &["means_l.webp is of 700×700 pixels", "256 times the bytes"]);
    let mut random = Random::new(1);
    let mut noise = || (random.uniform() * 256.) as u8;
    let pixels: Vec<[u8; 4]> = (0..700 * 700).map(|_| [noise(), noise(), noise(), 255]).collect();
    write_pixels(&small.path().join("means_l.webp"), 700, &pixels);
    assert_eq!(read_splat(&bomb).unwrap().len(), 700 * 700);
    fs::write(&file, b"RIFF").unwrap();
    assert_refused(&path, &["quats.webp is damaged"]);
    fs::remove_file(&file).unwrap();
    let error = read_splat(&path).unwrap_err().to_string();
    assert_says(&error, &["quats.webp"]);
    let bundle = bytes_of("sog", &splat);
    assert_bytes_refused("sog", &bundle[..300], &["the file is damaged", "a ZIP archive"]);
    assert_bytes_refused("sog", b"no archive", &["the file is damaged"]);
}
