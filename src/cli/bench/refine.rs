//! Benchmark of a refinement step: the time of its parts, and the share of rendering.

use super::measure::TimingStats;
use super::raster::{camera_path, synthetic_gaussians};
use crate::data::View;
use crate::device::Stopwatch;
use crate::error::Result;
use crate::refine::{
    Budget, GaussianOptimizer, OptimizeArgs, PhotoOpt, Photos, RefineOptions, TrainProgress, refine,
};
use crate::render::cpu::stage_times;
use crate::render::render_views;
use crate::scene::{ImageSize, RawGaussians};
use serde_json::{Value, json};
use std::time::Instant;
use tch::{Device, Kind};

/// Number of photos of the synthetic scene.
const PHOTOS: usize = 8;
/// Number of steps before the measurement starts.
const WARM_UP: u64 = 5;

/// Times `steps` steps on the device of `options`, with photos of `size` of a synthetic scene with `count` Gaussians. The optimization starts
/// from these Gaussians. `sections` are means per step; `other_share`, of all but rendering, is null on a GPU, where no backward pass is timed
/// alone.
///
/// # Errors
/// Fails if the rasterizer fails.
pub fn bench_refine(count: usize, size: ImageSize, options: &RefineOptions, steps: u64) -> Result<Value> {
    let (gaussians, cameras) = (synthetic_gaussians(count, PHOTOS, size).0, camera_path(PHOTOS, size));
    let views: Vec<View> = render_views(&gaussians, &cameras)?
        .into_iter()
        .zip(&cameras)
        .map(|(view, &camera)| {
            let levels = (view.rgb.clamp(0., 1.) * 255.).round().to_kind(Kind::Uint8);
            View { name: String::new(), image: levels.into(), mask: None, camera }
        })
        .collect();
    let device = options.device;
    let photos = Photos::new(&views, &[], options);
    let gaussians = RawGaussians::from_gaussians(&gaussians.to_device(device));
    let mut optimizer = GaussianOptimizer::new(&gaussians, 1., options, 0);
    let mut none = PhotoOpt::none();
    let args = |steps| OptimizeArgs {
        photos: &photos,
        options,
        budget: Budget::Steps(steps),
        progress: TrainProgress::default(),
    };
    refine(&mut optimizer, &mut none, &args(WARM_UP), &mut Stopwatch::default(), |_| true)?;

    let mut stopwatch = Stopwatch::new(device);
    let (mut whole, mut before, mut backward) = (vec![], Instant::now(), 0.);
    refine(&mut optimizer, &mut none, &args(steps), &mut stopwatch, |_| {
        whole.push(1e3 * before.elapsed().as_secs_f64());
        before = Instant::now();
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
        "gaussians": count,
        "views": options.views,
        "size": size,
        "threads": tch::get_num_threads(),
        "steps": steps,
        "milliseconds": TimingStats::from_milliseconds(whole),
        "sections": sections,
        "other_share": (device == Device::Cpu).then_some(1. - rendering / all),
    }))
}
