use super::{open_capture, print_json, splat_out, warn};
use crate::data::{Chunk, Dataset, INDEX_FILE, Split};
use crate::error::Error;
use crate::io::{
    InputFiles, Splat, WeightsFile, check_writable_png, is_splat_name, is_weights_name,
    read_splat_without_invalid, splat_files, write_png,
};
use crate::reconstruct::{CONFIG_KEY, ModelFile, STAGE_KEY};
use crate::render::{SplatRenderer, orbit_around_splat};
use crate::scene::Gaussians;
use anyhow::Result;
use clap::Args;
use glam::DVec3;
use serde_json::{Value, json};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use tch::{Kind, Tensor};

/// Print the contents of a splat, a weights file, a capture, a chunk, or a folder of chunks.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat inspect room.ply\n  globalsplat inspect room.sog --preview room.png"
)]
pub struct Inspect {
    /// Splat (.ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat), weights (.safetensors, .ckpt), a .torch, a capture, or a folder with an
    /// index.json
    #[arg(value_name = "FILE|DIR")]
    path: PathBuf,
    /// Also render a splat to this PNG, 512×512 pixels, from in front of it
    #[arg(long, value_name = "FILE")]
    preview: Option<PathBuf>,
    /// Print the contents as one JSON object
    #[arg(long)]
    json: bool,
}

impl Inspect {
    pub fn run(self) -> Result<()> {
        if let Some(preview) = &self.preview {
            if !is_splat_name(&self.path) {
                let why =
                    format!("--preview: {} isn't a splat, the only kind that it shows", self.path.display());
                return Err(Error::request(why).into());
            }
            check_writable_png(preview)?;
            let mut inputs = InputFiles::default();
            splat_files(&self.path).iter().for_each(|file| inputs.add(file));
            inputs.check_file(preview)?;
        }
        let is_scene_of_chunk = !self.path.exists() && self.path.to_string_lossy().contains(".torch#");
        let object = match self.path.extension().and_then(|e| e.to_str()) {
            _ if is_scene_of_chunk => capture(&self.path)?,
            _ if is_splat_name(&self.path) => splat(&self.path, self.preview.as_deref())?,
            _ if is_weights_name(&self.path) => weights(&self.path)?,
            _ if !self.path.exists() => {
                return Err(Error::request(format!("{}: no such file or folder", self.path.display())).into());
            }
            Some("torch") => chunk(&self.path)?,
            Some("json") => capture(&self.path)?,
            _ if self.path.join(INDEX_FILE).is_file() => dataset(&self.path)?,
            _ if self.path.is_dir() => capture(&self.path)?,
            _ => {
                std::fs::metadata(&self.path).map_err(Error::read(&self.path))?;
                let expected = "a splat such as a .ply, .sog, .spz or .glb, a .safetensors, a .ckpt, a .torch or a capture";
                return Err(Error::input(&self.path, "the path", "of an unknown type", expected).into());
            }
        };
        if self.json {
            print_json(&object);
        } else {
            for (key, value) in object.as_object().expect("an object") {
                match value {
                    Value::Null => {}
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

/// Returns the minimum, median and maximum.
fn range(t: &Tensor) -> Value {
    let t = t.to_kind(Kind::Double);
    if t.numel() == 0 {
        return Value::Null;
    }
    json!([t.min().double_value(&[]), t.median().double_value(&[]), t.max().double_value(&[])])
}

/// Returns quantiles of the positive `values`, by name.
fn quantiles(values: impl Iterator<Item = f32>) -> Value {
    let mut sorted: Vec<f32> = values.collect();
    if sorted.is_empty() {
        return Value::Null;
    }
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |percent: usize| sorted.get((sorted.len().saturating_sub(1)) * percent / 100).copied();
    json!({ "p01": at(1), "p05": at(5), "p25": at(25), "p50": at(50), "p75": at(75), "p95": at(95), "p99": at(99) })
}

/// Returns the mean square over all directions of the colors' part of each SH degree, a mean over Gaussians and channels.
fn sh_energy(splat: &Splat) -> Vec<f64> {
    let mut energies = vec![0.; splat.sh_degree + 1];
    for index in 0..splat.len() {
        for (basis, color) in splat.sh_of(index).iter().enumerate() {
            energies[basis.isqrt()] += color.iter().map(|&channel| f64::from(channel).powi(2)).sum::<f64>();
        }
    }
    // The integral of a squared spherical harmonic over the sphere, whose area is 4π, is 1.
    let numbers = (3 * splat.len().max(1)) as f64 * 4. * PI;
    energies.into_iter().map(|energy| energy / numbers).collect()
}

fn splat(path: &Path, preview: Option<&Path>) -> Result<Value> {
    let splat = read_splat_without_invalid(path)?;
    warn(&splat.warnings);
    let g = Gaussians::from_splat(&splat);
    let axis = |i: usize| range(&(g.means.select(-1, i as i64).to_kind(Kind::Double) + splat.origin[i]));
    let origin = (splat.origin != DVec3::ZERO).then(|| splat.origin.to_array());
    if let Some(preview) = preview {
        let camera = orbit_around_splat(&splat)[0];
        write_png(preview, &SplatRenderer::from_splat(&splat).render(&[camera])?[0].rgb)?;
    }
    Ok(json!({
        "kind": "splat",
        "gaussians": g.count(),
        "warnings": Some(&splat.warnings).filter(|warnings| !warnings.is_empty()),
        "sh_degree": splat.sh_degree,
        "antialiased": splat.antialiased,
        "bytes": splat_out::total_bytes(path)?,
        "x": axis(0),
        "y": axis(1),
        "z": axis(2),
        "local_origin": origin,
        "scales": range(&g.scales),
        "scale_quantiles": quantiles((0..splat.len()).flat_map(|index| splat.scale(index))),
        "opacities": range(&g.opacities),
        "opacity_quantiles": quantiles((0..splat.len()).map(|index| splat.opacity(index))),
        "sh_energy": sh_energy(&splat),
    }))
}

fn weights(path: &Path) -> Result<Value> {
    let weights = WeightsFile::open(path)?;
    let shapes = weights.shapes();
    let numbers: i64 = shapes.values().map(|(_, shape)| shape.iter().product::<i64>()).sum();
    let mut kinds: Vec<String> = shapes.values().map(|(kind, _)| format!("{kind:?}")).collect();
    kinds.sort();
    kinds.dedup();
    let bytes = std::fs::metadata(weights.path())?.len();
    let [configuration, stage] = [CONFIG_KEY, STAGE_KEY].map(|key| weights.metadata().get(key).cloned());
    // For weights without a configuration, infer it from the shapes.
    let model = ModelFile::from_weights(weights, &[]).ok();
    let configuration = configuration.or(model.as_ref().map(|model| model.config.to_toml()));
    Ok(json!({
        "kind": "weights",
        "tensors": shapes.len(),
        "numbers": numbers,
        "types": kinds,
        "bytes": bytes,
        "taken_for": model.and_then(|model| model.assumed),
        "configuration": configuration,
        "stage": stage.as_deref().unwrap_or("final"),
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
    let absent: Vec<_> =
        groups.filter(|group| !group.path().is_file()).map(|group| group.path().to_string_lossy()).collect();
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
        "test_views": capture.has_test_part().then(|| capture.scored_views().len()),
        "masks": Some(capture.mask_count()).filter(|&count| count > 0),
        "image_size": [first.height, first.width],
        "focal_lengths": [first.intrinsics.fx, first.intrinsics.fy],
        "extent": crate::scene::normalize(&poses)?.world_from_normalized.scale,
    }))
}
