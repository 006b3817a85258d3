use super::{Output, open_capture, splat_out, warn};
use crate::data::{Chunk, Dataset, INDEX_FILE, Split};
use crate::error::Error;
use crate::io::{
    InputFiles, Splat, WeightsFile, check_writable_png, is_splat_name, is_weights_name,
    read_splat_without_invalid, splat_files, write_png,
};
use crate::reconstruct::{CONFIG_KEY, ModelFile, STAGE_KEY};
use crate::render::{SplatRenderer, orbit_around_splat};
use anyhow::Result;
use clap::Args;
use glam::DVec3;
use serde_json::{Value, json};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

/// Print the contents of a splat, a weights file, a capture, a chunk, or a folder of chunks.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat inspect room.ply\n  globalsplat inspect room.sog --preview room.png"
)]
pub struct Inspect {
    /// Splat (.ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat or .zip), weights (.safetensors, .ckpt),
    /// a .torch, a capture, or a folder with an index.json
    #[arg(value_name = "FILE|DIR")]
    path: PathBuf,
    /// Also render a splat to this PNG, 512×512 pixels, from in front of it
    #[arg(long, value_name = "FILE")]
    preview: Option<PathBuf>,
}

impl Inspect {
    pub fn run(self) -> Result<Output> {
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
        Ok(Output::table(object))
    }
}

/// Returns the values at these percentages of the sorted `values`, or null if there are none.
fn percentiles<const N: usize>(
    values: impl Iterator<Item = f64>,
    percentages: [usize; N],
) -> Option<[f64; N]> {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    Some(percentages.map(|percentage| sorted[last * percentage / 100]))
}

/// Returns the minimum, median and maximum.
fn range(values: impl Iterator<Item = f64>) -> Value {
    json!(percentiles(values, [0, 50, 100]))
}

/// Returns percentiles by name.
fn quantiles(values: impl Iterator<Item = f64>) -> Value {
    let found = percentiles(values, [1, 5, 25, 50, 75, 95, 99]);
    json!(found.map(|[p01, p05, p25, p50, p75, p95, p99]| {
        json!({ "p01": p01, "p05": p05, "p25": p25, "p50": p50, "p75": p75, "p95": p95, "p99": p99 })
    }))
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
    let axis = |i: usize| range(splat.means.iter().map(|mean| f64::from(mean[i]) + splat.origin[i]));
    let scales = || (0..splat.len()).flat_map(|index| splat.scale(index)).map(f64::from);
    let opacities = || (0..splat.len()).map(|index| f64::from(splat.opacity(index)));
    let origin = (splat.origin != DVec3::ZERO).then(|| splat.origin.to_array());
    if let Some(preview) = preview {
        let camera = orbit_around_splat(&splat)[0];
        write_png(preview, &SplatRenderer::from_splat(&splat).render(&[camera])?[0].rgb)?;
    }
    Ok(json!({
        "kind": "splat",
        "gaussians": splat.len(),
        "warnings": Some(&splat.warnings).filter(|warnings| !warnings.is_empty()),
        "sh_degree": splat.sh_degree,
        "antialiased": splat.antialiased,
        "bytes": splat_out::total_bytes(path)?,
        "x": axis(0),
        "y": axis(1),
        "z": axis(2),
        "local_origin": origin,
        "scales": range(scales()),
        "scale_quantiles": quantiles(scales()),
        "opacities": range(opacities()),
        "opacity_quantiles": quantiles(opacities()),
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
    let groups = dataset.groups.iter();
    let absent: Vec<_> =
        groups.filter(|group| !group.path().is_file()).map(|group| group.path().to_string_lossy()).collect();
    Ok(json!({
        "kind": "data set",
        "scenes": dataset.scenes(),
        "chunks": dataset.groups.len(),
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
