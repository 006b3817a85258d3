//! A forward pass: how long its parts take, and how much memory it needs.

use super::Spread;
use super::parts::{Part, Parts};
use super::train::made_up_scene;
use super::yardstick::Yardstick;
use crate::config::Config;
use crate::data::{Sample, ViewBatch};
use crate::error::Result;
use crate::eval::{forget_peak_memory, peak_memory_bytes_on};
use crate::model::{GlobalSplat, Precision};
use crate::optim::Stopwatch;
use serde::Serialize;
use tch::{Device, nn, no_grad};

/// Of fresh weights: much as they begin in training.
const WEIGHTS_STD: f64 = 0.02;

/// What [`bench_model`] measured.
#[derive(Debug, Serialize)]
pub struct ModelReport {
    /// Photos that the model sees.
    pub views: usize,
    /// [height, width] of them.
    pub size: [u32; 2],
    /// That come out.
    pub gaussians: i64,
    /// Of matrix products.
    pub precision: Precision,
    /// Threads that shared the work of a CPU.
    pub threads: i32,
    /// Passes that were measured.
    pub repeats: usize,
    /// From photos to Gaussians, on the device.
    pub milliseconds: Spread,
    /// In the order of the work.
    pub parts: Vec<Part>,
    /// A product of large matrices in the same precision, in 10⁹ floating-point operations a second.
    pub peak_gflops: f64,
    /// Bytes that tensors on a GPU, or the process, took at the most during these passes; weights and photos are among them.
    pub peak_bytes: u64,
}

/// Times `repeats` passes (at least one) of the model that `config` describes, to its final stage, over photos of noise.
///
/// # Errors
/// A model that can't be built.
pub fn bench_model(
    config: &Config,
    precision: Precision,
    repeats: usize,
    device: Device,
) -> Result<ModelReport> {
    let mut vs = nn::VarStore::new(device);
    let mut model = GlobalSplat::to_be_filled(&mut vs, &config.model, precision)?;
    no_grad(|| {
        for mut weights in vs.variables().into_values().filter(|variable| variable.dim() > 1) {
            let _ = weights.normal_(0., WEIGHTS_STD);
        }
    });
    if device != Device::Cpu {
        model.fold_weights();
    }
    let context = Sample::of(&[made_up_scene(config, 0)], device).context;
    let stage = config.curriculum.final_stage();
    let yardstick = Yardstick::new(precision, device);
    let ViewBatch { images, c2w, intrinsics, .. } = &context;
    let forward = || {
        let mut watch = Stopwatch::of(device);
        drop(no_grad(|| watch.time("pass", || model.forward(images, c2w, intrinsics, stage))));
        1e3 * watch.sections()[0].1.as_secs_f64()
    };
    let (mut parts, mut passes, mut products) = (Parts::default(), vec![], vec![]);
    // The first pass warms caches, threads and the GPU's libraries up.
    forward();
    forget_peak_memory(device);
    for _ in 0..repeats {
        products.push(yardstick.time());
        // A GPU that works faster than kernels are launched is slowed down by the events around every part.
        let untold = (device != Device::Cpu).then(forward);
        let told = parts.watch(device, forward);
        passes.push(untold.unwrap_or(told));
    }
    let peak_gflops = yardstick.gflops(Spread::of(products).least);
    Ok(ModelReport {
        views: config.data.context_views,
        size: config.data.image_size.into(),
        gaussians: config.model.latents << config.curriculum.final_stage,
        precision,
        threads: tch::get_num_threads(),
        repeats,
        milliseconds: Spread::of(passes),
        parts: parts.told(peak_gflops),
        peak_gflops,
        peak_bytes: peak_memory_bytes_on(device),
    })
}
