//! Every reader of external files, callable with arbitrary bytes: for the fuzzers, and for the seeds that they produced.
//!
//! A reader may refuse its input or accept it; what it accepts must then load or be refused as well. Some take the bytes of a
//! file. Others, `made_…`, take bytes from which a file of the right structure is generated, checksums and magic numbers
//! included, with mistakes only where they were drawn.

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

/// Function that reads arbitrary bytes.
pub type Reader = fn(&[u8]);

/// Readers, by the names of fuzz targets and of the folders of their seeds.
pub const READERS: [(&str, Reader); 33] = [
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
    ("glb", files::glb),
    ("gltf", files::gltf),
    ("ksplat", files::ksplat),
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
    ("sog", files::sog),
    ("splat_origin", files::splat_origin),
    ("spz", files::spz),
    ("transforms_json", files::transforms_json),
    ("weights", files::weights),
    ("weights_pickle", made_chunks::weights_pickle),
];

/// Returns the folder of the readers' files: in memory, if the system has such a file system.
pub fn root() -> &'static Path {
    static ROOT: OnceLock<PathBuf> = OnceLock::new();
    ROOT.get_or_init(|| {
        let memory = Path::new("/dev/shm");
        let place = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        place.join(format!("globalsplat-readers-{}", std::process::id()))
    })
}

/// Returns the folder of a reader, with `images/000.png` to `images/002.png`, 8×8.
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

/// Returns a PNG photo with sides of [`SIDE`].
fn png() -> &'static [u8] {
    static PNG: OnceLock<Vec<u8>> = OnceLock::new();
    PNG.get_or_init(|| {
        let mut bytes = std::io::Cursor::new(vec![]);
        image::RgbImage::new(SIDE, SIDE).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    })
}

/// Side of a photo, in pixels.
const SIDE: u32 = 8;

/// Writes `bytes` to a file in the folder of `reader`.
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
