//! Every reader of files from elsewhere, on any bytes: for the fuzzers, and for the seeds that they left.
//!
//! A reader may refuse what it gets, or take it, and then what it took has to load or be refused as well.

use globalsplat::config::Config;
use globalsplat::data::{Capture, Chunk, Dataset, Split, open_capture, read_camera_path};
use globalsplat::eval::EvaluationIndex;
use globalsplat::io::{decode_photo, read_splat, read_weights};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Reads whatever it is given.
pub type Reader = fn(&[u8]);

/// By the names of fuzz targets and of the folders of their seeds.
pub const READERS: [(&str, Reader); 11] = [
    ("cameras_json", cameras_json),
    ("chunk", chunk),
    ("colmap_binary", colmap_binary),
    ("colmap_text", colmap_text),
    ("configuration", configuration),
    ("dataset_index", dataset_index),
    ("evaluation_index", evaluation_index),
    ("photo", photo),
    ("ply", ply),
    ("transforms_json", transforms_json),
    ("weights", weights),
];

/// Where readers find their files: in memory, where the system has such a place.
pub fn root() -> &'static Path {
    static ROOT: OnceLock<PathBuf> = OnceLock::new();
    ROOT.get_or_init(|| {
        let memory = Path::new("/dev/shm");
        let place = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        place.join(format!("globalsplat-readers-{}", std::process::id()))
    })
}

/// A folder with `images/000.png` to `images/002.png`, 8×8, one for each reader.
fn folder(reader: &str) -> PathBuf {
    let folder = root().join(reader);
    let images = folder.join("images");
    if !images.is_dir() {
        fs::create_dir_all(&images).unwrap();
        for i in 0..3 {
            image::RgbImage::new(8, 8).save(images.join(format!("{i:03}.png"))).unwrap();
        }
    }
    folder
}

/// `bytes` as a file of `reader`'s folder.
fn file(reader: &str, name: &str, bytes: &[u8]) -> PathBuf {
    let file = folder(reader).join(name);
    fs::create_dir_all(file.parent().unwrap()).unwrap();
    fs::write(&file, bytes).unwrap();
    file
}

fn load(capture: &Capture) {
    for index in 0..capture.len().min(2) {
        let _ = capture.load(&[index], Some([16, 16].into()));
    }
}

pub fn cameras_json(bytes: &[u8]) {
    let file = file("cameras_json", "cameras.json", bytes);
    let _ = open_capture(&file).map(|capture| load(&capture));
    let _ = read_camera_path(&file);
}

pub fn transforms_json(bytes: &[u8]) {
    let _ = open_capture(&file("transforms_json", "transforms.json", bytes)).map(|capture| load(&capture));
}

pub fn chunk(bytes: &[u8]) {
    let Ok(chunk) = Chunk::parse(Path::new("chunk.torch"), bytes.to_vec()) else { return };
    for key in chunk.keys().take(2) {
        let _ = chunk.capture(key).map(|capture| load(&capture));
    }
}

/// Both of a model's files in one: how long the first is, in two bytes, then one after the other.
fn colmap(reader: &str, bytes: &[u8], ending: &str) {
    let Some((length, rest)) = bytes.split_first_chunk::<2>() else { return };
    let (cameras, images) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
    file(reader, &format!("sparse/0/cameras.{ending}"), cameras);
    file(reader, &format!("sparse/0/images.{ending}"), images);
    let _ = open_capture(&folder(reader)).map(|capture| load(&capture));
}

pub fn colmap_binary(bytes: &[u8]) {
    colmap("colmap_binary", bytes, "bin");
}

pub fn colmap_text(bytes: &[u8]) {
    colmap("colmap_text", bytes, "txt");
}

pub fn dataset_index(bytes: &[u8]) {
    let file = file("dataset_index", "index.json", bytes);
    let Ok(dataset) = Dataset::open(file.parent().unwrap(), Split::Train) else { return };
    for group in dataset.groups().iter().take(2) {
        let _ = group.open();
    }
}

pub fn evaluation_index(bytes: &[u8]) {
    let _ = EvaluationIndex::read(&file("evaluation_index", "index.json", bytes));
}

pub fn photo(bytes: &[u8]) {
    let _ = decode_photo(bytes, Path::new("photo.jpg"), (8, 8));
}

pub fn ply(bytes: &[u8]) {
    let _ = read_splat(&file("ply", "splat.ply", bytes));
}

pub fn weights(bytes: &[u8]) {
    let _ = read_weights(&file("weights", "model.safetensors", bytes));
}

pub fn configuration(bytes: &[u8]) {
    let _ = std::str::from_utf8(bytes).map(|text| Config::parse(text, &[], Path::new("config.toml")));
}
