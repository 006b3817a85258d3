use super::print_json;
use anyhow::Result;
use clap::Args;
use globalsplat::data::{Chunk, Dataset, INDEX_FILE, Split, open_capture};
use globalsplat::error::Error;
use globalsplat::io::{read_splat, read_weights};
use globalsplat::reconstruct::{CONFIG_KEY, STAGE_KEY};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tch::{Kind, Tensor};

/// Tell what is in a splat, a weights file, a capture, a chunk, or a folder of chunks.
#[derive(Args)]
#[command(after_help = "Example:\n  globalsplat inspect room.ply")]
pub struct Inspect {
    /// A .ply, a .safetensors, a .torch, a capture, or a folder with an index.json
    #[arg(value_name = "FILE|DIR")]
    path: PathBuf,
    /// Print it as one JSON object
    #[arg(long)]
    json: bool,
}

impl Inspect {
    pub fn run(self) -> Result<()> {
        let object = match self.path.extension().and_then(|e| e.to_str()) {
            Some("ply") => splat(&self.path)?,
            Some("safetensors") => weights(&self.path)?,
            Some("torch") => chunk(&self.path)?,
            Some(extension) if extension == "json" || extension.starts_with("torch#") => capture(&self.path)?,
            _ if self.path.join(INDEX_FILE).is_file() => dataset(&self.path)?,
            _ if self.path.is_dir() => capture(&self.path)?,
            _ => {
                let expected = "a .ply, a .safetensors, a .torch or a capture";
                return Err(Error::input(&self.path, "the path", "none that inspect knows", expected).into());
            }
        };
        if self.json {
            print_json(&object);
        } else {
            for (key, value) in object.as_object().expect("an object") {
                match value {
                    Value::String(text) => {
                        println!("{key:<20} {}", text.replace('\n', &format!("\n{:21}", "")))
                    }
                    other => println!("{key:<20} {other}"),
                }
            }
        }
        Ok(())
    }
}

/// Smallest, median and largest.
fn range(t: &Tensor) -> Value {
    let t = t.to_kind(Kind::Double);
    if t.numel() == 0 {
        return Value::Null;
    }
    json!([t.min().double_value(&[]), t.median().double_value(&[]), t.max().double_value(&[])])
}

fn splat(path: &Path) -> Result<Value> {
    let splat = read_splat(path)?;
    let g = &splat.gaussians;
    let axis = |i: i64| range(&g.means.select(-1, i));
    Ok(json!({
        "kind": "splat",
        "gaussians": g.count(),
        "sh_degree": splat.sh_degree(),
        "bytes": std::fs::metadata(path)?.len(),
        "x": axis(0),
        "y": axis(1),
        "z": axis(2),
        "scales": range(&g.scales),
        "opacities": range(&g.opacities),
    }))
}

fn weights(path: &Path) -> Result<Value> {
    let weights = read_weights(path)?;
    let numbers: usize = weights.tensors.values().map(Tensor::numel).sum();
    let mut kinds: Vec<String> = weights.tensors.values().map(|t| format!("{:?}", t.kind())).collect();
    kinds.sort();
    kinds.dedup();
    Ok(json!({
        "kind": "weights",
        "tensors": weights.tensors.len(),
        "numbers": numbers,
        "types": kinds,
        "bytes": std::fs::metadata(path)?.len(),
        "configuration": weights.metadata.get(CONFIG_KEY),
        "stage": weights.metadata.get(STAGE_KEY).map_or("final", String::as_str),
    }))
}

fn chunk(path: &Path) -> Result<Value> {
    let chunk = Chunk::read(path)?;
    let mut scenes = serde_json::Map::new();
    for key in chunk.keys() {
        scenes.insert(key.into(), chunk.capture(key)?.len().into());
    }
    Ok(json!({
        "kind": "chunk",
        "bytes": std::fs::metadata(path)?.len(),
        "scenes": scenes.len(),
        "views": scenes,
    }))
}

fn dataset(path: &Path) -> Result<Value> {
    let dataset = Dataset::open(path, Split::Test)?;
    let groups = dataset.groups().iter();
    let absent: Vec<_> = groups.filter(|group| !group.path().is_file()).map(|group| group.path()).collect();
    Ok(json!({
        "kind": "data set",
        "scenes": dataset.scenes(),
        "chunks": dataset.groups().len(),
        "absent_chunks": absent,
    }))
}

fn capture(path: &Path) -> Result<Value> {
    let capture = open_capture(path)?;
    let cameras = capture.cameras();
    let poses: Vec<_> = cameras.iter().map(|camera| camera.c2w).collect();
    let first = cameras[0];
    Ok(json!({
        "kind": "capture",
        "name": capture.name,
        "views": capture.len(),
        "image_size": [first.height, first.width],
        "focal_lengths": [first.intrinsics.fx, first.intrinsics.fy],
        "extent": globalsplat::scene::normalize(&poses)?.world_from_normalized.scale,
    }))
}
