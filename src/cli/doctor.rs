use super::{device, print_json, view};
use crate::config::Config;
use crate::device::total_memory_bytes;
use crate::distributed::Backends;
use crate::io::{WEIGHTS_VARIABLE, find_ffmpeg, find_pretrained};
use crate::loss::LpipsNetwork;
use crate::model::Precision;
use crate::reconstruct::BUNDLED_MODEL;
use crate::render::cpu::{libtorch_simd_level, simd_level};
use crate::render::cuda::{Driver, KernelOrigin, Nvrtc, cache_folder, load_kernels};
use crate::train::MemoryEstimate;
use anyhow::Result;
use clap::Args;
use globalsplat_colmap::Colmap;
use serde_json::{Value, json};
use std::fmt::Display;
use std::path::PathBuf;
use tch::Device;

/// Report what this machine offers: libtorch, devices, SIMD level, threads, GPUs and their requirements, and the weights,
/// the ffmpeg and the COLMAP found.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat doctor\n  globalsplat doctor --config configs/re10k_16k.toml --set train.precision=bf16"
)]
pub struct Doctor {
    /// Report how much memory a training step with this configuration takes, on a CPU and on a GPU
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, as in train.micro_batch=4
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    set: Vec<String>,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

impl Doctor {
    pub fn run(self) -> Result<()> {
        if let Some(file) = &self.config {
            return Ok(memory_of_training(&Config::read(file, &self.set)?, self.json)?);
        }
        let unusable = device::load_cuda().err().unwrap_or("it is for other GPUs, or another driver".into());
        let usable = tch::Cuda::device_count();
        let devices: Vec<String> =
            std::iter::once("cpu".to_string()).chain((0..usable).map(|i| format!("cuda:{i}"))).collect();
        let (simd, libtorch) = (simd_level()?, crate::render::libtorch_version());
        let (threads, cores) = (tch::get_num_threads(), std::thread::available_parallelism()?.get());
        let weights =
            LpipsNetwork::ALL.map(|network| (network.metric(), find_pretrained(network.file_name())));
        let (driver, nvrtc) = (Driver::find(), Nvrtc::find());
        let prepared: Vec<Result<KernelOrigin, String>> = (0..usable as i32).map(load_kernels).collect();
        let cache = cache_folder().map(|folder| folder.display().to_string());
        let (together, ffmpeg) = (Backends::built_in(), find_ffmpeg());
        let colmap = Colmap::find().map(|colmap| colmap.to_string()).map_err(|why| why.to_string());
        let precision = Precision::fastest_on(Device::Cpu);
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
                "libtorch_simd": libtorch_simd_level(),
                "precision": precision,
                "threads": threads,
                "cores": cores,
                "driver": or_error(&driver, |driver| json!(cuda_version(driver.version))),
                "gpus": driver.as_ref().map_or(json!([]), |driver| gpus(driver, &prepared, &unusable)),
                "nvrtc": or_error(&nvrtc, |nvrtc| json!({
                    "version": format!("{}.{}", nvrtc.version.0, nvrtc.version.1),
                    "architectures": nvrtc.architectures,
                })),
                "kernels": cache,
                "model": BUNDLED_MODEL,
                "weights": found,
                "ffmpeg": or_error(&ffmpeg, |version| json!(version)),
                "colmap": or_error(&colmap, |found| json!(found)),
                "viewer": view::has_viewer(),
                "together": { "gloo": together.gloo, "nccl": together.nccl },
            }));
            return Ok(());
        }
        let line = |name: &str, value: &dyn Display| println!("{name:<12} {value}");
        line("globalsplat", &env!("CARGO_PKG_VERSION"));
        line("libtorch", &libtorch);
        line("devices", &devices.join(", "));
        line(
            "rasterizer",
            &format!("{simd} (GLOBALSPLAT_SIMD=avx2 or portable hides what is newer, from libtorch as well)"),
        );
        line(
            "precision",
            &format!("{precision} (the fastest for wide models on this CPU, which --precision auto takes)"),
        );
        line("threads", &format!("{threads} on {cores} cores (OMP_NUM_THREADS sets them)"));
        let of = |built: bool, without: &'static str| if built { "built in" } else { without };
        line(
            "torchrun",
            &format!(
                "on CPUs Gloo: {}; on GPUs NCCL: {}",
                of(
                    together.gloo,
                    "absent (Debian and Ubuntu: apt install libgloo-dev, touch csrc/build.rs, build again)"
                ),
                of(
                    together.nccl,
                    "absent (its headers and CUDA's come with libtorch's wheel and requirements.txt)"
                )
            ),
        );
        line(
            "viewer",
            &of(
                view::has_viewer(),
                "absent: no pages to walk in (install Node.js 20 or newer with npm, then make build)",
            ),
        );
        match &driver {
            Err(why) => line("driver", &format!("absent: {why}")),
            Ok(driver) => {
                line("driver", &format!("NVIDIA's, for CUDA {}", cuda_version(driver.version)));
                for (number, gpu) in driver.gpus.iter().enumerate() {
                    let gigabytes = gpu.memory as f64 * 1e-9;
                    let (name, capability) = (&gpu.name, capability(gpu.architecture));
                    line(
                        &format!("cuda:{number}"),
                        &format!("{name}, compute capability {capability}, {gigabytes:.1} GB"),
                    );
                    line("", &state_of_kernels(prepared.get(number), &unusable));
                }
                if driver.gpus.is_empty() {
                    line("", &"it reports no GPU: check nvidia-smi and CUDA_VISIBLE_DEVICES");
                }
            }
        }
        match &nvrtc {
            Err(why) => line("nvrtc", &format!("absent: {why}")),
            Ok(nvrtc) => {
                let [least, most] = [nvrtc.architectures.first(), nvrtc.architectures.last()]
                    .map(|of| of.map_or(String::new(), |&of| capability(of)));
                let (major, minor) = nvrtc.version;
                line("nvrtc", &format!("{major}.{minor}, for compute capability {least} to {most}"));
            }
        }
        line("kernels", &cache.as_deref().unwrap_or("kept nowhere: neither XDG_CACHE_HOME nor HOME is set"));
        line("model", &format!("{BUNDLED_MODEL}, inside the program (reconstruct --weights takes another)"));
        for (metric, path) in weights {
            let found = match path {
                Some(path) => path.display().to_string(),
                None => format!("absent (make weights makes them, {WEIGHTS_VARIABLE} names their folder)"),
            };
            line(metric, &found);
        }
        match &ffmpeg {
            Err(why) => line("ffmpeg", &format!("absent, so films are GIFs: {why}")),
            Ok(version) => line("ffmpeg", &format!("{version}, for films in MP4")),
        }
        match &colmap {
            Err(why) => line("colmap", &format!("absent, so photos need poses: {why}")),
            Ok(found) => line("colmap", &format!("{found}, for the poses of photos")),
        }
        Ok(())
    }
}

/// Formats a compute capability: 90 gives `9.0`.
fn capability(architecture: i32) -> String {
    format!("{}.{}", architecture / 10, architecture % 10)
}

/// Formats a CUDA version: 13000 gives `13.0`.
fn cuda_version(version: i32) -> String {
    format!("{}.{}", version / 1000, version % 1000 / 10)
}

fn or_error<T>(found: &Result<T, String>, tell: impl FnOnce(&T) -> Value) -> Value {
    match found {
        Ok(found) => tell(found),
        Err(why) => json!({ "absent": why }),
    }
}

/// Returns the driver's GPUs as JSON. Those that torch can use come first, and have their kernels.
fn gpus(driver: &Driver, prepared: &[Result<KernelOrigin, String>], unusable: &str) -> Value {
    let entries = driver.gpus.iter().enumerate().map(|(number, gpu)| {
        json!({
            "name": gpu.name,
            "compute_capability": capability(gpu.architecture),
            "memory_bytes": gpu.memory,
            "multiprocessors": gpu.multiprocessors,
            "kernels": state_of_kernels(prepared.get(number), unusable),
        })
    });
    entries.collect()
}

fn state_of_kernels(prepared: Option<&Result<KernelOrigin, String>>, unusable: &str) -> String {
    match prepared {
        None => format!("this libtorch can't use it: {unusable}"),
        Some(Err(why)) => format!("its kernels are missing: {why}"),
        Some(Ok(KernelOrigin { architecture, file, was_cached })) => {
            let how = if *was_cached { "read from" } else { "compiled just now, and kept in" };
            let of = capability(*architecture);
            match file {
                Some(file) => format!("kernels for {of}, {how} {}", file.display()),
                None => format!("kernels for {of}, compiled just now"),
            }
        }
    }
}

/// Prints the memory of a training step, a column for each kind of device, and whether it fits into the devices of this
/// machine.
fn memory_of_training(config: &Config, as_json: bool) -> crate::Result<()> {
    let cpu = MemoryEstimate::new(config, Device::Cpu)?;
    let gpu = MemoryEstimate::new(config, Device::Cuda(0))?;
    let driver = Driver::find();
    let gpus = driver.iter().flat_map(|driver| &driver.gpus);
    let machine = total_memory_bytes(Device::Cpu).map(|bytes| ("this machine".to_string(), bytes, cpu));
    let here: Vec<(String, u64, MemoryEstimate)> =
        machine.into_iter().chain(gpus.map(|of| (of.name.clone(), of.memory as u64, gpu))).collect();
    if as_json {
        let to_json = |estimate: &MemoryEstimate| {
            let mut json = json!(estimate);
            json["total"] = json!(estimate.total());
            json
        };
        let devices: Vec<Value> = here
            .iter()
            .map(|(name, bytes, needed)| {
                json!({ "name": name, "memory_bytes": bytes, "fits": needed.fits_into(*bytes) })
            })
            .collect();
        print_json(&json!({ "cpu": to_json(&cpu), "gpu": to_json(&gpu), "devices": devices }));
        return Ok(());
    }
    let (batch, at_once) = (cpu.batch, cpu.scenes_at_once);
    println!(
        "{:<56}{:>10}{:>10}",
        format!("GB in a training step of {batch} scenes, {at_once} at a time"),
        "CPU",
        "GPU"
    );
    let row = |name: &str, of: &dyn Fn(&MemoryEstimate) -> u64| {
        let [cpu, gpu] = [&cpu, &gpu].map(|estimate| of(estimate) as f64 * 1e-9);
        println!("{name:<56}{cpu:>10.2}{gpu:>10.2}");
    };
    row("weights and the optimizer's moments", &|of| of.weights);
    row("photos", &|of| of.photos);
    row("tokenizer and encoder", &|of| of.encoder);
    row("heads, Gaussians, pictures and losses", &|of| of.pictures);
    row("network of L_perc", &|of| of.perceptual);
    row("together, to 15 %", &MemoryEstimate::total);
    let train = &config.train;
    let savings = [
        (at_once > 1).then(|| format!("train.micro_batch={}", at_once / 2)),
        (!train.checkpoint_rounds).then(|| "train.checkpoint_rounds=true".to_string()),
        (train.precision == Precision::F32).then(|| "train.precision=bf16".to_string()),
    ];
    let savings = savings.into_iter().flatten().collect::<Vec<_>>().join(", ");
    for (name, bytes, needed) in here {
        let fits = match needed.fits_into(bytes) {
            true => "it fits".to_string(),
            false if savings.is_empty() => "it does not fit".to_string(),
            false => format!("it does not fit; to save memory: {savings}"),
        };
        println!("{name} has {:.1} GB: {fits}", bytes as f64 * 1e-9);
    }
    Ok(())
}
