//! SOG: its files, and invalid ones. PlayCanvas' splat-transform reads what is written in parity/tests/test_splat_formats.py.

use super::common::{assert_bytes_refused, assert_refused, assert_says, bytes_of, random_splat, written};
use globalsplat_splat_file::{Splat, read_splat, read_splat_without_invalid, splat_files};
use image_webp::{ColorType, WebPEncoder};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};

fn write_pixels(path: &Path, width: u32, pixels: &[[u8; 4]]) {
    let mut file = vec![];
    let height = pixels.len() as u32 / width;
    WebPEncoder::new(&mut file).encode(pixels.as_flattened(), width, height, ColorType::Rgba8).unwrap();
    fs::write(path, file).unwrap();
}

/// Returns three Gaussians, and the path of their `meta.json`.
fn three(folder: &Path) -> (Splat, PathBuf) {
    let splat = random_splat(3, 1, 1);
    let path = written(folder, "meta.json", &splat);
    (splat, path)
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
        assert_eq!(entry.last_modified().year(), 1980, "not the time of day");
        std::io::copy(&mut &contents[..], &mut compressed).unwrap();
    }
    compressed.finish().unwrap();
    assert_eq!(read_splat(&folder.path().join("b.sog")).unwrap(), unbundled);
    assert!(splat_files(&path).contains(&folder.path().join("quats.webp")) && splat_files(&path).len() == 9);
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
    write_pixels(&file, 2, &[252, 251, 255, 252].map(|mode| [128, 128, 128, mode]));
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
    let mut noise = vec![[0; 4]; 700 * 700];
    StdRng::seed_from_u64(1).fill(noise.as_flattened_mut());
    noise.iter_mut().for_each(|pixel| pixel[3] = 255);
    write_pixels(&small.path().join("means_l.webp"), 700, &noise);
    assert_eq!(read_splat(&bomb).unwrap().len(), 700 * 700);
    fs::write(&file, b"RIFF").unwrap();
    assert_refused(&path, &["quats.webp is damaged"]);
    fs::remove_file(&file).unwrap();
    assert_says(&read_splat(&path).unwrap_err().to_string(), &["quats.webp"]);
    let bundle = bytes_of("sog", &splat);
    assert_bytes_refused("sog", &bundle[..300], &["the file is damaged", "a ZIP archive"]);
    assert_bytes_refused("sog", b"no archive", &["the file is damaged"]);
}
