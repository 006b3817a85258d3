//! Every reader of files from elsewhere, on any bytes: for the fuzzers, and for the seeds that they left.
//!
//! A reader may refuse what it gets, or take it, and then what it took has to load or be refused as well. Some are given the
//! bytes of a file. Others, `made_…`, are given bytes out of which a file of the right form is made, checksums and magic
//! numbers included, with mistakes only where they were drawn.

mod files;
mod made_captures;
mod made_chunks;
mod made_configurations;
mod made_models;
mod made_spzs;

use globalsplat::data::Capture;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Reads whatever it is given.
pub type Reader = fn(&[u8]);

/// By the names of fuzz targets and of the folders of their seeds.
pub const READERS: [(&str, Reader); 30] = [
    ("antimatter", files::antimatter),
    ("camera_path", files::camera_path),
    ("cameras_json", files::cameras_json),
    ("checkpoint", files::checkpoint),
    ("chunk", files::chunk),
    ("chunk_pickle", made_chunks::chunk_pickle),
    ("colmap_binary", files::colmap_binary),
    ("colmap_points", files::colmap_points),
    ("colmap_text", files::colmap_text),
    ("compressed_ply", files::compressed_ply),
    ("configuration", files::configuration),
    ("dataset_index", files::dataset_index),
    ("evaluation", files::evaluation),
    ("evaluation_index", files::evaluation_index),
    ("made_cameras", made_captures::cameras),
    ("made_chunk", made_chunks::chunk),
    ("made_colmap", made_captures::colmap),
    ("made_configuration", made_configurations::configuration),
    ("made_ply", made_models::ply),
    ("made_spz", made_spzs::spz),
    ("made_transforms", made_captures::transforms),
    ("made_weights", made_models::weights),
    ("photo", files::photo),
    ("ply", files::ply),
    ("shard_index", files::shard_index),
    ("splat_origin", files::splat_origin),
    ("spz", files::spz),
    ("transforms_json", files::transforms_json),
    ("weights", files::weights),
    ("weights_pickle", made_chunks::weights_pickle),
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
            fs::write(images.join(format!("{i:03}.png")), png()).unwrap();
        }
    }
    folder
}

/// A photo of [`SIDE`]².
fn png() -> &'static [u8] {
    static PNG: OnceLock<Vec<u8>> = OnceLock::new();
    PNG.get_or_init(|| {
        let mut bytes = std::io::Cursor::new(vec![]);
        image::RgbImage::new(SIDE, SIDE).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    })
}

/// Of a photo, in pixels.
const SIDE: u32 = 8;

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
