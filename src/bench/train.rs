//! A training step: how long its parts take, and how much memory it needs.

use super::{Measured, Section, Spread};
use crate::config::Config;
use crate::data::{Capture, LoadTimes, LoadedScene, Sample};
use crate::device::Upload;
use crate::error::Result;
use crate::eval::peak_memory_bytes_on;
use crate::loss::{PerceptualKind, PerceptualLoss};
use crate::optim::Stopwatch;
use crate::scene::{Camera, ImageSize, Intrinsics};
use crate::train::Trainer;
use glam::{DMat4, DVec3};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::sync::Arc;
use tch::Device;

/// Far end of the made-up scenes' frusta.
const FAR: f64 = 40.;

/// What [`bench_train`] measured.
#[derive(Debug, Serialize)]
pub struct TrainReport {
    /// Scenes in a step.
    pub scenes: usize,
    /// Photos that the model sees of a scene.
    pub context_views: usize,
    /// Pictures of a scene that are compared.
    pub target_views: usize,
    /// [height, width] of both.
    pub size: [u32; 2],
    /// Of a scene.
    pub gaussians: i64,
    /// The network of L_perc.
    pub perceptual: PerceptualKind,
    /// Threads that shared the work.
    pub threads: i32,
    /// Steps that were measured.
    pub steps: usize,
    /// Of a whole step.
    pub milliseconds: Spread,
    /// In the order of the work.
    pub sections: Vec<Section>,
    /// Bytes that tensors on a GPU, or the process, took at the most.
    pub peak_bytes: u64,
}

/// Times `steps` steps (at least one) of what `config` says, from the curriculum's last stage, on made-up scenes: pictures
/// of noise, cameras on a short path. L_perc is left out where its weights aren't there. The parts of a step are told by the
/// device's own clock.
///
/// # Errors
/// What [`Trainer`] fails with.
pub fn bench_train(config: &Config, steps: usize, device: Device) -> Result<TrainReport> {
    let mut config = config.clone();
    config.curriculum.full_capacity = true;
    if !PerceptualLoss::weights_file(&config.loss)?.is_file() {
        config.loss.perceptual = PerceptualKind::None;
    }
    let mut trainer = Trainer::new(&config, Arc::new(Vec::<Capture>::new()), device)?;
    let scenes: Vec<LoadedScene> =
        (0..config.train.batch as u64).map(|seed| made_up_scene(&config, seed)).collect();
    let (mut measured, upload) = (Measured::default(), Upload::to(device));
    // The first step warms caches, threads and the GPU's libraries up.
    for step in 0..=steps {
        let mut watch = Stopwatch::of(device);
        let sample = watch.time("data", || Sample::by(&scenes, &upload));
        trainer.learn(&sample, &mut watch, &mut || true)?;
        if step > 0 {
            measured.add(&mut watch);
        }
    }
    let (milliseconds, sections) = measured.told();
    Ok(TrainReport {
        scenes: scenes.len(),
        context_views: config.data.context_views,
        target_views: config.data.target_views,
        size: config.data.image_size.into(),
        gaussians: config.model.latents << config.curriculum.final_stage,
        perceptual: config.loss.perceptual,
        threads: tch::get_num_threads(),
        steps,
        milliseconds,
        sections,
        peak_bytes: peak_memory_bytes_on(device),
    })
}

/// As many views as a step takes, context and target apart.
pub(super) fn made_up_scene(config: &Config, seed: u64) -> LoadedScene {
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
    // Targets lie between context views, as far as there are enough of them.
    let is_target = |view: &usize| (view + 1) * data.target_views / views > view * data.target_views / views;
    let (target, context) = (0..views).partition(is_target);
    LoadedScene {
        name: String::new(),
        images,
        size,
        cameras: (0..views).map(camera).collect(),
        context,
        target,
        far: FAR,
        times: LoadTimes::default(),
    }
}
