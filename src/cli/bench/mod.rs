//! `globalsplat bench`: benchmarks, which tests don't run. Each returns the JSON object that the command prints.

mod measure;
mod model;
mod raster;
mod refine;
mod train;

use self::model::bench_model;
use self::raster::{bench_raster, synthetic_gaussians};
use self::refine::bench_refine;
use self::train::bench_train;
use super::model::{parse_precision, precision};
use super::{Output, device, distributed, keep_freed_memory, open_capture, parse_size, warn};
use crate::config::Config;
use crate::data::{load_all_views, view_batch};
use crate::device::total_memory_bytes;
use crate::error::Error;
use crate::io::read_splat;
use crate::refine::RefineOptions;
use crate::scene::Gaussians;
use crate::train::MemoryEstimate;
use anyhow::Result;
use clap::{Args, Subcommand};
use serde_json::Value;
use std::path::PathBuf;
use tch::Device;

/// Measure the speed of the program's parts on this machine.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench raster\n  globalsplat bench model")]
pub struct Bench {
    #[command(subcommand)]
    part: Part,
}

#[derive(Subcommand)]
enum Part {
    Raster(Raster),
    Model(Model),
    Refine(Refine),
    Train(Train),
}

impl Bench {
    pub fn run(self) -> Result<Output> {
        Ok(Output::table(match self.part {
            Part::Raster(raster) => raster.run(),
            Part::Model(model) => model.run(),
            Part::Refine(refine) => refine.run(),
            Part::Train(train) => train.run(),
        }?))
    }

    /// Returns `true` if the processes that torchrun started share the work.
    pub fn is_shared(&self) -> bool {
        matches!(self.part, Part::Train(_))
    }
}

/// Benchmark the splat op, forward and backward, stage by stage.
///
/// Without --splat and --scene the input is synthetic: 16,384 Gaussians shaped like a trained scene, 12 cameras, 256x256.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench raster\n  \
    globalsplat bench raster --splat room.ply --scene captures/room --threads 1")]
pub struct Raster {
    /// Splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf, .ksplat or .zip
    #[arg(long, value_name = "FILE", requires = "scene")]
    splat: Option<PathBuf>,
    /// Capture whose cameras render the splat, all in one call
    #[arg(long, value_name = "PATH", requires = "splat")]
    scene: Option<PathBuf>,
    /// Number of Gaussians in the synthetic scene
    #[arg(long, value_name = "N", default_value_t = 16_384, value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "splat")]
    gaussians: u32,
    /// Number of cameras of the synthetic scene, all in one call
    #[arg(long, value_name = "N", default_value_t = 12, value_parser = clap::value_parser!(u16).range(1..), conflicts_with = "splat")]
    cameras: u16,
    /// Image size of the synthetic scene's cameras
    #[arg(long, value_name = "WxH", default_value = "256x256", conflicts_with = "splat")]
    size: String,
    /// Number of threads; by default all cores
    #[arg(long, value_name = "N")]
    threads: Option<u16>,
    /// Number of timed calls
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Raster {
    fn run(self) -> Result<Value> {
        keep_freed_memory();
        if let Some(threads) = self.threads {
            tch::set_num_threads(i32::from(threads).max(1));
        }
        // The device is parsed before tensors are created, so that a missing one is reported immediately.
        let device = device::parse(&self.device)?;
        let (gaussians, cameras) = match (&self.splat, &self.scene) {
            (Some(splat), Some(scene)) => {
                let splat = read_splat(splat)?;
                warn(&splat.warnings);
                let gaussians = Gaussians::from_splat(&splat);
                let frame = gaussians.local_frame(splat.origin);
                let views = load_all_views(&open_capture(scene)?, None)?;
                let poses: Vec<_> =
                    views.iter().map(|view| frame.camera_to_local(&view.camera).c2w).collect();
                let gaussians = gaussians.to_local(&frame, splat.origin);
                (gaussians, view_batch(&views, &poses, Device::Cpu).cameras())
            }
            _ => synthetic_gaussians(self.gaussians as usize, self.cameras.into(), parse_size(&self.size)?),
        };
        let (gaussians, cameras) = (gaussians.to_device(device), cameras.to_device(device));
        Ok(bench_raster(&gaussians, &cameras, self.repeats as usize)?)
    }
}

/// Benchmark a forward pass, photos to Gaussians, part by part, on photos of noise and with newly initialized weights.
///
/// Without --config the model is the paper's main model, 256x256 pixels.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench model\n  \
    globalsplat bench model --config configs/tiny.toml --views 12\n  \
    globalsplat bench model --device cuda --precision bf16 --repeats 50 --json")]
pub struct Model {
    #[command(flatten)]
    config: Configuration,
    /// Number of input photos
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(1..))]
    views: u16,
    /// Number of measured passes
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Precision of matrix products: f32, bf16, or auto: bf16 for wide models if the device has instructions for it
    #[arg(long, default_value = "auto")]
    precision: String,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

/// Configuration to measure; without a file, the defaults, which are the paper's main model.
#[derive(Args)]
struct Configuration {
    /// Configuration file; see configs/
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, as in train.checkpoint_rounds=true
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl Configuration {
    fn read(&self) -> Result<Config> {
        Ok(match &self.config {
            Some(file) => Config::read(file, &self.set)?,
            None => Config::parse("", &self.set, "the defaults".as_ref())?,
        })
    }
}

impl Model {
    fn run(self) -> Result<Value> {
        let device = device::parse(&self.device)?;
        let requested = parse_precision(&self.precision)?;
        let mut config = self.config.read()?;
        let precision = precision(requested, device, config.model.width);
        config.data.context_views = self.views.into();
        Ok(bench_model(&config, precision, self.repeats as usize, device)?)
    }
}

/// Benchmark a step of `refine`, part by part, on a synthetic scene.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat bench refine\n  globalsplat bench refine --size 64x64 --set views=4"
)]
pub struct Refine {
    /// Number of Gaussians in the splat
    #[arg(long, value_name = "N", default_value_t = 16_384, value_parser = clap::value_parser!(u32).range(1..))]
    gaussians: u32,
    /// Size of the photos
    #[arg(long, value_name = "WxH", default_value = "256x256")]
    size: String,
    /// Number of measured steps
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    steps: u64,
    /// Override a setting of the refinement
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Refine {
    fn run(self) -> Result<Value> {
        keep_freed_memory();
        let device = device::parse(&self.device)?;
        let options = RefineOptions { set: self.set, device, ..Default::default() }.resolve(true)?;
        Ok(bench_refine(self.gaussians as usize, parse_size(&self.size)?, &options, self.steps)?)
    }
}

/// Benchmark a training step, part by part, on synthetic scenes: photos of noise, all Gaussians visible.
///
/// Without --config the model is the paper's main model, 24 context and 12 target views of 256x256. L_perc is included if its
/// weights are found. Under torchrun the report includes the cost of distributed training: the time of a step without
/// communication, of communication alone, and how much of that the backward pass hides.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench train\n  \
    globalsplat bench train --config configs/first_light.toml --steps 20\n  \
    globalsplat bench train --set train.checkpoint_rounds=true --json\n  \
    globalsplat bench train --device cuda --batch auto\n  \
    torchrun --no-python --nproc-per-node=2 target/release/globalsplat bench train --config configs/tiny.toml")]
pub struct Train {
    #[command(flatten)]
    config: Configuration,
    /// Number of scenes per step; auto takes the largest of train.batch_size, half of it, a quarter, … that fits into the device's
    /// memory without train.micro_batch
    #[arg(long, value_name = "N", default_value = "1")]
    batch: String,
    /// Number of measured steps
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Train {
    fn run(self) -> Result<Value> {
        let (group, device) = distributed::join(&self.device)?;
        let mut config = self.config.read()?;
        if let Some(set) = self.config.set.iter().find(|set| set.trim_start().starts_with("train.batch")) {
            return Err(Error::request(format!("--set {set}: expected --batch N")).into());
        }
        if !config.train.checkpoint_rounds {
            keep_freed_memory();
        }
        match self.batch.parse() {
            Ok(scenes @ 1..=65535) => config.train.batch_size = scenes,
            _ if self.batch != "auto" || group.world_size() > 1 => {
                let auto = if group.world_size() > 1 { "" } else { ", or auto" };
                let why = format!("--batch {}: expected a number from 1 to 65535{auto}", self.batch);
                return Err(Error::request(why).into());
            }
            _ => take_what_fits(&mut config, device)?,
        }
        Ok(bench_train(&config, self.steps as usize, device, group)?)
    }
}

/// Halves the batch size until all scenes fit at once into the memory of `device`, by the estimate. A batch size of 1 isn't checked.
fn take_what_fits(config: &mut Config, device: Device) -> Result<()> {
    let bytes = total_memory_bytes(device).unwrap_or(u64::MAX);
    let (batch_size, mut refused) = (config.train.batch_size, None);
    config.train.micro_batch = 0;
    while config.train.batch_size > 1 {
        let estimate = MemoryEstimate::new(config, device)?;
        if estimate.fits_into(bytes) {
            break;
        }
        refused = Some(estimate);
        config.train.batch_size /= 2;
    }
    if let Some(refused) = refused {
        let [more, bytes] = [refused.total(), bytes].map(|bytes| bytes as f64 * 1e-9);
        eprintln!(
            "--batch auto: {} of {batch_size} scenes; {} would take {more:.1} GB, the device has {bytes:.1} GB",
            config.train.batch_size, refused.batch
        );
    }
    Ok(())
}
