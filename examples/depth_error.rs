//! Compares the depths of reconstructions with the exact ones of synthetic scenes:
//!
//!     globalsplat synth --seed 2 --scenes 16 --frames 32 --size 96 --out scenes
//!     cargo run --release --example depth_error -- scenes [WEIGHTS]
//!
//! Prints the mean over the pixels of the target views of |z − z*| / (z + z*), for depths in units of the largest distance between cameras
//! and of at most 40.

use globalsplat::data::{Dataset, Split, load_views};
use globalsplat::eval::EvaluationIndex;
use globalsplat::reconstruct::{bundled_model, load_model, reconstruct};
use globalsplat::render::render_views;
use globalsplat::scene::Camera;
use globalsplat::{Error, Result};
use std::path::Path;
use tch::{Device, Kind, Tensor};

const FARTHEST: f64 = 40.;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let (folder, model) = match arguments.as_slice() {
        [_, folder] => (Path::new(folder), bundled_model(Device::Cpu)?),
        [_, folder, weights] => (Path::new(folder), load_model(weights.as_ref(), Device::Cpu)?),
        _ => return Err(Error::request("expected FOLDER [WEIGHTS]")),
    };
    let index = EvaluationIndex::read(&folder.join("evaluation_index.json"))?;

    let mut errors = vec![];
    for group in Dataset::open(folder, Split::Test)?.groups {
        let scenes = group.open()?;
        for (key, frames) in group.keys.iter().filter_map(|key| Some((key, index.scenes.get(key)?))) {
            let capture = scenes.capture(key)?;
            let size = model.config.data.image_size;
            let context = load_views(&capture, &frames.context, Some(size))?;
            let targets = load_views(&capture, &frames.target, Some(size))?;
            let poses: Vec<_> = targets.iter().map(|view| view.camera.c2w).collect();
            let reconstruction = reconstruct(&model, &context, &poses)?;
            let exact = read_depths(&folder.join("depth").join(format!("{key}.npy")))?;
            for ((frame, view), &c2w) in frames.target.iter().zip(&targets).zip(&reconstruction.target_poses)
            {
                let rendered =
                    render_views(&reconstruction.gaussians, &[Camera { c2w, ..view.camera }])?.remove(0);
                let exact = exact.get(*frame as i64) / reconstruction.world_from_normalized.scale;
                let [depth, exact] = [rendered.depth, exact].map(|depth| depth.clamp(1e-3, FARTHEST));
                let error: Tensor = (&depth - &exact).abs() / (depth + exact);
                errors.push(error.mean(Kind::Double).double_value(&[]));
            }
        }
    }
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    println!("depth error {mean:.4}, over {} views of {} scenes", errors.len(), index.scenes.len());
    Ok(())
}

/// Reads the depths of all frames, [frames, H, W].
fn read_depths(file: &Path) -> Result<Tensor> {
    let found = |e: std::io::Error| Error::input(file, "the file", e, "an array of float32");
    let npy = npyz::NpyFile::new(std::fs::File::open(file).map_err(found)?).map_err(found)?;
    let shape: Vec<i64> = npy.shape().iter().map(|&size| size as i64).collect();
    Ok(Tensor::from_slice(&npy.into_vec::<f32>().map_err(found)?).view(&shape[..]))
}
