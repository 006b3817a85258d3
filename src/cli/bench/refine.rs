//! Benchmark of a refinement step: the time of its parts, and the share of rendering.

use super::measure::TimingStats;
use super::raster::synthetic_gaussians;
use crate::data::ViewBatch;
use crate::device::Stopwatch;
use crate::error::Result;
use crate::refine::{
    Budget, Corrections, GaussianOptimizer, OptimizeArgs, Photos, RefineConfig, TrainProgress, refine_timed,
};
use crate::render::cpu::stage_times;
use crate::render::{DEFAULT_EPS2D, render};
use crate::scene::{ImageSize, RawGaussians};
use serde_json::{Value, json};
use std::time::Duration;
use tch::Device;

/// Number of photos of the synthetic scene.
const PHOTOS: usize = 8;
/// Number of steps before the measurement starts.
const WARM_UP: u64 = 5;

/// Times `steps` steps on `device`, with photos of `size` of a synthetic scene with `count` Gaussians. The optimization starts from these
/// Gaussians. `sections` are means per step; `other_share`, of all but rendering, is null on a GPU, where no backward pass is timed alone.
///
/// # Errors
/// Fails if the rasterizer fails.
pub fn bench_refine(
    count: usize,
    size: ImageSize,
    config: &RefineConfig,
    steps: u64,
    device: Device,
) -> Result<Value> {
    let (gaussians, cameras) = synthetic_gaussians(count, PHOTOS, size);
    let (gaussians, cameras) = (gaussians.to_device(device), cameras.to_device(device));
    let pictures = tch::no_grad(|| render(&gaussians, &cameras, DEFAULT_EPS2D))?;
    let c2w = cameras.w2c.inverse();
    let photos = Photos::from_batch(ViewBatch {
        images: pictures.rgb,
        masks: None,
        depths: None,
        c2w,
        w2c: cameras.w2c,
        intrinsics: cameras.intrinsics,
    });
    let mut optimizer = GaussianOptimizer::new(&RawGaussians::from_gaussians(&gaussians), 1., config, 0);
    let mut none = Corrections::none();
    let args = |steps| OptimizeArgs {
        photos: &photos,
        depth: 1.,
        config,
        budget: Budget::Steps(steps),
        seed: 0,
        background: None,
        progress: TrainProgress::default(),
    };
    refine_timed(&mut optimizer, &mut none, &args(WARM_UP), &mut Stopwatch::default(), |_| true)?;

    let mut stopwatch = Stopwatch::new(device);
    let (mut whole, mut before, mut backward) = (vec![], Duration::ZERO, 0.);
    refine_timed(&mut optimizer, &mut none, &args(steps), &mut stopwatch, |at| {
        whole.push(1e3 * (at.elapsed - before).as_secs_f64());
        before = at.elapsed;
        let stages = stage_times();
        backward += stages.blend_backward + stages.project_backward;
        true
    })?;
    let mean = |seconds: f64| 1e3 * seconds / steps as f64;
    let mut sections = vec![];
    for &(name, time) in stopwatch.sections()? {
        let time = time.as_secs_f64();
        match name {
            "backward" if device == Device::Cpu => {
                sections.push(("render backward", mean(backward)));
                sections.push(("rest of the backward pass", mean(time - backward)));
            }
            name => sections.push((name, mean(time))),
        }
    }
    let of_render = |(name, _): &&(&str, f64)| name.starts_with("render");
    let rendering: f64 = sections.iter().filter(of_render).map(|section| section.1).sum();
    let all: f64 = whole.iter().sum::<f64>() / steps as f64;
    Ok(json!({
        "gaussians": gaussians.count(),
        "views": config.views,
        "size": size,
        "threads": tch::get_num_threads(),
        "steps": steps,
        "milliseconds": TimingStats::from_milliseconds(whole),
        "sections": sections,
        "other_share": (device == Device::Cpu).then_some(1. - rendering / all),
    }))
}
