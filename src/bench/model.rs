//! Benchmark of the forward pass: the time of its parts, and its memory use.

use super::TimingStats;
use super::parts::{Part, PartRecorder};
use super::peak_throughput::PeakThroughput;
use super::train::synthetic_scene;
use crate::config::Config;
use crate::data::Batch;
use crate::device::Stopwatch;
use crate::device::{peak_memory_bytes_on, reset_peak_memory};
use crate::error::Result;
use crate::model::{GlobalSplat, Precision};
use serde::Serialize;
use tch::{Device, nn, no_grad};

/// Standard deviation of the random weights, similar to that of the initial weights in training.
const WEIGHTS_STD: f64 = 0.02;

/// Results of [`bench_model`].
#[derive(Debug, Serialize)]
pub struct ModelReport {
    /// Number of photos that the model sees.
    pub views: usize,
    /// Size of the photos, `[height, width]`.
    pub size: [u32; 2],
    /// Number of Gaussians in the output.
    pub gaussians: i64,
    /// Precision of matrix products.
    pub precision: Precision,
    /// Number of CPU threads.
    pub threads: i32,
    /// Number of measured passes.
    pub repeats: usize,
    /// Time from photos to Gaussians, both on the device.
    pub milliseconds: TimingStats,
    /// Parts of the pass, in the order of execution.
    pub parts: Vec<Part>,
    /// Throughput of a product of large matrices in the same precision, in GFLOP/s.
    pub peak_gflops: f64,
    /// Peak memory during the measured passes in bytes, including weights and photos: that of the GPU's tensors, or that of the process.
    pub peak_bytes: u64,
}

/// Times `repeats` passes (at least one) of the model that `config` describes, up to its final stage, over photos of random noise.
///
/// # Errors
/// Fails if the model can't be built or a GPU fails.
pub fn bench_model(
    config: &Config,
    precision: Precision,
    repeats: usize,
    device: Device,
) -> Result<ModelReport> {
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
    let peak = PeakThroughput::new(precision, device);
    let input = context.model_input();
    let forward = || -> Result<f64> {
        let mut watch = Stopwatch::new(device);
        drop(no_grad(|| watch.time("pass", || model.forward(&input, stage))));
        Ok(1e3 * watch.sections()?[0].1.as_secs_f64())
    };
    let (mut parts, mut passes, mut products) = (PartRecorder::default(), vec![], vec![]);
    // The first pass warms up caches, threads and the GPU's libraries.
    forward()?;
    reset_peak_memory(device);
    for _ in 0..repeats {
        products.push(peak.time()?);
        // Events around every part slow down a GPU that runs kernels faster than the host launches them, so time a GPU's pass without them.
        let unwatched = (device != Device::Cpu).then(forward).transpose()?;
        let watched = parts.record(device, forward)?;
        passes.push(unwatched.unwrap_or(watched));
    }
    let peak_gflops = peak.gflops(TimingStats::from_milliseconds(products).min);
    Ok(ModelReport {
        views: config.data.context_views,
        size: config.data.image_size.into(),
        gaussians: config.model.latents << config.curriculum.final_stage,
        precision,
        threads: tch::get_num_threads(),
        repeats,
        milliseconds: TimingStats::from_milliseconds(passes),
        parts: parts.into_stats(peak_gflops),
        peak_gflops,
        peak_bytes: peak_memory_bytes_on(device),
    })
}
