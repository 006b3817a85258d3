//! Benchmark of the rasterizer: from tensors of Gaussians to images, and back to gradients.

use super::measure::{Measured, Section, TimingStats, Work};
use crate::data::view_matrices;
use crate::device::{Stopwatch, peak_memory_bytes_on, reset_peak_memory, resident_memory_bytes};
use crate::error::{Error, Result};
use crate::render::cpu::{StageTimes, count_pairs, multiply_add_peak, simd_level, stage_times};
use crate::render::cuda::{kernel_times, measure_kernels};
use crate::render::{Cameras, RenderOutput, default_eps2d, render};
use crate::scene::{Camera, Gaussians, ImageSize, Intrinsics};
use glam::{DMat4, DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use std::f64::consts::TAU;
use tch::{Device, Kind, Tensor, no_grad};

/// Floating-point operations per pair in `csrc/kernels/pixel.h`: offset 2, p and r 4, exponent 4, 2^e 15, cap 1, T 2, w 1, and A, C and D
/// 9.
const FORWARD_OPERATIONS: f64 = 38.;
/// Floating-point operations per pair of the backward pass: 28 up to T as in the forward pass, w 1, q 8, the remainder 2, ν with a
/// reciprocal 8, and the ten sums 19.
const BACKWARD_OPERATIONS: f64 = 66.;

/// Name of the stage of [`StageTimes::blend`].
const BLEND: &str = "blend";
/// Name of the stage of [`StageTimes::blend_backward`].
const BLEND_BACKWARD: &str = "blend backward";

/// Duration of the measurement of multiply-adds, in seconds.
const PEAK_SECONDS: f64 = 0.2;

/// Times `repeats` calls of the rasterizer without gradients and as many with gradients, alternating between them. Returns milliseconds per
/// view: of a call without gradients, and of one that records them with its backward pass; of the stages on the CPU, or of the kernels on a
/// GPU, whose results are also compared with the CPU's. `working_bytes` is the peak memory during the calls minus that before them.
///
/// # Errors
/// Fails if [`render()`] fails.
pub fn bench_raster(gaussians: &Gaussians, cameras: &Cameras, repeats: usize) -> Result<Value> {
    let device = gaussians.means.device();
    let views = cameras.w2c.size()[0] * cameras.w2c.size()[1];
    let per_view = |seconds: f64| seconds * 1e3 / views as f64;
    reset_peak_memory(device);
    let memory_before = match device {
        Device::Cpu => resident_memory_bytes(),
        // Right after the reset, the GPU's peak is its current use.
        _ => peak_memory_bytes_on(device),
    };
    let (mut forward, mut forward_backward) = (vec![], vec![]);
    let mut stages = Measured::default();
    // The first round warms up caches and threads.
    for round in 0..=repeats {
        let mut watch = Stopwatch::new(device);
        watch.time("forward", || no_grad(|| render(gaussians, cameras, default_eps2d(gaussians))))?;
        let parameters = gaussians.map(|t| t.detach().set_requires_grad(true));
        let output =
            watch.time("with gradients", || render(&parameters, cameras, default_eps2d(&parameters)))?;
        let objective = sum_of_images(&output);
        watch.time("with gradients", || objective.backward());
        if round > 0 {
            let sections = watch.sections()?;
            let [without, with] = [0, 1].map(|section| sections[section].1.as_secs_f64());
            forward.push(per_view(without));
            forward_backward.push(per_view(with));
            let times = named_stages(stage_times());
            stages.add_run(times.map(|(name, time)| (name.into(), per_view(time), Work::default())));
        }
    }
    let working_bytes = peak_memory_bytes_on(device).saturating_sub(memory_before);
    let on_cpu = (gaussians.to_device(Device::Cpu), cameras.to_device(Device::Cpu));
    let counts = count_pairs(&on_cpu.0, &on_cpu.1, default_eps2d(gaussians))?;
    let pairs_per_view = |count: i64| count as f64 / views as f64;
    let (stages, rates) = match device {
        Device::Cpu => {
            let stages = stages.sections();
            let rates = blending_rates(&stages, pairs_per_view(counts.contributing));
            (stages, rates)
        }
        _ => (time_kernels(gaussians, cameras, repeats)?, Value::Null),
    };
    let mut report = json!({
        "simd": simd_level()?,
        "device": match device {
            Device::Cuda(number) => format!("cuda:{number}"),
            _ => "cpu".into(),
        },
        "threads": tch::get_num_threads(),
        "gaussians": gaussians.count(),
        "views": views,
        "width": cameras.width,
        "height": cameras.height,
        "forward": TimingStats::from_milliseconds(forward),
        "forward_backward": TimingStats::from_milliseconds(forward_backward),
        "stages": stages,
        // (tile, splat) pairs, and (pixel, splat) pairs whose α is computed and that are blended, per view.
        "pairs": {
            "tile_entries": pairs_per_view(counts.tile_entries),
            "evaluated": pairs_per_view(counts.evaluated),
            "contributing": pairs_per_view(counts.contributing),
        },
        "rates": rates,
        "working_bytes": working_bytes,
    });
    if device != Device::Cpu {
        report["against_cpu"] = compare_with_cpu(gaussians, cameras)?.into();
    }
    Ok(report)
}

/// Returns an objective that depends on every element of every image.
fn sum_of_images(output: &RenderOutput) -> Tensor {
    let [rgb, alpha, depth] = [&output.rgb, &output.alpha, &output.depth].map(|t| t.sum(Kind::Float));
    rgb + alpha + depth
}

/// Times each kernel of a GPU. It makes calls of its own, because events around every launch slow a call down.
fn time_kernels(gaussians: &Gaussians, cameras: &Cameras, repeats: usize) -> Result<Vec<Section>> {
    let views = (cameras.w2c.size()[0] * cameras.w2c.size()[1]) as f64;
    let mut measured = Measured::default();
    for _ in 0..repeats {
        measure_kernels(true);
        render_with_gradients(gaussians, cameras)?;
        let times = kernel_times().map_err(Error::external)?.into_iter();
        measured.add_run(times.map(|time| (time.kernel, time.milliseconds / views, Work::default())));
    }
    measure_kernels(false);
    Ok(measured.sections())
}

/// Compares the images and gradients of a GPU with the CPU's.
fn compare_with_cpu(gaussians: &Gaussians, cameras: &Cameras) -> Result<Vec<Value>> {
    let gpu = render_with_gradients(gaussians, cameras)?;
    let cpu = render_with_gradients(&gaussians.to_device(Device::Cpu), &cameras.to_device(Device::Cpu))?;
    let compare = |((tensor, gpu), (_, cpu)): (&(&'static str, Tensor), &(&'static str, Tensor))| {
        let gpu = gpu.to_device(Device::Cpu);
        let bits = |t: &Tensor| t.contiguous().view_dtype(Kind::Int);
        json!({
            "tensor": tensor,
            "numbers": cpu.numel(),
            "other_bits": bits(&gpu).not_equal_tensor(&bits(cpu)).sum(Kind::Int64).int64_value(&[]),
            "relative_difference": (&gpu - cpu).norm().double_value(&[]) / cpu.norm().double_value(&[]),
        })
    };
    Ok(gpu.iter().zip(&cpu).map(compare).collect())
}

/// Renders the images, and computes the gradients of the sum of all images.
fn render_with_gradients(gaussians: &Gaussians, cameras: &Cameras) -> Result<Vec<(&'static str, Tensor)>> {
    let parameters = gaussians.map(|t| t.detach().set_requires_grad(true));
    let output = render(&parameters, cameras, default_eps2d(&parameters))?;
    sum_of_images(&output).backward();
    let RenderOutput { rgb, alpha, depth } = output;
    Ok(vec![
        ("rgb", rgb.detach()),
        ("alpha", alpha.detach()),
        ("depth", depth.detach()),
        ("gradient of means", parameters.means.grad()),
        ("gradient of scales", parameters.scales.grad()),
        ("gradient of quaternions", parameters.quaternions.grad()),
        ("gradient of opacities", parameters.opacities.grad()),
        ("gradient of sh", parameters.sh.grad()),
    ])
}

/// Returns the stages of a call by name, in seconds.
fn named_stages(times: StageTimes) -> [(&'static str, f64); 6] {
    [
        ("project", times.project),
        ("sort", times.sort),
        ("bin", times.bin),
        (BLEND, times.blend),
        (BLEND_BACKWARD, times.blend_backward),
        ("project backward", times.project_backward),
    ]
}

/// Returns the throughput of blending in 10⁹ contributing pairs per second, and the operations that these pairs need as a fraction of the
/// throughput of multiply-adds alone.
fn blending_rates(stages: &[Section], contributing_pairs: f64) -> Value {
    let peak = multiply_add_peak(PEAK_SECONDS);
    let rate = |name: &str, operations: f64| {
        let stage = stages.iter().find(|stage| stage.name == name).expect("every stage has a section");
        let per_second = contributing_pairs / (stage.milliseconds.median * 1e-3);
        json!({ "gpairs_per_second": per_second * 1e-9, "share_of_peak": per_second * operations / peak })
    };
    json!({
        "peak_gflops": peak * 1e-9,
        "blend": rate(BLEND, FORWARD_OPERATIONS),
        "blend_backward": rate(BLEND_BACKWARD, BACKWARD_OPERATIONS),
    })
}

/// Returns a synthetic scene that resembles a trained one, and `views` cameras that move past it, from a fixed seed. Projected sizes,
/// elongations and opacities follow the published 16K splats. With more Gaussians each is smaller, so that they cover the same area.
pub fn synthetic_gaussians(count: usize, views: usize, size: ImageSize) -> (Gaussians, Cameras) {
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let (width, height) = (f64::from(size.width), f64::from(size.height));
    let focal = focal_length(size);
    let scale_factor = (16_384. / count.max(1) as f64).sqrt();
    let [mut means, mut scales, mut quaternions, mut opacities, mut sh] = [(); 5].map(|()| Vec::<f32>::new());
    for _ in 0..count {
        let z = 3. * (0.4 * normal(&mut random)).exp();
        let (x, y) = (random.random_range(-0.55..0.55) * width, random.random_range(-0.55..0.55) * height);
        means.extend([x / focal * z, y / focal * z, z].map(|v| v as f32));
        for (median, spread) in [(0.0044, 0.75), (0.0065, 0.6), (0.0116, 0.55)] {
            scales.push((scale_factor * median * z * (spread * normal(&mut random)).exp()) as f32);
        }
        quaternions.extend((0..4).map(|_| normal(&mut random) as f32));
        opacities.push((0.98 * random.random::<f64>().powf(1.35)) as f32);
        sh.extend((0..48).map(|_| 0.5 * normal(&mut random) as f32));
    }
    let n = count as i64;
    let gaussians = Gaussians {
        means: Tensor::from_slice(&means).view([1, n, 3]),
        scales: Tensor::from_slice(&scales).view([1, n, 3]),
        quaternions: Tensor::from_slice(&quaternions).view([1, n, 4]),
        opacities: Tensor::from_slice(&opacities).view([1, n]),
        sh: Tensor::from_slice(&sh).view([1, n, 16, 3]),
        antialiased: false,
    };
    let [_, w2c, intrinsics] = view_matrices(&camera_path(views, size), Device::Cpu);
    (gaussians, Cameras { w2c, intrinsics, width: size.width.into(), height: size.height.into() })
}

/// Returns `views` cameras that move sideways and forward while they turn.
pub fn camera_path(views: usize, size: ImageSize) -> Vec<Camera> {
    let ImageSize { width, height } = size;
    let camera = |i: usize| {
        let t = i as f64 / (views.max(2) - 1) as f64 - 0.5;
        let (rotation, center) = (DQuat::from_rotation_y(-0.2 * t), DVec3::new(0.6 * t, 0., 0.2 * t));
        let (focal, cx, cy) = (focal_length(size), f64::from(width) / 2., f64::from(height) / 2.);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx, cy };
        Camera { intrinsics, c2w: DMat4::from_rotation_translation(rotation, center), width, height }
    };
    (0..views).map(camera).collect()
}

/// Returns the focal length of the synthetic cameras, in pixels.
fn focal_length(size: ImageSize) -> f64 {
    0.9 * f64::from(size.width.max(size.height))
}

/// Samples a standard normal value with the Box-Muller transform.
fn normal(random: &mut impl Rng) -> f64 {
    let (u, v) = (1. - random.random::<f64>(), random.random::<f64>());
    (-2. * u.ln()).sqrt() * (TAU * v).cos()
}
