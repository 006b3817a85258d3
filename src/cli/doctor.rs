use super::{device, print_json};
use anyhow::Result;
use clap::Args;
use globalsplat::io::{WEIGHTS_VARIABLE, find_pretrained};
use globalsplat::loss::LpipsNetwork;
use globalsplat::reconstruct::SHIPPED_MODEL;
use globalsplat::render::cpu::simd_level;
use serde_json::json;

/// Tell what this machine offers: libtorch, devices, SIMD level, threads, and the weights found.
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
        let weights =
            LpipsNetwork::ALL.map(|network| (network.metric(), find_pretrained(network.file_name())));
        if self.json {
            let found: serde_json::Map<_, _> = weights
                .into_iter()
                .filter_map(|(metric, path)| Some((metric.to_string(), path?.display().to_string().into())))
                .collect();
            print_json(&json!({
                "version": env!("CARGO_PKG_VERSION"),
                "libtorch": libtorch,
                "devices": devices,
                "simd": simd,
                "threads": threads,
                "cores": cores,
                "model": SHIPPED_MODEL,
                "weights": found,
            }));
        } else {
            println!("globalsplat  {}", env!("CARGO_PKG_VERSION"));
            println!("libtorch     {libtorch}");
            println!("devices      {}", devices.join(", "));
            println!("rasterizer   {simd} (GLOBALSPLAT_SIMD forces another)");
            println!("threads      {threads} on {cores} cores (OMP_NUM_THREADS sets them)");
            println!(
                "model        {SHIPPED_MODEL}, inside the program (reconstruct --weights takes another)"
            );
            for (metric, path) in weights {
                let found = match path {
                    Some(path) => path.display().to_string(),
                    None => {
                        format!("absent (make weights makes them, {WEIGHTS_VARIABLE} names their folder)")
                    }
                };
                println!("{metric:<12} {found}");
            }
        }
        Ok(())
    }
}
