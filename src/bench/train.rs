//! A training step: how long its parts take, and how much memory it needs.

use super::parts::{Part, Parts};
use super::yardstick::Yardstick;
use super::{Measured, Section, Spread};
use crate::config::Config;
use crate::data::{Capture, LoadTimes, LoadedScene, Sample};
use crate::device::Upload;
use crate::error::Result;
use crate::eval::peak_memory_bytes_on;
use crate::loss::{PerceptualKind, PerceptualLoss};
use crate::model::Precision;
use crate::optim::Stopwatch;
use crate::ranks::Group;
use crate::scene::{Camera, ImageSize, Intrinsics};
use crate::train::{COMMUNICATION, Trainer};
use glam::{DMat4, DVec3};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::sync::Arc;
use tch::Device;

/// Products that the machine is measured by.
const PRODUCTS: usize = 5;
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
    /// Slices of a step that these threads follow side by side. Sections, parts and the peak are of the first, with its share of them.
    pub slices_at_once: usize,
    /// Steps that were measured.
    pub steps: usize,
    /// Of a whole step.
    pub milliseconds: Spread,
    /// In the order of the work.
    pub sections: Vec<Section>,
    /// Of all forward passes, again where rounds are computed again; and what their gradients take.
    pub parts: Vec<Part>,
    /// Of matrix products.
    pub precision: Precision,
    /// A product of large matrices in that precision, in 10⁹ floating-point operations a second.
    pub peak_gflops: f64,
    /// Bytes that tensors on a GPU, or the process, took at the most.
    pub peak_bytes: u64,
    /// What working together costs, where there are several processes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub together: Option<Together>,
}

/// What it costs processes to make a step together.
#[derive(Debug, Serialize)]
pub struct Together {
    /// How many there are.
    pub ranks: usize,
    /// Scenes that all of them make in a second.
    pub scenes_per_second: f64,
    /// Of a step that each of them makes by itself, all at the same time.
    pub apart_milliseconds: Spread,
    /// Of adding all gradients up with nothing else to do meanwhile.
    pub communication_milliseconds: Spread,
    /// The share of it that was over when the backward pass was, in the step that waited least: others wait for slower ranks, too.
    pub hidden: f64,
    /// Bytes of the gradients.
    pub gradient_bytes: u64,
}

/// Times `steps` steps (at least one) of what `config` says, from the curriculum's last stage, on made-up scenes: pictures
/// of noise, cameras on a short path. L_perc is left out where its weights aren't there. The parts of a step are told by the
/// device's own clock. Of several ranks, all call this, each with scenes of its own.
///
/// # Errors
/// What [`Trainer`] fails with, or another rank that is gone.
pub fn bench_train(
    config: &Config,
    steps: usize,
    device: Device,
    group: Group,
    shards_optimizer: bool,
) -> Result<TrainReport> {
    let mut config = config.clone();
    config.curriculum.full_capacity = true;
    if !PerceptualLoss::weights_file(&config.loss)?.is_file() {
        config.loss.perceptual = PerceptualKind::None;
    }
    let (rank, ranks) = (group.rank(), group.ranks());
    let trainer = Trainer::new(&config, Arc::new(Vec::<Capture>::new()), device)?;
    let mut trainer = match shards_optimizer {
        true => trainer.with_ranks(group).with_sharded_optimizer(),
        false => trainer.with_ranks(group),
    };
    trainer.follow_first()?;
    let seeds = (rank * config.train.batch) as u64..;
    let scenes: Vec<LoadedScene> =
        seeds.take(config.train.batch).map(|seed| made_up_scene(&config, seed)).collect();
    let upload = Upload::to(device);
    let mut parts = Parts::default();
    let measured = measure(&mut trainer, &scenes, steps, &upload, &mut parts)?;
    let peak_bytes = peak_memory_bytes_on(device);
    let precision = config.train.precision;
    let (threads, slices_at_once) = (tch::get_num_threads(), trainer.slices_at_once(scenes.len()));
    let yardstick = Yardstick::new(precision, device);
    tch::set_num_threads(threads / slices_at_once as i32);
    let products = (0..=PRODUCTS).map(|_| yardstick.time()).skip(1).collect();
    tch::set_num_threads(threads);
    let peak_gflops = yardstick.gflops(Spread::of(products).least);
    let (milliseconds, sections) = measured.told();
    let waited = sections.iter().find(|section| section.name == COMMUNICATION);
    let together = waited.map(|waited| {
        let scenes_per_second = 1e3 * (ranks * scenes.len()) as f64 / milliseconds.median;
        together(trainer, &scenes, steps, &upload, scenes_per_second, waited.milliseconds.least)
    });
    Ok(TrainReport {
        scenes: scenes.len(),
        context_views: config.data.context_views,
        target_views: config.data.target_views,
        size: config.data.image_size.into(),
        gaussians: config.model.latents << config.curriculum.final_stage,
        perceptual: config.loss.perceptual,
        threads,
        slices_at_once,
        steps,
        milliseconds,
        sections,
        parts: parts.told(peak_gflops),
        precision,
        peak_gflops,
        peak_bytes,
        together: together.transpose()?,
    })
}

/// `steps` steps, after one that warms caches, threads and the GPU's libraries up.
fn measure(
    trainer: &mut Trainer,
    scenes: &[LoadedScene],
    steps: usize,
    upload: &Upload,
    parts: &mut Parts,
) -> Result<Measured> {
    let mut measured = Measured::default();
    for step in 0..=steps {
        let mut watch = Stopwatch::of(upload.device());
        let sample = watch.time("data", || Sample::by(scenes, upload));
        let mut learn = || trainer.learn(&sample, &mut watch, &mut || true);
        match step {
            0 => learn()?,
            _ => parts.watch(upload.device(), learn)?,
        };
        if step > 0 {
            measured.add(&mut watch);
        }
    }
    Ok(measured)
}

/// What is left of ranks' steps without communication, and of communication without steps.
fn together(
    trainer: Trainer,
    scenes: &[LoadedScene],
    steps: usize,
    upload: &Upload,
    scenes_per_second: f64,
    waited: f64,
) -> Result<Together> {
    let ranks = trainer.group().ranks();
    let mut communication = Measured::default();
    for step in 0..=steps {
        let mut watch = Stopwatch::of(upload.device());
        watch.time(COMMUNICATION, || trainer.add_gradients_up())?;
        if step > 0 {
            communication.add(&mut watch);
        }
    }
    let communication = communication.told().0;
    let gradient_bytes = trainer.gradient_bytes();
    trainer.group().leave()?;
    let mut apart = trainer.with_ranks(Group::alone());
    Ok(Together {
        ranks,
        scenes_per_second,
        apart_milliseconds: measure(&mut apart, scenes, steps, upload, &mut Parts::default())?.told().0,
        communication_milliseconds: communication,
        hidden: (1. - waited / communication.median).clamp(0., 1.),
        gradient_bytes,
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::MemoryEstimate;
    use globalsplat_csrc::tensor_memory::peak_tensor_bytes;
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
            "train.batch=2",
        ];
        let all: Vec<String> = base.iter().chain(settings).map(|set| set.to_string()).collect();
        let config = Config::parse("", &all, Path::new("test")).unwrap();
        let ((), found) = peak_tensor_bytes(|| {
            let mut trainer = Trainer::new(&config, Arc::new(Vec::<Capture>::new()), Device::Cpu).unwrap();
            let scenes: Vec<_> = (0..2).map(|seed| made_up_scene(&config, seed)).collect();
            let sample = Sample::by(&scenes, &Upload::to(Device::Cpu));
            trainer.learn(&sample, &mut Stopwatch::default(), &mut || true).unwrap();
        });
        MemoryEstimate::of(&config, Device::Cpu).unwrap().total() as f64 / found as f64
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
            // Side by side, each slice would be another thread's.
            &["loss.consistency_alpha=0", "loss.consistency_depth=0", "train.micro_batch=2"],
        ] {
            let ratio = estimate_over_peak(settings);
            assert!((0.9..1.15).contains(&ratio), "{settings:?}: {ratio:.2} of the measured peak");
        }
    }
}
