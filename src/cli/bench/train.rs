//! Benchmark of a training step: the time of its parts, and its memory use.

use super::measure::{Measured, peak_gflops};
use crate::config::Config;
use crate::data::{Batch, Capture, LoadedScene};
use crate::device::{Stopwatch, Upload, peak_memory_bytes_on};
use crate::distributed::ProcessGroup;
use crate::error::Result;
use crate::loss::{PerceptualKind, PerceptualNetwork};
use crate::scene::{Camera, ImageSize, Intrinsics};
use crate::train::{COMMUNICATION, Trainer};
use glam::{DMat4, DVec3};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use std::sync::Arc;
use tch::Device;

/// Far plane of the synthetic scenes' frusta.
const FAR: f64 = 40.;

/// Times `steps` training steps (at least one) with `config`, at the final stage of the curriculum. The scenes are synthetic: images of
/// random noise, and cameras on a short path. L_perc is left out if its weights are missing. Sections and parts are timed by the clock of
/// the device; parts are those of all forward passes, with the operations of their backward passes. Of several slices in parallel they are
/// those of the first, with its share of the threads. With several ranks, all of them call this function, each with scenes of its own.
///
/// # Errors
/// Fails if the [`Trainer`] fails or another rank is gone.
pub fn bench_train(config: &Config, steps: usize, device: Device, group: ProcessGroup) -> Result<Value> {
    let mut config = config.clone();
    config.curriculum.full_capacity = true;
    if !PerceptualNetwork::weights_file(&config.loss)?.is_file() {
        config.loss.perceptual = PerceptualKind::None;
    }
    let (rank, ranks) = (group.rank(), group.world_size());
    let mut trainer = Trainer::new(&config, Arc::new(Vec::<Capture>::new()), device)?.with_group(group);
    trainer.broadcast_state()?;
    let seeds = (rank * config.train.batch_size) as u64..;
    let scenes: Vec<LoadedScene> =
        seeds.take(config.train.batch_size).map(|seed| synthetic_scene(&config, seed)).collect();
    let upload = Upload::new(device)?;
    let mut parts = Measured::default();
    let measured = measure(&mut trainer, &scenes, steps, &upload, &mut parts)?;
    let peak_bytes = peak_memory_bytes_on(device);
    let precision = config.train.precision;
    let (threads, slices_at_once) = (tch::get_num_threads(), trainer.slices_at_once(scenes.len()));
    tch::set_num_threads(threads / slices_at_once as i32);
    let peak_gflops = peak_gflops(precision, device);
    tch::set_num_threads(threads);
    let peak_gflops = peak_gflops?;
    let (milliseconds, sections) = (measured.total(), measured.sections());
    let together = (ranks > 1).then(|| {
        let scenes_per_second = 1e3 * (ranks * scenes.len()) as f64 / milliseconds.median;
        measure_distributed_cost(trainer, &scenes, steps, &upload, scenes_per_second)
    });
    let mut report = json!({
        "scenes": scenes.len(),
        "context_views": config.data.context_views,
        "target_views": config.data.target_views,
        "size": config.data.image_size,
        "gaussians": config.model.latents << config.curriculum.final_stage,
        "perceptual": config.loss.perceptual,
        "threads": threads,
        "slices_at_once": slices_at_once,
        "steps": steps,
        "milliseconds": milliseconds,
        "sections": sections,
        "parts": parts.parts(peak_gflops),
        "precision": precision,
        "peak_gflops": peak_gflops,
        "peak_bytes": peak_bytes,
    });
    if let Some(together) = together.transpose()? {
        report["together"] = together;
    }
    Ok(report)
}

/// Times `steps` steps, after one that warms up caches, threads and the GPU's libraries.
fn measure(
    trainer: &mut Trainer,
    scenes: &[LoadedScene],
    steps: usize,
    upload: &Upload,
    parts: &mut Measured,
) -> Result<Measured> {
    let mut measured = Measured::default();
    for step in 0..=steps {
        let mut watch = Stopwatch::new(upload.device());
        let sample = watch.time("data", || Batch::from_scenes_with(scenes, upload))?;
        let mut train_step = || trainer.train_step(&sample, &mut watch, &mut || true);
        match step {
            0 => train_step()?,
            _ => parts.record(upload.device(), train_step)?,
        };
        if step > 0 {
            measured.add_watch(&mut watch)?;
        }
    }
    Ok(measured)
}

/// Times the ranks' communication without steps, and their steps without communication.
fn measure_distributed_cost(
    trainer: Trainer,
    scenes: &[LoadedScene],
    steps: usize,
    upload: &Upload,
    scenes_per_second: f64,
) -> Result<Value> {
    let ranks = trainer.group().world_size();
    let mut communication = Measured::default();
    for step in 0..=steps {
        let mut watch = Stopwatch::new(upload.device());
        watch.time(COMMUNICATION, || trainer.add_gradients_up())?;
        if step > 0 {
            communication.add_watch(&mut watch)?;
        }
    }
    let communication = communication.total();
    let gradient_bytes = trainer.gradient_bytes();
    trainer.group().shutdown()?;
    let mut apart = trainer.with_group(ProcessGroup::single());
    let apart = measure(&mut apart, scenes, steps, upload, &mut Measured::default())?;
    Ok(json!({
        "ranks": ranks,
        "scenes_per_second": scenes_per_second,
        "apart_milliseconds": apart.total(),
        "communication_milliseconds": communication,
        "gradient_bytes": gradient_bytes,
    }))
}

/// Returns a scene of random noise with as many views as a step takes. Context and target views are disjoint.
pub(super) fn synthetic_scene(config: &Config, seed: u64) -> LoadedScene {
    let data = &config.data;
    let views = data.context_views + data.target_views;
    let size @ ImageSize { height, width } = data.image_size;
    let (w, h) = (f64::from(width), f64::from(height));
    let intrinsics = Intrinsics { fx: 0.9 * w, fy: 0.9 * w, cx: w / 2., cy: h / 2. };
    let camera = |view: usize| {
        let along = view as f64 / views as f64 - 0.5;
        Camera { intrinsics, c2w: DMat4::from_translation(DVec3::new(along, 0., 0.)), width, height }
    };
    let mut images = vec![0; views * 3 * width as usize * height as usize];
    ChaCha8Rng::seed_from_u64(seed).fill_bytes(&mut images);
    // Target views lie between context views, if there are enough of those.
    let is_target = |view: &usize| (view + 1) * data.target_views / views > view * data.target_views / views;
    let (target, context) = (0..views).partition(is_target);
    LoadedScene {
        name: String::new(),
        images,
        masks: None,
        depths: None,
        size,
        cameras: (0..views).map(camera).collect(),
        context,
        target,
        far: FAR,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::MemoryEstimate;
    use globalsplat_csrc::runtime::peak_tensor_bytes;
    use std::path::Path;

    /// Returns the estimate for a step of `settings`, divided by the measured peak.
    fn estimate_over_peak(settings: &[&str]) -> f64 {
        let base = [
            "model.latents=256",
            "model.width=128",
            "model.rgb_width=128",
            "model.ray_width=64",
            "model.rounds=2",
            "data.image_size=[64, 64]",
            "data.context_views=8",
            "data.target_views=4",
            "loss.perceptual=none",
            "curriculum.full_capacity=true",
            "train.batch_size=2",
        ];
        let all: Vec<String> = base.iter().chain(settings).map(|set| set.to_string()).collect();
        let config = Config::parse("", &all, Path::new("test")).unwrap();
        let ((), found) = peak_tensor_bytes(|| {
            let mut trainer = Trainer::new(&config, Arc::new(Vec::<Capture>::new()), Device::Cpu).unwrap();
            let scenes: Vec<_> = (0..2).map(|seed| synthetic_scene(&config, seed)).collect();
            let sample = Batch::from_scenes(&scenes, Device::Cpu).unwrap();
            trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).unwrap();
        });
        MemoryEstimate::new(&config, Device::Cpu).unwrap().total() as f64 / found as f64
    }

    #[test]
    fn estimate_is_near_the_measured_peak() {
        for settings in [
            &[][..],
            &["train.precision=bf16"],
            &["train.micro_batch=1"],
            &["train.checkpoint_rounds=true"],
            &["model.streams=single", "model.self_attention_blocks=4"],
            &["data.context_views=24", "data.target_views=12"],
            // A micro-batch avoids parallel slices, each of which would run on another thread.
            &["loss.consistency_alpha=0", "loss.consistency_depth=0", "train.micro_batch=2"],
        ] {
            let ratio = estimate_over_peak(settings);
            assert!((0.9..1.15).contains(&ratio), "{settings:?}: {ratio:.2} of the measured peak");
        }
    }
}
