//! Every reader of external files, callable with arbitrary bytes: for the fuzzers, and for the seeds that they produced.
//!
//! A reader may return an error for its input or accept it; what it accepts must then load or be an error as well.

use globalsplat::config::Config;
use globalsplat::data::{Capture, Chunk, Dataset, Split, open_capture, read_camera_path, read_points};
use globalsplat::eval::{EvaluationIndex, read_evaluation, write_report};
use globalsplat::io::{
    WriteOptions, decode_photo, origin_file, read_splat, read_splat_without_invalid, read_weights,
    rounding_warning, write_local_splat, write_splat,
};
use globalsplat::reconstruct::load_model;
use globalsplat::scene::Gaussians;
use globalsplat::train::latest_checkpoint;
use globalsplat_capture::read_geo_positions;
use globalsplat_files::stored_zip;
use globalsplat_test_kit::formats::{cameras, names, pinhole, write_colmap_binary, write_colmap_text};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tch::Device;

/// Function that reads arbitrary bytes.
pub type Reader = fn(&[u8]);

/// Readers, by the names that `scripts/fuzz.sh` takes and of the folders of their seeds.
pub const READERS: [(&str, Reader); 29] = [
    ("antimatter", antimatter),
    // A camera path of nerfstudio's viewer.
    ("camera_path", |bytes| {
        let _ = read_camera_path(&file("camera_path", "path.json", bytes), Some([8, 8].into()));
    }),
    ("cameras_json", cameras_json),
    ("checkpoint", checkpoint),
    ("chunk", chunk),
    ("chunk_pickle", chunk_pickle),
    ("colmap_binary", |bytes| colmap("colmap_binary", bytes, "bin")),
    ("colmap_points", colmap_points),
    ("colmap_text", |bytes| colmap("colmap_text", bytes, "txt")),
    ("compressed_ply", |bytes| read_and_repair(&file("compressed_ply", "splat.compressed.ply", bytes))),
    ("configuration", |bytes| {
        let _ = std::str::from_utf8(bytes).map(|text| Config::parse(text, &[], Path::new("config.toml")));
    }),
    ("dataset_index", dataset_index),
    ("evaluation", evaluation),
    ("evaluation_index", |bytes| {
        let _ = EvaluationIndex::read(&file("evaluation_index", "index.json", bytes));
    }),
    ("geo_positions", |bytes| {
        let _ = read_geo_positions(&file("geo_positions", "geo.txt", bytes));
    }),
    ("glb", |bytes| read_and_repair(&file("glb", "splat.glb", bytes))),
    ("gltf", |bytes| read_and_repair(&file("gltf", "splat.gltf", bytes))),
    ("ksplat", |bytes| read_and_repair(&file("ksplat", "splat.ksplat", bytes))),
    ("llff", |bytes| {
        let _ = open_capture(&file("llff", "poses_bounds.npy", bytes)).map(|capture| load(&capture));
    }),
    ("photo", |bytes| {
        let _ = decode_photo(bytes, Path::new("photo.jpg"), (8, 8));
    }),
    ("ply", |bytes| read_and_repair(&file("ply", "splat.ply", bytes))),
    ("polycam", |bytes| {
        file("polycam", "keyframes/cameras/000.json", bytes);
        let _ = read_camera_path(&folder("polycam"), None);
    }),
    ("sog", |bytes| read_and_repair(&file("sog", "splat.sog", bytes))),
    ("splat_origin", splat_origin),
    ("spz", |bytes| read_and_repair(&file("spz", "splat.spz", bytes))),
    ("spz_body", spz_body),
    ("transforms_json", transforms_json),
    ("weights", weights),
    // A checkpoint with this pickle; storages 0 to 2 have 512, 64 and no bytes.
    ("weights_pickle", |bytes| weights(&torch_archive(bytes, &[&[0; 512], &[0; 64], &[]]))),
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

fn cameras_json(bytes: &[u8]) {
    let file = file("cameras_json", "cameras.json", bytes);
    let _ = open_capture(&file).map(|capture| load(&capture));
    let _ = read_camera_path(&file, None);
}

fn transforms_json(bytes: &[u8]) {
    let _ = open_capture(&file("transforms_json", "transforms.json", bytes)).map(|capture| load(&capture));
}

fn chunk(bytes: &[u8]) {
    let Ok(chunk) = Chunk::parse(Path::new("chunk.torch"), bytes.to_vec()) else { return };
    for key in chunk.keys().take(2) {
        let _ = chunk.capture(key).map(|capture| load(&capture));
    }
}

/// Reads a COLMAP model whose two files are in one input: the length of the first in two bytes, then one after the other.
fn colmap(reader: &str, bytes: &[u8], ending: &str) {
    let Some((length, rest)) = bytes.split_first_chunk::<2>() else { return };
    let (cameras, images) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
    file(reader, &format!("sparse/0/cameras.{ending}"), cameras);
    file(reader, &format!("sparse/0/images.{ending}"), images);
    let _ = open_capture(&folder(reader)).map(|capture| load(&capture));
}

/// Reads points of an otherwise valid model: text if the first byte is even, else binary.
fn colmap_points(bytes: &[u8]) {
    let Some((first, bytes)) = bytes.split_first() else { return };
    let (is_text, names, cameras) = (first % 2 == 0, &names()[..2], &cameras()[..2]);
    let folder = folder(if is_text { "colmap_points_text" } else { "colmap_points_binary" });
    let model = folder.join("sparse/0");
    let points = if is_text {
        write_colmap_text(&model, names, cameras, &pinhole(&cameras[0]));
        model.join("points3D.txt")
    } else {
        write_colmap_binary(&model, names, cameras);
        model.join("points3D.bin")
    };
    fs::write(points, bytes).unwrap();
    let _ = read_points(&open_capture(&folder).expect("a model that is right"));
}

fn dataset_index(bytes: &[u8]) {
    let file = file("dataset_index", "index.json", bytes);
    let Ok(dataset) = Dataset::open(file.parent().unwrap(), Split::Train) else { return };
    for group in dataset.groups.iter().take(2) {
        let _ = group.open();
    }
}

fn evaluation(bytes: &[u8]) {
    let folder = file("evaluation", "scores.json", bytes).parent().unwrap().to_owned();
    let Ok(evaluation) = read_evaluation(&folder) else { return };
    let _ = write_report(&folder.join("report.html"), &[(folder.clone(), evaluation)]);
}

fn checkpoint(bytes: &[u8]) {
    let state = file("checkpoint", "checkpoints/step-00000001/state.json", bytes);
    std::fs::write(state.with_file_name("model.safetensors"), [0; 3]).unwrap();
    let _ = latest_checkpoint(&folder("checkpoint"));
}

/// Reads a splat of one Gaussian with the origin file `bytes`; a splat that can be read must survive a round trip with its
/// origin.
fn splat_origin(bytes: &[u8]) {
    let splat = file("splat_origin", "splat.splat", &[0; 32]);
    std::fs::write(origin_file(&splat), bytes).unwrap();
    let Ok(splat) = read_splat(&splat) else { return };
    let copy = file("splat_origin", "copy.splat", b"");
    write_local_splat(&copy, &splat, &WriteOptions::default()).unwrap();
    assert_eq!(read_splat(&copy).unwrap().origin, splat.origin);
    let _ = write_splat(&copy, &splat);
    let _ = rounding_warning(&splat);
}

/// Checks that after removal of invalid Gaussians all values are finite, and that none is removed if all are valid.
fn read_and_repair(path: &Path) {
    let Ok(repaired) = read_splat_without_invalid(path) else { return };
    let g = Gaussians::from_splat(&repaired);
    for tensor in [&g.means, &g.scales, &g.quaternions, &g.opacities, &g.sh] {
        assert_eq!(tensor.isfinite().all().int64_value(&[]), 1);
    }
    if let Ok(strict) = read_splat(path) {
        assert_eq!(strict.len(), repaired.len());
    }
}

/// Reads a `.splat`; one that can be read must survive a round trip.
fn antimatter(bytes: &[u8]) {
    let original = file("antimatter", "splat.splat", bytes);
    read_and_repair(&original);
    let Ok(splat) = read_splat(&original) else { return };
    let copy = file("antimatter", "copy.splat", b"");
    write_splat(&copy, &splat).unwrap();
    assert_eq!(read_splat(&copy).unwrap().len(), splat.len());
}

fn weights(bytes: &[u8]) {
    let file = file("weights", "model.safetensors", bytes);
    let _ = read_weights(&file);
    let _ = load_model(&file, Device::Cpu);
}

/// Returns a torch.save archive of `pickle` and of the numbered storages.
fn torch_archive(pickle: &[u8], storages: &[&[u8]]) -> Vec<u8> {
    let storages = storages.iter().enumerate();
    let storages = storages.map(|(key, contents)| (format!("archive/data/{key}"), *contents));
    stored_zip([("archive/data.pkl".into(), pickle)].into_iter().chain(storages), 1)
}

/// Reads a chunk with the pickle `bytes`; storages 0 to 2 are a photo, two cameras and two timestamps.
fn chunk_pickle(bytes: &[u8]) {
    let cameras = [0., 1.].map(|x| {
        let pose = [1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0.];
        [&[0.9, 0.9, 0.5, 0.5, 0., 0.][..], &pose].concat()
    });
    let cameras: Vec<u8> = cameras.concat().iter().flat_map(|number: &f32| number.to_le_bytes()).collect();
    chunk(&torch_archive(bytes, &[png(), &cameras, &[0; 16]]));
}

/// Reads an SPZ whose gzip holds `bytes`; a splat that can be read must survive a round trip.
fn spz_body(bytes: &[u8]) {
    let mut encoder = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    let Ok(splat) = read_splat(&file("spz_body", "splat.spz", &encoder.finish().unwrap())) else { return };
    let copy = file("spz_body", "copy.spz", b"");
    if write_splat(&copy, &splat).is_ok() {
        let again = read_splat(&copy).unwrap();
        assert_eq!((again.len(), again.sh_degree), (splat.len(), splat.sh_degree));
    }
}
