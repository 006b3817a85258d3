use super::{device, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::render::simd_level;
use serde_json::json;

/// Tell what this machine offers: libtorch, devices, SIMD level, threads.
#[derive(Args)]
#[command(after_help = "Example:\n  globalsplat doctor")]
pub struct Doctor {
    /// Print it as one JSON object
    #[arg(long)]
    json: bool,
}

impl Doctor {
    pub fn run(self) -> Result<()> {
        device::load_cuda();
        let devices: Vec<String> = std::iter::once("cpu".to_string())
            .chain((0..tch::Cuda::device_count()).map(|i| format!("cuda:{i}")))
            .collect();
        let (simd, libtorch) = (simd_level()?, globalsplat::render::libtorch_version());
        let (threads, cores) = (tch::get_num_threads(), std::thread::available_parallelism()?.get());
        if self.json {
            print_json(&json!({
                "version": env!("CARGO_PKG_VERSION"),
                "libtorch": libtorch,
                "devices": devices,
                "simd": simd,
                "threads": threads,
                "cores": cores,
            }));
        } else {
            println!("globalsplat  {}", env!("CARGO_PKG_VERSION"));
            println!("libtorch     {libtorch}");
            println!("devices      {}", devices.join(", "));
            println!("rasterizer   {simd} (GLOBALSPLAT_SIMD forces another)");
            println!("threads      {threads} on {cores} cores (OMP_NUM_THREADS sets them)");
        }
        Ok(())
    }
}
