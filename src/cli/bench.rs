use super::print_json;
use anyhow::Result;
use clap::{Args, Subcommand};
use globalsplat::bench::{RasterReport, Spread, bench_raster, made_up_scene};
use globalsplat::data::{open_capture, view_batch};
use globalsplat::error::Error;
use globalsplat::io::read_ply;
use globalsplat::render::Cameras;
use std::path::PathBuf;
use tch::Device;

/// Measure how fast this machine runs the parts.
#[derive(Args)]
pub struct Bench {
    #[command(subcommand)]
    part: Part,
}

#[derive(Subcommand)]
enum Part {
    Raster(Raster),
}

impl Bench {
    pub fn run(self) -> Result<()> {
        match self.part {
            Part::Raster(raster) => raster.run(),
        }
    }
}

/// The splat op, forward and backward, stage by stage.
///
/// Without --splat and --scene the input is made up: 16,384 Gaussians shaped like a trained scene, 12 cameras, 256x256.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench raster\n  \
    globalsplat bench raster --splat room.ply --scene captures/room --threads 1")]
pub struct Raster {
    /// A 3DGS splat
    #[arg(long, value_name = "FILE.ply", requires = "scene")]
    splat: Option<PathBuf>,
    /// The capture whose cameras look at it, all in one call
    #[arg(long, value_name = "PATH", requires = "splat")]
    scene: Option<PathBuf>,
    /// Threads that share the work; by default all cores
    #[arg(long, value_name = "N")]
    threads: Option<u16>,
    /// Calls that are timed
    #[arg(long, value_name = "N", default_value_t = 30)]
    repeats: u32,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Raster {
    pub fn run(self) -> Result<()> {
        if let Some(threads) = self.threads {
            tch::set_num_threads(i32::from(threads).max(1));
        }
        if self.repeats == 0 {
            return Err(Error::Request("--repeats is 0, expected 1 or more".into()).into());
        }
        let (gaussians, cameras) = match (&self.splat, &self.scene) {
            (Some(splat), Some(scene)) => {
                let gaussians = read_ply(splat)?.gaussians;
                let views = open_capture(scene)?.load_all(None)?;
                let poses: Vec<_> = views.iter().map(|view| view.camera.c2w).collect();
                (gaussians, Cameras::of(&view_batch(&views, &poses, Device::Cpu)))
            }
            _ => made_up_scene(16_384, 12, 256, 256),
        };
        let report = bench_raster(&gaussians, &cameras, self.repeats as usize)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report);
        }
        Ok(())
    }
}

fn print_report(r: &RasterReport) {
    println!(
        "{} Gaussians, {} views of {}x{} in one call, {} threads, {}",
        r.gaussians, r.views, r.width, r.height, r.threads, r.simd
    );
    println!("{:<18} {:>8} {:>8} {:>8}", "ms per view", "median", "least", "3 of 4");
    let row = |name: &str, s: &Spread| {
        println!("{name:<18} {:>8.3} {:>8.3} {:>8.3}", s.median, s.least, s.upper_quartile);
    };
    row("forward", &r.forward);
    row("forward+backward", &r.forward_backward);
    for stage in &r.stages {
        row(&format!("  {}", stage.name), &stage.milliseconds);
    }
    let millions = |n: f64| n * 1e-6;
    println!(
        "(pixel, splat) pairs of a view: {:.2} M contribute, {:.2} M are evaluated; {:.0} (tile, splat) pairs",
        millions(r.pairs.contributing),
        millions(r.pairs.evaluated),
        r.pairs.tile_entries
    );
    println!(
        "multiply-adds alone reach {:.0} GFLOP/s; of it, by what contributing pairs ask for:",
        r.peak_gflops
    );
    for (name, rate) in [("blend", &r.blend), ("blend backward", &r.blend_backward)] {
        println!("  {name:<16} {:>6.2} Gpairs/s {:>6.1} %", rate.gpairs_per_second, 1e2 * rate.share_of_peak);
    }
    println!("working memory {:.0} MB", r.working_bytes as f64 * 1e-6);
}
