use super::bench_common::{print_parts, print_sections, read_config};
use super::{memory, print_json, ranks};
use anyhow::Result;
use clap::Args;
use globalsplat::bench::{Part, Together, TrainReport, bench_train};
use globalsplat::error::Error;
use serde_json::json;
use std::path::PathBuf;

/// A training step, part by part, on made-up scenes: pictures of noise, all Gaussians shown.
///
/// Without --config it is the paper's main model, 24 context and 12 target views of 256x256. L_perc takes part where its
/// weights are there. Under torchrun it also tells what working together costs: time of a step apart, of communication by itself, and
/// how much of that the backward pass hides.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench train\n  \
    globalsplat bench train --config configs/first_light.toml --steps 20\n  \
    globalsplat bench train --set train.checkpoint_rounds=true --json\n  \
    torchrun --no-python --nproc-per-node=2 target/release/globalsplat bench train --config configs/tiny.toml")]
pub struct Train {
    /// Configuration file; see configs/
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of it, as in train.checkpoint_rounds=true
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Scenes in a step, whatever train.batch says
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    batch: u16,
    /// Steps that are measured
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Share the optimizer's moments out over the processes that torchrun started
    #[arg(long)]
    shard_optimizer: bool,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Train {
    pub fn run(self) -> Result<()> {
        let (group, device) = ranks::join(&self.device)?;
        let is_first = group.is_first();
        let mut config = read_config(self.config.as_deref(), &self.set)?;
        if let Some(set) = self.set.iter().find(|set| set.trim_start().starts_with("train.batch")) {
            return Err(Error::Request(format!("--set {set}: expected --batch N")).into());
        }
        config.train.batch = self.batch.into();
        memory::keep_for(&config.train);
        let report = bench_train(&config, self.steps as usize, device, group, self.shard_optimizer)?;
        if !is_first {
            return Ok(());
        }
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report);
        }
        Ok(())
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
        1e5 * (forward + backward) / r.milliseconds.least / r.peak_gflops,
        r.peak_gflops,
        r.precision
    );
    println!("memory {:.2} GB at the most", r.peak_bytes as f64 * 1e-9);
    if let Some(together) = &r.together {
        print_together(together);
    }
}

fn print_together(together: &Together) {
    let Together { ranks, scenes_per_second, apart_milliseconds, communication_milliseconds, .. } = together;
    println!("{ranks} processes make {scenes_per_second:.2} scenes a second together");
    println!(
        "a step apart takes {:.1} ms, adding up {:.1} MB of gradients {:.1} ms, of which {:.0} % is hidden",
        apart_milliseconds.median,
        together.gradient_bytes as f64 * 1e-6,
        communication_milliseconds.median,
        1e2 * together.hidden
    );
}
