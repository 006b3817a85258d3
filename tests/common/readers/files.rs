//! Readers whose fuzz input is the content of a file.

use super::{file, folder, load};
use globalsplat::config::Config;
use globalsplat::data::{Chunk, Dataset, Split, open_capture, read_camera_path, read_points};
use globalsplat::eval::{EvaluationIndex, read_evaluation, write_report};
use globalsplat::io::{
    decode_photo, origin_file, read_splat, read_splat_without_invalid, read_weights, rounding_warning,
    write_local_splat, write_splat,
};
use globalsplat::reconstruct::load_model;
use globalsplat::scene::Gaussians;
use globalsplat::train::latest_checkpoint;
use std::path::Path;
use tch::Device;

pub fn cameras_json(bytes: &[u8]) {
    let file = file("cameras_json", "cameras.json", bytes);
    let _ = open_capture(&file).map(|capture| load(&capture));
    let _ = read_camera_path(&file, None);
}

/// Reads a camera path of nerfstudio's viewer.
pub fn camera_path(bytes: &[u8]) {
    let _ = read_camera_path(&file("camera_path", "path.json", bytes), Some([8, 8].into()));
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

/// Reads a COLMAP model whose two files are in one input: the length of the first in two bytes, then one after the other.
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

/// Reads points of an otherwise valid model: text if the first byte is even, else binary.
pub fn colmap_points(bytes: &[u8]) {
    let Some((first, bytes)) = bytes.split_first() else { return };
    let reader = if first % 2 == 0 { "colmap_points_text" } else { "colmap_points_binary" };
    let folder = folder(reader);
    let model = |name: &str, bytes: &[u8]| file(reader, &format!("sparse/0/{name}"), bytes);
    if first % 2 == 0 {
        model("cameras.txt", b"1 SIMPLE_PINHOLE 8 8 8 4 4\n");
        model("images.txt", b"1 1 0 0 0 0 0 0 1 000.png\n\n2 1 0 0 0 1 0 0 1 001.png\n\n");
        model("points3D.txt", bytes);
    } else {
        let number = |value: f64| value.to_le_bytes();
        let camera = [
            &1u64.to_le_bytes()[..],
            &1u32.to_le_bytes(),
            &0i32.to_le_bytes(),
            &8u64.to_le_bytes(),
            &8u64.to_le_bytes(),
        ];
        let lens = [8., 4., 4.].map(number).concat();
        model("cameras.bin", &[&camera.concat()[..], &lens].concat());
        let image = |id: u32, name: &[u8]| {
            let pose = [1., 0., 0., 0., f64::from(id), 0., 0.].map(number).concat();
            [&id.to_le_bytes()[..], &pose, &1u32.to_le_bytes(), name, &[0], &0u64.to_le_bytes()].concat()
        };
        model(
            "images.bin",
            &[&2u64.to_le_bytes()[..], &image(1, b"000.png"), &image(2, b"001.png")].concat(),
        );
        model("points3D.bin", bytes);
    }
    let _ = read_points(&open_capture(&folder).expect("a model that is right"));
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

pub fn evaluation(bytes: &[u8]) {
    let folder = file("evaluation", "scores.json", bytes).parent().unwrap().to_owned();
    let Ok(evaluation) = read_evaluation(&folder) else { return };
    let _ = write_report(&folder.join("report.html"), &[(folder.clone(), evaluation)]);
}

pub fn checkpoint(bytes: &[u8]) {
    let state = file("checkpoint", "checkpoints/step-00000001/state.json", bytes);
    std::fs::write(state.with_file_name("model.safetensors"), [0; 3]).unwrap();
    let _ = latest_checkpoint(&folder("checkpoint"));
}

pub fn photo(bytes: &[u8]) {
    let _ = decode_photo(bytes, Path::new("photo.jpg"), (8, 8));
}

pub fn ply(bytes: &[u8]) {
    read_and_repair(&file("ply", "splat.ply", bytes));
}

pub fn compressed_ply(bytes: &[u8]) {
    read_and_repair(&file("compressed_ply", "splat.compressed.ply", bytes));
}

pub fn glb(bytes: &[u8]) {
    read_and_repair(&file("glb", "splat.glb", bytes));
}

pub fn gltf(bytes: &[u8]) {
    read_and_repair(&file("gltf", "splat.gltf", bytes));
}

pub fn ksplat(bytes: &[u8]) {
    read_and_repair(&file("ksplat", "splat.ksplat", bytes));
}

pub fn sog(bytes: &[u8]) {
    read_and_repair(&file("sog", "splat.sog", bytes));
}

/// Reads a splat of one Gaussian with the origin file `bytes`; a splat that can be read must survive a round trip with its
/// origin.
pub fn splat_origin(bytes: &[u8]) {
    let splat = file("splat_origin", "splat.splat", &[0; 32]);
    std::fs::write(origin_file(&splat), bytes).unwrap();
    let Ok(splat) = read_splat(&splat) else { return };
    let copy = file("splat_origin", "copy.splat", b"");
    write_local_splat(&copy, &splat).unwrap();
    assert_eq!(read_splat(&copy).unwrap().origin, splat.origin);
    let _ = write_splat(&copy, &splat);
    let _ = rounding_warning(&splat);
}

pub fn spz(bytes: &[u8]) {
    read_and_repair(&file("spz", "splat.spz", bytes));
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
pub fn antimatter(bytes: &[u8]) {
    let original = file("antimatter", "splat.splat", bytes);
    read_and_repair(&original);
    let Ok(splat) = read_splat(&original) else { return };
    let copy = file("antimatter", "copy.splat", b"");
    write_splat(&copy, &splat).unwrap();
    assert_eq!(read_splat(&copy).unwrap().len(), splat.len());
}

pub fn weights(bytes: &[u8]) {
    let file = file("weights", "model.safetensors", bytes);
    let _ = read_weights(&file);
    let _ = load_model(&file, Device::Cpu);
}

pub fn configuration(bytes: &[u8]) {
    let _ = std::str::from_utf8(bytes).map(|text| Config::parse(text, &[], Path::new("config.toml")));
}
