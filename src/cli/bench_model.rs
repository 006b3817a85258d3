use super::bench_common::{print_part, print_parts, read_config};
use super::{device, model, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::bench::{ModelReport, Part, bench_model};
use std::path::PathBuf;

/// Benchmark a forward pass, photos to Gaussians, part by part, on photos of noise and with newly initialized weights.
///
/// Without --config the model is the paper's main model, 256x256 pixels.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench model\n  \
    globalsplat bench model --config configs/tiny.toml --views 12\n  \
    globalsplat bench model --device cuda --precision bf16 --repeats 50 --json")]
pub struct Model {
    /// Configuration file; see configs/
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
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
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Model {
    pub fn run(self) -> Result<()> {
        let device = device::parse(&self.device)?;
        let asked = model::parse_precision(&self.precision)?;
        let mut config = read_config(self.config.as_deref(), &self.set)?;
        let precision = model::precision(asked, device, config.model.width);
        config.data.context_views = self.views.into();
        let report = bench_model(&config, precision, self.repeats as usize, device)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report, &self);
        }
        Ok(())
    }
}

fn print_report(r: &ModelReport, asked: &Model) {
    let [height, width] = r.size;
    println!(
        "{} photos of {width}x{height}, {} Gaussians, {}, {}, {} threads, {} passes",
        r.views, r.gaussians, r.precision, asked.device, r.threads, r.repeats
    );
    print_parts("ms per pass", &r.parts, &r.milliseconds);
    let [flop, bytes] = [|part: &Part| part.gflop, |part: &Part| part.gigabytes]
        .map(|of| r.parts.iter().map(of).sum::<f64>());
    let of_peak = 1e5 * flop / r.milliseconds.min / r.peak_gflops;
    print_part(
        "pass",
        &r.milliseconds,
        &r.milliseconds,
        &format!("{flop:>9.2} {bytes:>7.3} {of_peak:>11.1} %"),
    );
    println!("a product of large matrices reaches {:.0} GFLOP/s in {}", r.peak_gflops, r.precision);
    println!("memory {:.2} GB at the most", r.peak_bytes as f64 * 1e-9);
}
