//! A forward pass: how long its parts take, and how much memory it needs.

use super::train::made_up_scene;
use super::{Measured, Section, Spread};
use crate::config::Config;
use crate::data::Sample;
use crate::error::Result;
use crate::eval::{forget_peak_memory, peak_memory_bytes_on};
use crate::model::{GlobalSplat, Precision};
use crate::optim::Stopwatch;
use serde::Serialize;
use tch::{Device, nn, no_grad};

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
    pub sections: Vec<Section>,
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
    let vs = nn::VarStore::new(device);
    let mut model = GlobalSplat::new(&vs.root(), &config.model)?;
    model.set_precision(precision);
    let context = Sample::of(&[made_up_scene(config, 0)], device).context;
    let stage = config.curriculum.final_stage();
    let mut measured = Measured::default();
    // The first pass warms caches, threads and the GPU's libraries up.
    for pass in 0..=repeats {
        if pass == 1 {
            forget_peak_memory(device);
        }
        let mut watch = Stopwatch::of(device);
        no_grad(|| {
            let tokens =
                watch.time("tokens", || model.tokens(&context.images, &context.c2w, &context.intrinsics));
            let encoded = watch.time("encoder", || model.encode(&tokens));
            watch.time("decoder", || model.decode(&encoded, stage))
        });
        if pass > 0 {
            measured.add(&mut watch);
        }
    }
    let (milliseconds, sections) = measured.told();
    Ok(ModelReport {
        views: config.data.context_views,
        size: config.data.image_size.into(),
        gaussians: config.model.latents << config.curriculum.final_stage,
        precision,
        threads: tch::get_num_threads(),
        repeats,
        milliseconds,
        sections,
        peak_bytes: peak_memory_bytes_on(device),
    })
}
