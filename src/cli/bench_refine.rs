use super::{device, parse_size, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::bench::{RefineReport, bench_refine};
use globalsplat::refine::RefineConfig;

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
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Refine {
    pub fn run(self) -> Result<()> {
        let config = RefineConfig::with(&self.set, true)?;
        let (size, device) = (parse_size(&self.size)?, device::parse(&self.device)?);
        let report = bench_refine(self.gaussians as usize, size, &config, self.steps, device)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report);
        }
        Ok(())
    }
}

fn print_report(r: &RefineReport) {
    let [height, width] = r.size;
    println!(
        "{} Gaussians, {} views of {width}x{height} a step, {} threads, {} steps",
        r.gaussians, r.views, r.threads, r.steps
    );
    println!("{:<28} {:>10}", "ms per step", "mean");
    for (name, milliseconds) in &r.sections {
        println!("{name:<28} {milliseconds:>10.2}");
    }
    let s = &r.milliseconds;
    println!("{:<28} {:>10.2} median, {:.2} min, {:.2} p75", "step", s.median, s.min, s.upper_quartile);
    if let Some(share) = r.other_share {
        println!("all but rendering: {:.0} %", 1e2 * share);
    }
}
