//! Refinement of a splat on the photos that it has to match, in seconds. The optimization keeps the number of Gaussians.
//! Without a splat, refinement starts from the depths on which the photos agree. [`RefineSession`] does all of it, from a capture to a
//! splat and its scores.

mod begin;
mod config;
mod corrections;
mod gaussian_optimizer;
mod gaussian_params;
mod options;
mod patches;
mod photos;
mod relocate;
mod session;
mod sweep;
mod view_selection;

pub use begin::gaussians_from_photos;
pub use config::RefineConfig;
pub use corrections::{Correction, Corrections};
pub use gaussian_optimizer::GaussianOptimizer;
pub use options::{Budget, RefineOptions};
pub use patches::{PatchScores, Patches};
pub use photos::{MIN_SIDE, Photos, load_photos};
pub use session::{EvalPoint, Initial, RefineEvent, RefineResult, RefineSession};

use crate::data::View;
use crate::device::Stopwatch;
use crate::error::{Error, Result};
use crate::loss::{depth_smoothness, photometric};
use crate::render::cpu::KernelThreads;
use crate::render::{Cameras, DEFAULT_EPS2D, RenderOutput, render, render_views};
use crate::scene::{Camera, Gaussians};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::time::{Duration, Instant};
use tch::{Kind, Tensor};

/// State of the optimization after a step.
pub struct RefineStep<'a> {
    /// Number of steps done.
    pub step: u64,
    /// Progress from 0 to 1.
    pub progress: f64,
    /// Time that the steps took, without the work between them.
    pub elapsed: Duration,
    optimizer: &'a GaussianOptimizer,
}

impl RefineStep<'_> {
    /// Returns a copy of the current Gaussians.
    pub fn gaussians(&self) -> Gaussians {
        tch::no_grad(|| self.optimizer.gaussians(1.)).map(Tensor::copy)
    }
}

/// Inputs of an optimization.
#[derive(Debug)]
pub struct Task<'a> {
    /// Photos that have to be matched.
    pub photos: &'a Photos,
    /// Depth of the scene, the unit of lengths: see [`scene_depth`].
    pub depth: f64,
    /// Hyperparameters.
    pub config: &'a RefineConfig,
    /// Number of steps, or time.
    pub budget: Budget,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// Optimizes the Gaussians of `optimizer` and the `corrections` of the photos. `on_step` is called after every step and ends the work if it
/// returns `false`. Returns the final Gaussians.
///
/// # Errors
/// Fails if rendering fails.
pub fn refine(
    optimizer: &mut GaussianOptimizer,
    corrections: &mut Corrections,
    task: &Task,
    on_step: impl FnMut(&RefineStep) -> bool,
) -> Result<Gaussians> {
    refine_timed(optimizer, corrections, task, &mut Stopwatch::default(), on_step)
}

/// Runs [`refine`] and records the time of each part of a step in `stopwatch`.
pub(crate) fn refine_timed(
    optimizer: &mut GaussianOptimizer,
    corrections: &mut Corrections,
    task: &Task,
    stopwatch: &mut Stopwatch,
    mut on_step: impl FnMut(&RefineStep) -> bool,
) -> Result<Gaussians> {
    let Task { photos, depth, config, budget, seed } = *task;
    let _threads = KernelThreads::take();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (begun, mut elapsed, mut last) = (Instant::now(), Duration::ZERO, Duration::ZERO);
    for step in 0.. {
        let start = Instant::now();
        let (progress, is_over) = match budget {
            Budget::Steps(steps) => (step as f64 / steps as f64, step >= steps),
            Budget::Time(time) => {
                let gone = begun.elapsed();
                // A step that would not end in time is not started.
                (gone.as_secs_f64() / time.as_secs_f64(), step > 0 && gone + last > time)
            }
        };
        if is_over {
            break;
        }
        let level = config.resolution_schedule.iter().filter(|&&part| progress >= part).count();
        let (which, batch) = stopwatch.time("photos", || photos.draw(level, config.views, &mut random));
        let gaussians = stopwatch.time("activation", || optimizer.gaussians(progress));
        let cameras = Cameras { w2c: corrections.w2c(&batch, &which), ..batch.cameras() };
        let mut pictures = stopwatch.time("render", || render(&gaussians, &cameras, DEFAULT_EPS2D))?;
        pictures.rgb = corrections.apply_exposures(pictures.rgb, &which);
        let loss = stopwatch.time("loss", || loss(&gaussians, &pictures, &batch.images, config, depth));
        stopwatch.time("backward", || {
            optimizer.zero_grad();
            corrections.zero_grad();
            loss.backward();
        });
        stopwatch.time("optimizer", || {
            optimizer.step(progress, step, &mut random)?;
            corrections.step(progress)
        })?;
        last = start.elapsed();
        elapsed += last;
        if !on_step(&RefineStep { step: step + 1, progress, elapsed, optimizer }) {
            break;
        }
    }
    Ok(tch::no_grad(|| optimizer.gaussians(1.)))
}

/// Returns the loss: the difference between rendered images and photos, plus the regularization of the Gaussians.
fn loss(
    gaussians: &Gaussians,
    pictures: &RenderOutput,
    photos: &Tensor,
    config: &RefineConfig,
    depth: f64,
) -> Tensor {
    let mut loss =
        photometric(&pictures.rgb, photos, 1. - config.ssim_weight, -config.ssim_weight) + config.ssim_weight;
    if config.opacity > 0. {
        loss += gaussians.opacities.mean(Kind::Float) * config.opacity;
    }
    if config.scale > 0. {
        loss += gaussians.scales.mean(Kind::Float) * (config.scale / depth);
    }
    if config.depth_smoothness_weight > 0. {
        loss += depth_smoothness(&pictures.depth, photos, config.depth_smoothness_weight);
    }
    loss
}

/// Maximum number of views that are rendered for the median depth, as the time is better spent on steps.
const DEPTH_VIEWS: usize = 32;

/// Returns the median depth of a splat in the views, or in some that are spread over all. It is the unit of lengths.
///
/// # Errors
/// Fails if the views see nothing of the splat.
pub fn scene_depth(gaussians: &Gaussians, views: &[View]) -> Result<f64> {
    let every = views.len().div_ceil(DEPTH_VIEWS).max(1);
    let cameras: Vec<Camera> = views.iter().step_by(every).map(|view| view.camera).collect();
    let mut seen = vec![];
    for rendered in render_views(gaussians, &cameras)? {
        let depth = rendered.depth.masked_select(&rendered.alpha.gt(0.5));
        seen.push(depth);
    }
    let depths = Tensor::cat(&seen, 0);
    if depths.numel() == 0 {
        return Err(Error::request("no camera sees the splat: are both in the same world coordinates?"));
    }
    Ok(depths.median().double_value(&[]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::synthetic_scene;
    use crate::data::ViewBatch;
    use crate::scene::{ImageSize, RawGaussians};
    use globalsplat_csrc::ops::{WAITING, computing, record_ops, record_outermost_ops};
    use tch::Device;

    /// A step copies nothing between devices beyond what is counted here: photos, Gaussians and corrections are on the device. It waits for
    /// the device only where memory for (splat, tile) pairs is allocated.
    #[test]
    fn a_step_makes_only_expected_device_copies() {
        let (gaussians, cameras) = synthetic_scene(40, 4, ImageSize { width: 32, height: 24 });
        let pictures = render(&gaussians, &cameras, DEFAULT_EPS2D).unwrap();
        let c2w = cameras.w2c.inverse();
        let intrinsics = cameras.intrinsics.shallow_clone();
        let views = ViewBatch { images: pictures.rgb, c2w, w2c: cameras.w2c.shallow_clone(), intrinsics };
        let settings = ["relocate_every=0", "opacity=0.01", "scale=0.01", "depth_smoothness_weight=0.1"]
            .map(String::from);
        let config = RefineConfig::with(&settings, false).unwrap();
        let photos = Photos::from_batch(views);
        let task_of = |steps| Task {
            photos: &photos,
            depth: 1.,
            config: &config,
            budget: Budget::Steps(steps),
            seed: 0,
        };
        let steps = |count| {
            let mut optimizer =
                GaussianOptimizer::new(&RawGaussians::from_gaussians(&gaussians), 1., &config);
            let mut corrections = Corrections::new(4, true, true, 1., &config, Device::Cpu);
            refine(&mut optimizer, &mut corrections, &task_of(count), |_| true).unwrap();
        };
        let count = |ops: &[String], name: &str| ops.iter().filter(|op| *op == name).count();
        let [two, five] = [2, 5].map(|number| record_ops(|| steps(number)).1);
        let of_a_step = |name: &str| (count(&five, name) - count(&two, name)) as f64 / 3.;
        let (_, of_a_render) = record_ops(|| render(&gaussians, &cameras, DEFAULT_EPS2D).unwrap());
        // Both losses move the images to the photos' device and move their value back, which counts even on one device.
        let sent = count(&of_a_render, "aten::to.device") + 2 * 3;
        assert_eq!(of_a_step("aten::to.device"), sent as f64);
        for op in WAITING {
            // On the CPU, the backward pass of each loss reads its incoming gradient, to skip a multiplication by 1.
            let asked = if op == "aten::_local_scalar_dense" { 2. } else { 0. };
            assert_eq!(of_a_step(op), asked, "{op}");
        }
        let [two, five] = [2, 5].map(|number| computing(&record_outermost_ops(|| steps(number)).1));
        let kernels = (five - two) / 3;
        assert!((50..=125).contains(&kernels), "{kernels}");
    }
}
