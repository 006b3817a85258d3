//! Benchmark of the forward pass: the time of its parts, and its memory use.

use super::measure::{Measured, TimingStats, peak_gflops};
use super::train::synthetic_scene;
use crate::config::Config;
use crate::data::Batch;
use crate::device::{Stopwatch, peak_memory_bytes_on, reset_peak_memory};
use crate::error::Result;
use crate::model::{GlobalSplat, Precision};
use serde_json::{Value, json};
use tch::{Device, nn, no_grad};

/// Standard deviation of the random weights, similar to that of the initial weights in training.
const WEIGHTS_STD: f64 = 0.02;

/// Times `repeats` passes (at least one) of the model that `config` describes, up to its final stage, over photos of random noise that are on
/// the device. `peak_bytes` includes weights and photos.
///
/// # Errors
/// Fails if the model can't be built or a GPU fails.
pub fn bench_model(config: &Config, precision: Precision, repeats: usize, device: Device) -> Result<Value> {
    let mut vs = nn::VarStore::new(device);
    let mut model = GlobalSplat::uninitialized(&mut vs, &config.model, precision)?;
    no_grad(|| {
        for mut weights in vs.variables().into_values().filter(|variable| variable.dim() > 1) {
            let _ = weights.normal_(0., WEIGHTS_STD);
        }
    });
    if device != Device::Cpu {
        model.fold_weights();
    }
    let context = Batch::from_scenes(&[synthetic_scene(config, 0)], device)?.context;
    let stage = config.curriculum.final_stage();
    let peak_gflops = peak_gflops(precision, device)?;
    let input = context.model_input();
    let forward = || -> Result<f64> {
        let mut watch = Stopwatch::new(device);
        drop(no_grad(|| watch.time("pass", || model.forward(&input, stage))));
        Ok(1e3 * watch.sections()?[0].1.as_secs_f64())
    };
    let (mut parts, mut passes) = (Measured::default(), vec![]);
    // The first pass warms up caches, threads and the GPU's libraries.
    forward()?;
    reset_peak_memory(device);
    for _ in 0..repeats {
        // Events around every part slow down a GPU that runs kernels faster than the host launches them, so time a GPU's pass without them.
        let unwatched = (device != Device::Cpu).then(forward).transpose()?;
        let watched = parts.record(device, forward)?;
        passes.push(unwatched.unwrap_or(watched));
    }
    Ok(json!({
        "views": config.data.context_views,
        "size": config.data.image_size,
        "gaussians": config.model.latents << config.curriculum.final_stage,
        "precision": precision,
        "threads": tch::get_num_threads(),
        "repeats": repeats,
        "milliseconds": TimingStats::from_milliseconds(passes),
        "parts": parts.parts(peak_gflops),
        "peak_gflops": peak_gflops,
        "peak_bytes": peak_memory_bytes_on(device),
    }))
}
