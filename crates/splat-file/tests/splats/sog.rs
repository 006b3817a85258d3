//! SOG: its files, and invalid ones. PlayCanvas' splat-transform reads what is written in parity/tests/test_splat_formats.py.

use super::common::{assert_bytes_refused, assert_refused, assert_says, bytes_of, random_splat, written};
use globalsplat_files::stored_zip;
use globalsplat_splat_file::{Splat, read_splat, read_splat_without_invalid, splat_files};
use image_webp::{ColorType, WebPEncoder};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use serde_json::{Value, json};
use std::fs;
use std::io::Write;
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

/// An archive may have its files in a folder, as macOS and Windows compress it, and be called `.zip`.
#[test]
fn bundles_may_have_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = three(folder.path());
    let files = splat_files(&path).into_iter().filter(|file| file.is_file());
    let files: Vec<_> = files.map(|file| (file.clone(), fs::read(file).unwrap())).collect();
    let bundle = folder.path().join("a.ZIP");
    let write = |folders: &[&str], other: &str| {
        let name = |folder: &str, file: &Path| format!("{folder}{}", file.file_name().unwrap().display());
        let of_folder = |folder| files.iter().map(move |(file, bytes)| (name(folder, file), &bytes[..]));
        let all = folders.iter().flat_map(|folder| of_folder(*folder));
        fs::write(&bundle, stored_zip(all.chain([(other.into(), &b"no JSON"[..])]), 1)).unwrap();
    };
    let expected = read_splat(&path).unwrap();
    for (folder, other) in
        [("room/", "__MACOSX/room/._meta.json"), ("a\\b\\", "x/__MACOSX/meta.json"), ("", "old/meta.json")]
    {
        write(&[folder], other);
        assert_eq!(read_splat(&bundle).unwrap(), expected, "{folder:?}");
    }
    for folders in [&["a/", "b/"][..], &[]] {
        write(folders, "room.ply");
        let message = format!("a.ZIP: the archive is with {} files meta.json, expected one", folders.len());
        assert_refused(&bundle, &[&message, "other splats are read without an archive"]);
    }
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
        ("/version", json!(3), "the version in meta.json is 3, expected 1 or 2"),
        ("/count", json!(-3), "-3"),
        ("/count", json!(5), "pixels of means_l.webp is 4, expected 5"),
        ("/count", json!(u64::MAX), "the number of Gaussians is 18446744073709551615"),
        ("/count", json!(null), "the number of Gaussians is missing"),
        ("/count", json!(0), "the number of Gaussians is 0, expected 1 or more"),
        ("/scales/codebook", json!([]), "scales.codebook is missing"),
        ("/scales/codebook", json!([null, null]), "entry 0 of scales.codebook is null"),
        ("/shN/codebook/255", json!(null), "entry 255 of shN.codebook is null"),
        ("/scales/codebook", json!([1.]), "an index in scales.webp"),
        ("/quats/files", json!(["../quats.webp"]), "expected a name without a folder"),
        ("/shN/bands", json!(2), "shN.bands is 2, expected 1 for the width of shN_centroids.webp, 192"),
        ("/shN/files/0", json!("sh0.webp"), "the width of sh0.webp is 2, expected 192, 512 or 960"),
        ("/shN/count", json!(2), "an index in shN_labels.webp is 2, expected less than 2"),
        ("/shN/count", json!(65), "shN.count is 65, expected 64 at most, as in shN_centroids.webp"),
        ("/means/maxs", json!([200., 1., 40.]), "the position of Gaussian"),
        ("", json!([1]), "meta.json is incomplete"),
        ("", json!({"means": {"shape": [3, 3]}}), "meta.json is incomplete"),
    ] {
        fs::write(&path, &whole).unwrap();
        change_meta(&path, |meta| *meta.pointer_mut(pointer).unwrap() = value);
        assert_refused(&path, &[message]);
    }
}

/// Programs write numbers and absent values in several ways.
#[test]
fn metas_may_have_decimals_and_null() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = three(folder.path());
    let expected = read_splat(&path).unwrap();
    change_meta(&path, |meta| (meta["version"], meta["antialias"]) = (json!(2.0), json!(null)));
    assert_eq!(read_splat(&path).unwrap(), expected);
}

/// An early program wrote null for the first entry of a codebook, which PlayCanvas' engine extrapolates.
#[test]
fn the_first_entry_of_a_codebook_may_be_null() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = three(folder.path());
    let [expected, read] = [json!(0), json!(null)].map(|first| {
        change_meta(&path, |meta| {
            for name in ["scales", "sh0", "shN"] {
                let codebook = &mut meta[name]["codebook"];
                (codebook[0], codebook[1], codebook[255]) = (first.clone(), json!(0.5), json!(128));
            }
        });
        read_splat(&path).unwrap()
    });
    assert_eq!(read, expected);
}

/// In version 1, bytes are equal steps between bounds, which each channel or all coefficients have, and opacities are logits.
#[test]
fn version_1_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = three(folder.path());
    change_meta(&path, |meta| {
        for name in ["scales", "sh0", "shN"] {
            meta[name]["codebook"] = (0..256).collect();
        }
    });
    let bytes = read_splat(&path).unwrap();
    let (scales, sh0) = ([[-4., -1.], [-5., -1.], [-6., -2.]], [[-2., 2.], [-1., 3.], [0., 1.], [-5., 5.]]);
    let rest = [-0.5, 0.5];
    change_meta(&path, |meta| {
        let (mut means, quats) = (meta["means"].take(), meta["quats"].take());
        means["shape"] = json!([3, 3]);
        let ends = |bounds: &[[f64; 2]], end: usize| bounds.iter().map(|bound| bound[end]).collect::<Value>();
        let [scale_files, sh0_files, rest_files] =
            ["scales", "sh0", "shN"].map(|name| meta[name]["files"].take());
        *meta = json!({
            "means": means,
            "quats": quats,
            "scales": {"mins": ends(&scales, 0), "maxs": ends(&scales, 1), "files": scale_files},
            "sh0": {"mins": ends(&sh0, 0), "maxs": ends(&sh0, 1), "files": sh0_files},
            "shN": {"mins": rest[0], "maxs": rest[1], "files": rest_files},
        });
    });
    let read = read_splat(&path).unwrap();
    let value = |[min, max]: [f64; 2], byte: f32| (min + (max - min) * f64::from(byte) / 255.) as f32;
    let values = |bounds: &[[f64; 2]], bytes: [f32; 3]| {
        [0, 1, 2].map(|channel| value(bounds[channel], bytes[channel]))
    };
    for index in 0..3 {
        assert_eq!(read.log_scales[index], values(&scales, bytes.log_scales[index]));
        let (dc, others) = bytes.sh_of(index).split_first().unwrap();
        assert_eq!(read.sh_of(index)[0], values(&sh0, *dc));
        let expected: Vec<_> = others.iter().map(|&of_basis| values(&[rest; 3], of_basis)).collect();
        assert_eq!(read.sh_of(index)[1..], expected);
        assert_eq!(read.opacity_logits[index], value(sh0[3], (bytes.opacity(index) * 255.).round()));
    }
    assert_eq!((read.means, read.quaternions), (bytes.means, bytes.quaternions));
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
    assert_refused(&path, &["quats.webp is of 1000×1000 pixels, expected 262156 at most"]);
    // As many pixels as the Gaussians that the file claims, from a few bytes.
    let small = tempfile::tempdir().unwrap();
    let (_, bomb) = three(small.path());
    for name in ["means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp", "shN_labels.webp"] {
        write_pixels(&small.path().join(name), 700, &vec![[0, 0, 0, 255]; 700 * 700]);
    }
    change_meta(&bomb, |meta| meta["count"] = json!(700 * 700));
    assert_refused(
        &bomb,
        &["the number of Gaussians is 490000", "expected at most 16 MiB plus 256 times the file's "],
    );
    // Zeros after an image, which an archive compresses, and other files allow for no more.
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(vec![]));
    for file in splat_files(&bomb).iter().filter(|file| file.is_file()) {
        let name = file.file_name().unwrap().to_str().unwrap();
        archive.start_file(name, zip::write::FileOptions::default()).unwrap();
        let padding = vec![0; if name == "means_l.webp" { 1 << 19 } else { 0 }];
        archive.write_all(&[fs::read(file).unwrap(), padding].concat()).unwrap();
    }
    let stored = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored);
    archive.start_file("other", stored).unwrap();
    archive.write_all(&[0; 1 << 20]).unwrap();
    let archive = archive.finish().unwrap().into_inner();
    assert_bytes_refused("sog", &archive, &["the number of Gaussians is 490000"]);
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
