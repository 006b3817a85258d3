use super::bench_common::{print_parts, print_sections, read_config};
use super::{distributed, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::bench::{DistributedCost, Part, TrainReport, bench_train};
use globalsplat::config::Config;
use globalsplat::device::total_memory_bytes;
use globalsplat::distributed::ProcessGroup;
use globalsplat::error::{Error, panic_message};
use globalsplat::train::largest_fitting_batch;
use serde_json::json;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::PathBuf;
use tch::Device;

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
    /// Configuration file; see configs/
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, as in train.checkpoint_rounds=true
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Number of scenes per step; auto takes the largest of train.batch_size, half of it, a quarter, … that fits into the device's
    /// memory without train.micro_batch
    #[arg(long, value_name = "N", default_value = "1", value_parser = parse_batch)]
    batch: Batch,
    /// Number of measured steps
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

/// Number of scenes per step, as `--batch` takes it.
#[derive(Debug, Clone, Copy)]
enum Batch {
    Auto,
    Scenes(usize),
}

fn parse_batch(text: &str) -> Result<Batch, String> {
    match text.parse() {
        Ok(scenes @ 1..=65535) => Ok(Batch::Scenes(scenes)),
        _ if text == "auto" => Ok(Batch::Auto),
        _ => Err("expected auto, or a number from 1 to 65535".into()),
    }
}

impl Train {
    pub fn run(self) -> Result<()> {
        let (group, device) = distributed::join(&self.device)?;
        let is_main_process = group.is_main_process();
        let mut config = read_config(self.config.as_deref(), &self.set)?;
        if let Some(set) = self.set.iter().find(|set| set.trim_start().starts_with("train.batch")) {
            return Err(Error::request(format!("--set {set}: expected --batch N")).into());
        }
        let report = match self.batch {
            Batch::Scenes(scenes) => {
                config.train.batch_size = scenes;
                bench_train(&config, self.steps as usize, device, group)?
            }
            Batch::Auto if group.world_size() > 1 => {
                return Err(Error::request("--batch auto: expected a number under torchrun").into());
            }
            Batch::Auto => self.bench_what_fits(config, device)?,
        };
        if !is_main_process {
            return Ok(());
        }
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report);
        }
        Ok(())
    }

    /// Runs the benchmark with the batch size that fits by the estimate; if a GPU still runs out of memory, halves it and tries
    /// again.
    fn bench_what_fits(&self, mut config: Config, device: Device) -> Result<TrainReport> {
        let wanted = config.train.batch_size;
        let bytes = total_memory_bytes(device).unwrap_or(u64::MAX);
        let (fits, refused) = largest_fitting_batch(&config, bytes, device)?;
        if let Some(refused) = refused {
            let [more, bytes] = [refused.total(), bytes].map(|bytes| bytes as f64 * 1e-9);
            eprintln!(
                "--batch auto: {fits} of {wanted} scenes; {} would take {more:.1} GB, the device has {bytes:.1} GB",
                refused.batch
            );
        }
        config.train.batch_size = fits;
        config.train.micro_batch = 0;
        loop {
            let batch = config.train.batch_size;
            let (steps, alone) = (self.steps as usize, ProcessGroup::single());
            let bench = || bench_train(&config, steps, device, alone);
            let is_refused = |why: &str| batch > 1 && why.contains("out of memory");
            match catch_unwind(AssertUnwindSafe(bench)) {
                Ok(Err(error)) if is_refused(&error.to_string()) => {}
                Ok(done) => return Ok(done?),
                Err(panic) if is_refused(panic_message(&*panic)) => {}
                Err(panic) => resume_unwind(panic),
            }
            config.train.batch_size = batch / 2;
            eprintln!("--batch auto: {} scenes; there was too little memory for {batch}", batch / 2);
        }
    }
}

fn print_report(r: &TrainReport) {
    let [height, width] = r.size;
    println!(
        "{} scenes of {} context and {} target views of {width}x{height}, {} Gaussians, loss.perceptual={}, {} threads, {} steps",
        r.scenes,
        r.context_views,
        r.target_views,
        r.gaussians,
        json!(r.perceptual),
        r.threads,
        r.steps
    );
    if r.slices_at_once > 1 {
        println!("{} slices side by side; all but steps and memory is of the first", r.slices_at_once);
    }
    print_sections("ms per step", &r.sections, ("step", &r.milliseconds));
    print_parts("ms, forward alone", &r.parts, &r.milliseconds);
    let sum = |of: fn(&Part) -> f64| r.parts.iter().map(of).sum::<f64>();
    let (forward, backward) = (sum(|part| part.gflop), sum(|part| part.backward_gflop));
    println!(
        "{forward:.0} GFLOP forward and {backward:.0} for gradients: {:.1} % of the {:.0} GFLOP/s that a product of large matrices \
         reaches in {}",
        1e5 * (forward + backward) / r.milliseconds.min / r.peak_gflops,
        r.peak_gflops,
        r.precision
    );
    println!("memory {:.2} GB at the most", r.peak_bytes as f64 * 1e-9);
    if let Some(together) = &r.together {
        print_together(together);
    }
}

fn print_together(together: &DistributedCost) {
    let DistributedCost { ranks, scenes_per_second, apart_milliseconds, communication_milliseconds, .. } =
        together;
    println!("{ranks} processes make {scenes_per_second:.2} scenes a second together");
    println!(
        "a step apart takes {:.1} ms, adding up {:.1} MB of gradients {:.1} ms, of which {:.0} % is hidden",
        apart_milliseconds.median,
        together.gradient_bytes as f64 * 1e-6,
        communication_milliseconds.median,
        1e2 * together.hidden
    );
}
