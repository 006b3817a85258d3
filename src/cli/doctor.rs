use super::{Output, device, view};
use crate::config::Config;
use crate::device::total_memory_bytes;
use crate::distributed::{has_gloo, has_nccl};
use crate::io::{WEIGHTS_VARIABLE, find_ffmpeg, find_pretrained};
use crate::loss::PerceptualBackbone;
use crate::model::Precision;
use crate::reconstruct::BUNDLED_MODEL;
use crate::render::cpu::{libtorch_simd_level, simd_level};
use crate::render::cuda::{Driver, KernelOrigin, Nvrtc, cache_folder, load_kernels};
use crate::train::MemoryEstimate;
use anyhow::Result;
use clap::Args;
use globalsplat_colmap::Colmap;
use serde_json::{Value, json};
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
}

impl Doctor {
    pub fn run(self) -> Result<Output> {
        if let Some(file) = &self.config {
            return memory_of_training(&Config::read(file, &self.set)?);
        }
        let unusable = device::load_cuda().err().unwrap_or("it is for other GPUs, or another driver".into());
        let usable = tch::Cuda::device_count();
        let devices = std::iter::once("cpu".to_string()).chain((0..usable).map(|i| format!("cuda:{i}")));
        let weights = PerceptualBackbone::LPIPS.map(|network| {
            let file = find_pretrained(&network.file_name()).map(|path| path.display().to_string());
            let absent = || format!("make weights makes it, {WEIGHTS_VARIABLE} names its folder");
            (network.metric().to_string(), found_or(file.ok_or_else(absent)))
        });
        let driver = Driver::find();
        let prepared: Vec<Result<KernelOrigin, String>> = (0..usable as i32).map(load_kernels).collect();
        let nvrtc = Nvrtc::find().map(|nvrtc| {
            let (major, minor) = nvrtc.version;
            json!({ "version": format!("{major}.{minor}"), "architectures": nvrtc.architectures })
        });
        let built = |is_built: bool, why: &str| found_or(is_built.then_some(true).ok_or(why.to_string()));
        Ok(Output::table(json!({
            "version": env!("CARGO_PKG_VERSION"),
            "libtorch": crate::render::libtorch_version(),
            "devices": devices.collect::<Vec<_>>(),
            "simd": simd_level()?,
            "libtorch_simd": libtorch_simd_level(),
            "precision": Precision::fastest_on(Device::Cpu),
            "threads": tch::get_num_threads(),
            "cores": std::thread::available_parallelism()?.get(),
            "driver": found_or(driver.as_ref().map(|driver| cuda_version(driver.version)).map_err(String::clone)),
            "gpus": driver.as_ref().map_or(json!([]), |driver| gpus(driver, &prepared, &unusable)),
            "nvrtc": found_or(nvrtc),
            "kernels": cache_folder().map(|folder| folder.display().to_string()),
            "model": BUNDLED_MODEL,
            "weights": serde_json::Map::from_iter(weights),
            "ffmpeg": found_or(find_ffmpeg()),
            "colmap": found_or(Colmap::find().map(|colmap| colmap.to_string()).map_err(|why| why.to_string())),
            "viewer": built(view::has_viewer(), "install Node.js 20 or newer with npm, then make build"),
            "together": {
                "gloo": built(
                    has_gloo(),
                    "Debian and Ubuntu: apt install libgloo-dev, touch csrc/build.rs, build again",
                ),
                "nccl": built(has_nccl(), "its headers and CUDA's come with libtorch's wheel and requirements.txt"),
            },
        })))
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

/// Returns what was found, or why it is absent.
fn found_or(found: Result<impl Into<Value>, String>) -> Value {
    found.map_or_else(|why| json!({ "absent": why }), Into::into)
}

/// Returns the driver's GPUs as JSON. Those that torch can use come first, and have their kernels.
fn gpus(driver: &Driver, prepared: &[Result<KernelOrigin, String>], unusable: &str) -> Value {
    if driver.gpus.is_empty() {
        return json!({ "absent": "the driver reports none: check nvidia-smi and CUDA_VISIBLE_DEVICES" });
    }
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

/// Returns the memory of a training step, a column for each kind of device, and whether it fits into the devices of this machine.
fn memory_of_training(config: &Config) -> Result<Output> {
    let cpu = MemoryEstimate::new(config, Device::Cpu)?;
    let gpu = MemoryEstimate::new(config, Device::Cuda(0))?;
    let title = format!("GB in a training step of {} scenes, {} at a time", cpu.batch, cpu.scenes_at_once);
    let mut lines = vec![format!("{title:<56}{:>10}{:>10}", "CPU", "GPU")];
    type Part = fn(&MemoryEstimate) -> u64;
    let parts: [(&str, Part); 6] = [
        ("weights and the optimizer's moments", |of| of.weights),
        ("photos", |of| of.photos),
        ("tokenizer and encoder", |of| of.encoder),
        ("heads, Gaussians, pictures and losses", |of| of.pictures),
        ("network of L_perc", |of| of.perceptual),
        ("together, to 15 %", MemoryEstimate::total),
    ];
    lines.extend(parts.map(|(name, bytes)| {
        let [cpu, gpu] = [&cpu, &gpu].map(|estimate| bytes(estimate) as f64 * 1e-9);
        format!("{name:<56}{cpu:>10.2}{gpu:>10.2}")
    }));
    let train = &config.train;
    let savings = [
        (cpu.scenes_at_once > 1).then(|| format!("train.micro_batch={}", cpu.scenes_at_once / 2)),
        (!train.checkpoint_rounds).then(|| "train.checkpoint_rounds=true".to_string()),
        (train.precision == Precision::F32).then(|| "train.precision=bf16".to_string()),
    ];
    let savings = savings.into_iter().flatten().collect::<Vec<_>>().join(", ");
    let driver = Driver::find();
    let gpus =
        driver.iter().flat_map(|driver| &driver.gpus).map(|of| (of.name.as_str(), of.memory as u64, &gpu));
    let machine = total_memory_bytes(Device::Cpu).map(|bytes| ("this machine", bytes, &cpu));
    let mut devices = vec![];
    for (name, bytes, needed) in machine.into_iter().chain(gpus) {
        let fits = needed.fits_into(bytes);
        devices.push(json!({ "name": name, "memory_bytes": bytes, "fits": fits }));
        let advice = match fits {
            true => "it fits".to_string(),
            false if savings.is_empty() => "it does not fit".to_string(),
            false => format!("it does not fit; to save memory: {savings}"),
        };
        lines.push(format!("{name} has {:.1} GB: {advice}", bytes as f64 * 1e-9));
    }
    let [cpu, gpu] = [cpu, gpu].map(|estimate| {
        let mut json = json!(estimate);
        json["total"] = estimate.total().into();
        json
    });
    Ok(Output::new(json!({ "cpu": cpu, "gpu": gpu, "devices": devices }), lines.join("\n")))
}
