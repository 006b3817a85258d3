use super::bench_attention::Attention;
use super::bench_model::Model;
use super::bench_refine::Refine;
use super::bench_train::Train;
use super::{device, open_capture, parse_size, print_json, progress, warn};
use anyhow::Result;
use clap::{Args, Subcommand};
use globalsplat::bench::{
    RasterReport, TimingStats, bench_loader, bench_raster, bench_synth, synthetic_gaussians, synthetic_videos,
};
use globalsplat::data::{DataConfig, TrainingScenes, load_all_views, view_batch};
use globalsplat::error::Error;
use globalsplat::io::{check_writable_dir, read_splat};
use globalsplat::scene::{Gaussians, ImageSize};
use std::path::PathBuf;
use std::sync::Arc;
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
    Attention(Attention),
    Raster(Raster),
    Loader(Loader),
    Model(Model),
    Refine(Refine),
    Synth(Synth),
    Train(Train),
}

impl Bench {
    pub fn run(self) -> Result<()> {
        match self.part {
            Part::Attention(attention) => attention.run(),
            Part::Raster(raster) => raster.run(),
            Part::Loader(loader) => loader.run(),
            Part::Model(model) => model.run(),
            Part::Refine(refine) => refine.run(),
            Part::Synth(synth) => synth.run(),
            Part::Train(train) => train.run(),
        }
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
    /// Splat: .ply, .compressed.ply, .sog, meta.json, .spz, .splat, .glb, .gltf or .ksplat
    #[arg(long, value_name = "FILE", requires = "scene")]
    splat: Option<PathBuf>,
    /// Capture whose cameras render the splat, all in one call
    #[arg(long, value_name = "PATH", requires = "splat")]
    scene: Option<PathBuf>,
    /// Number of Gaussians in the synthetic scene
    #[arg(long, value_name = "N", default_value_t = 16_384, conflicts_with = "splat")]
    gaussians: usize,
    /// Number of cameras of the synthetic scene, all in one call
    #[arg(long, value_name = "N", default_value_t = 12, conflicts_with = "splat")]
    cameras: usize,
    /// Image size of the synthetic scene's cameras
    #[arg(long, value_name = "WxH", default_value = "256x256", conflicts_with = "splat")]
    size: String,
    /// Print a scaling table instead: synthetic scenes of 16K to 1M Gaussians, one camera of 256x256 to 1920x1080
    #[arg(long, conflicts_with_all = ["splat", "gaussians", "cameras", "size"])]
    scaling: bool,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Number of threads; by default all cores
    #[arg(long, value_name = "N")]
    threads: Option<u16>,
    /// Number of timed calls
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
            return Err(Error::request("--repeats is 0, expected 1 or more").into());
        }
        if self.gaussians == 0 || self.cameras == 0 {
            return Err(Error::request("--gaussians and --cameras are expected to be 1 or more").into());
        }
        // The device is parsed before tensors are created, so that a missing one is reported immediately.
        let device = device::parse(&self.device)?;
        if self.scaling {
            return self.scaling(device);
        }
        let (gaussians, cameras) = match (&self.splat, &self.scene) {
            (Some(splat), Some(scene)) => {
                let splat = read_splat(splat)?;
                warn(&splat.warnings);
                let gaussians = Gaussians::from_splat(&splat);
                let frame = gaussians.local_frame(splat.origin);
                let views = load_all_views(&open_capture(scene)?, None)?;
                let poses: Vec<_> = views.iter().map(|view| frame.pose_to_local(&view.camera.c2w)).collect();
                let gaussians = gaussians.to_local(&frame, splat.origin);
                (gaussians, view_batch(&views, &poses, Device::Cpu).cameras())
            }
            _ => synthetic_gaussians(self.gaussians, self.cameras, parse_size(&self.size)?),
        };
        let gaussians = gaussians.to_device(device);
        let cameras = cameras.to_device(device);
        let report = bench_raster(&gaussians, &cameras, self.repeats as usize)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
        } else {
            print_report(&report);
        }
        Ok(())
    }
}

/// Benchmark the loader, from chunks of JPEGs to augmented training samples in tensors, stage by stage.
///
/// Without --data the input is synthetic: chunks of 640x360 video. Samples have the paper's shape, 24 context and 12 target
/// views of 256x256.
#[derive(Args)]
#[command(after_help = "Examples:\n  globalsplat bench loader\n  \
    globalsplat bench loader --data datasets/re10k --threads 8 --samples 10000 --json")]
pub struct Loader {
    /// Dataset, of which the split `train` is used, or captures
    #[arg(long, value_name = "ROOT")]
    data: Option<PathBuf>,
    /// Write the synthetic data into this folder and keep them
    #[arg(long, value_name = "DIR", conflicts_with = "data")]
    keep: Option<PathBuf>,
    /// Number of loader threads; by default one per core
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    threads: u16,
    /// Number of measured samples
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..))]
    samples: u64,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Loader {
    pub fn run(self) -> Result<()> {
        let temporary = tempfile::tempdir()?;
        let root = match (&self.data, &self.keep) {
            (Some(data), _) => data.clone(),
            (None, keep) => {
                let root = keep.as_deref().unwrap_or(temporary.path());
                check_writable_dir(root)?;
                synthetic_videos(root)?;
                root.to_owned()
            }
        };
        let scenes = Arc::new(TrainingScenes::find(&[root])?);
        let config = DataConfig { threads: self.threads.into(), ..Default::default() };
        let report = bench_loader(&config, scenes, self.samples)?;
        if self.json {
            print_json(&serde_json::to_value(&report)?);
            return Ok(());
        }
        let [height, width] = report.size;
        println!(
            "{:.2} samples/s, {:.0} views/s of {width}x{height}, {} threads, {} samples",
            report.samples_per_second, report.views_per_second, report.threads, report.samples
        );
        let times = &report.milliseconds;
        println!("{:<12} {:>8}", "stage", "ms");
        for (stage, milliseconds) in [
            ("read", times.read),
            ("decode", times.decode),
            ("resize", times.resize),
            ("augment", times.augment),
            ("to tensor", times.to_tensor),
        ] {
            println!("{stage:<12} {milliseconds:>8.3}");
        }
        println!("per decoded photo of a thread; {} photos for {} views", report.photos, report.views);
        let megabytes = |bytes: u64| bytes as f64 * 1e-6;
        println!(
            "resident memory after each tenth of the samples {} MB, {:.0} MB at the most",
            report
                .resident_by_tenth
                .iter()
                .map(|&bytes| format!("{:.0}", megabytes(bytes)))
                .collect::<Vec<_>>()
                .join(" "),
            megabytes(report.resident_peak)
        );
        Ok(())
    }
}

impl Raster {
    fn scaling(&self, device: Device) -> Result<()> {
        let mut reports = vec![];
        let bar = progress::bar((GAUSSIANS.len() * SIZES.len()) as u64, "scenes");
        for count in GAUSSIANS {
            for (width, height) in SIZES {
                let (gaussians, cameras) = synthetic_gaussians(count, 1, ImageSize { width, height });
                let (gaussians, cameras) = (gaussians.to_device(device), cameras.to_device(device));
                reports.push(bench_raster(&gaussians, &cameras, self.repeats as usize)?);
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        if self.json {
            print_json(&serde_json::to_value(&reports)?);
            return Ok(());
        }
        println!(
            "median milliseconds, forward / forward and backward, {}, {} threads, {}",
            reports[0].device, reports[0].threads, reports[0].simd
        );
        print!("{:>10}", "Gaussians");
        for (width, height) in SIZES {
            print!(" {:>17}", format!("{width}x{height}"));
        }
        println!();
        for row in reports.chunks(SIZES.len()) {
            print!("{:>10}", row[0].gaussians);
            for r in row {
                print!(" {:>17}", format!("{:.1} / {:.1}", r.forward.median, r.forward_backward.median));
            }
            println!();
        }
        Ok(())
    }
}

/// Gaussian counts (rows) and image sizes (columns) of the scaling table.
const GAUSSIANS: [usize; 4] = [16_384, 65_536, 262_144, 1_048_576];
const SIZES: [(u32, u32); 4] = [(256, 256), (512, 512), (1024, 1024), (1920, 1080)];

fn print_report(r: &RasterReport) {
    println!(
        "{} Gaussians, {} views of {}x{} in one call, {}, {} threads, {}",
        r.gaussians, r.views, r.width, r.height, r.device, r.threads, r.simd
    );
    println!("{:<18} {:>8} {:>8} {:>8}", "ms per view", "median", "min", "p75");
    let row = |name: &str, s: &TimingStats| {
        println!("{name:<18} {:>8.3} {:>8.3} {:>8.3}", s.median, s.min, s.upper_quartile);
    };
    row("forward", &r.forward);
    row("forward+backward", &r.forward_backward);
    for stage in &r.stages {
        row(&format!("  {}", stage.name), &stage.milliseconds);
    }
    for comparison in &r.against_cpu {
        println!(
            "{:<24} {} of {} elements differ from the CPU's, relative difference {:.1e}",
            comparison.tensor,
            comparison.differing_elements,
            comparison.elements,
            comparison.relative_difference
        );
    }
    let millions = |n: f64| n * 1e-6;
    println!(
        "(pixel, splat) pairs of a view: {:.2} M contribute, {:.2} M are evaluated; {:.0} (tile, splat) pairs",
        millions(r.pairs.contributing),
        millions(r.pairs.evaluated),
        r.pairs.tile_entries
    );
    if let Some(rates) = &r.rates {
        println!(
            "multiply-adds alone reach {:.0} GFLOP/s; of it, by what contributing pairs ask for:",
            rates.peak_gflops
        );
        for (name, rate) in [("blend", &rates.blend), ("blend backward", &rates.blend_backward)] {
            println!(
                "  {name:<16} {:>6.2} Gpairs/s {:>6.1} %",
                rate.gpairs_per_second,
                1e2 * rate.share_of_peak
            );
        }
    }
    println!("working memory {:.0} MB", r.working_bytes as f64 * 1e-6);
}

/// Benchmark the synthesis of videos: views per second on one core, four rays per pixel, with shadows.
#[derive(Args)]
#[command(after_help = "Example:\n  globalsplat bench synth --size 256")]
pub struct Synth {
    /// Number of synthetic scenes
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u64).range(1..))]
    videos: u64,
    /// Number of views per scene
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    frames: u32,
    /// Side of a view in pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 128, value_parser = clap::value_parser!(u32).range(16..=8192))]
    size: u32,
    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,
}

impl Synth {
    fn run(self) -> Result<()> {
        let bar = progress::bar(self.videos, "scenes");
        let report = bench_synth(self.videos, self.frames as usize, self.size, || bar.inc(1));
        bar.finish_and_clear();
        if self.json {
            print_json(&serde_json::to_value(&report)?);
            return Ok(());
        }
        let [height, width] = report.size;
        println!(
            "{} scenes of {} triangles, {} views of {width}x{height}, {} rays a pixel and their shadows",
            report.videos, report.triangles, report.views, report.rays_per_pixel
        );
        println!(
            "{:.1} views/s on one core, {:.2} 10^6 rays/s",
            report.views_per_second, report.megarays_per_second
        );
        println!("{:.2} s to build a scene, all cores", report.seconds_per_world);
        Ok(())
    }
}
