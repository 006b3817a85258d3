use super::{device, model, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::data::{Holdout, open_capture};
use globalsplat::error::Error;
use globalsplat::eval::peak_memory_bytes;
use globalsplat::io::{Splat, check_writable_file, write_splat};
use globalsplat::reconstruct::{load_context, reconstruct};
use serde_json::json;
use std::path::PathBuf;

/// Make a splat from posed photos.
///
/// The splat is in the capture's own world, so the capture's cameras see it where the photos show it.
#[derive(Args)]
#[command(
    after_help = "Example:\n  globalsplat reconstruct --weights model.safetensors --scene captures/room --out room.ply"
)]
pub struct Reconstruct {
    /// Weights that `globalsplat export` wrote
    #[arg(long, value_name = "FILE")]
    weights: PathBuf,
    /// The capture: a folder with a cameras.json, a transforms.json or a COLMAP model, or CHUNK.torch#KEY
    #[arg(long, value_name = "PATH")]
    scene: PathBuf,
    /// The splat to write
    #[arg(long, value_name = "FILE.ply")]
    out: PathBuf,
    /// Use this many views, spread over the path of the camera
    #[arg(long, value_name = "N", default_value_t = 24)]
    views: usize,
    /// Views not to use: every:N, every:N+K or none
    #[arg(long, value_name = "WHICH", default_value = "none")]
    holdout: String,
    /// f32, or bf16 for matrix products: faster on machines with instructions for it
    #[arg(long, default_value = "f32")]
    precision: String,
    /// cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Print what was done as one JSON object
    #[arg(long)]
    json: bool,
}

impl Reconstruct {
    pub fn run(self) -> Result<()> {
        let device = device::parse(&self.device)?;
        let holdout = self.holdout.parse::<Holdout>().map_err(Error::Request)?;
        check_writable_file(&self.out)?;
        let loaded = model::load(&self.weights, &self.precision, device)?;
        let capture = open_capture(&self.scene)?;
        let views = load_context(&capture, holdout, Some(self.views), loaded.config.data.image_size)?;
        let reconstruction = reconstruct(&loaded, &views, &[])?;
        write_splat(&self.out, &Splat::of(&reconstruction.in_world())?)?;

        let bytes = std::fs::metadata(&self.out)?.len();
        let (count, seconds) = (reconstruction.gaussians.count(), reconstruction.forward_time.as_secs_f64());
        if self.json {
            print_json(&json!({
                "splat": self.out,
                "views": views.len(),
                "gaussians": count,
                "seconds": seconds,
                "peak_memory_bytes": peak_memory_bytes(),
                "bytes": bytes,
            }));
        } else {
            let megabytes = bytes as f64 / 1e6;
            println!(
                "{}: {count} Gaussians from {} views, {megabytes:.2} MB; forward pass {seconds:.2} s, peak memory {:.2} GB",
                self.out.display(),
                views.len(),
                peak_memory_bytes() as f64 / 1e9
            );
        }
        Ok(())
    }
}
