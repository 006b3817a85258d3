//! Refinement of a splat on the photos that it has to match, in seconds. Without a splat, refinement starts from the depths on which the photos agree. [`RefineSession`] does all of it, from a capture to a
//! splat and its scores.

mod config;
mod corrections;
mod events;
mod exposures;
mod gaussian_optimizer;
mod gaussian_params;
mod init;
mod known_depths;
mod options;
mod photos;
mod relocate;
mod session;
mod state;

pub use config::RefineConfig;
pub use corrections::{Correction, Corrections};
pub use events::{EvalPoint, RefineEvent, RefineLog, RefineMetrics};
pub use gaussian_optimizer::GaussianOptimizer;
pub use init::{PhotoInit, SceneInit, gaussians_from_photos};
pub use options::{Budget, ExposureCorrection, MaskBackground, RefineOptions};
pub use photos::{Photos, load_photos};
pub use session::{RefineResult, RefineSession};
pub use state::{RefineState, TrainProgress};

use self::known_depths::KnownDepths;
use self::photos::TrainBatch;
use crate::data::{View, ViewBatch};
use crate::device::Stopwatch;
use crate::error::{Error, Result};
use crate::loss::{depth_smoothness, fill_masked, photometric};
use crate::render::cpu::KernelThreads;
use crate::render::{Cameras, RenderOutput, default_eps2d, render, render_views};
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
    loss: &'a Tensor,
}

impl RefineStep<'_> {
    /// Returns a copy of the Gaussians, averaged over the last steps near the end of the optimization.
    pub fn gaussians(&self) -> Gaussians {
        self.optimizer.averaged_gaussians()
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> i64 {
        self.optimizer.count()
    }

    /// Returns the learning rate of the means, in units of the scene's depth.
    fn means_learning_rate(&self) -> f64 {
        self.optimizer.means_learning_rate(self.progress)
    }

    /// Returns the loss of the step. On a GPU this waits for the step.
    pub fn loss(&self) -> f64 {
        self.loss.double_value(&[])
    }
}

/// Inputs of an optimization.
#[derive(Debug)]
pub struct OptimizeArgs<'a> {
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
    /// Background of masked pixels; `None` ignores them.
    pub background: Option<MaskBackground>,
    /// Where an earlier optimization has ended that this one continues. The budget includes its steps and its time.
    pub progress: TrainProgress,
}

/// Optimizes the Gaussians of `optimizer` and the `corrections` of the photos. `on_step` is called after every step and ends the work if it
/// returns `false`. Returns the final Gaussians, and where it has ended.
///
/// # Errors
/// Fails if rendering fails.
pub fn refine(
    optimizer: &mut GaussianOptimizer,
    corrections: &mut Corrections,
    args: &OptimizeArgs,
    on_step: impl FnMut(&RefineStep) -> bool,
) -> Result<(Gaussians, TrainProgress)> {
    refine_timed(optimizer, corrections, args, &mut Stopwatch::default(), on_step)
}

/// Runs [`refine`] and records the time of each part of a step in `stopwatch`.
pub(crate) fn refine_timed(
    optimizer: &mut GaussianOptimizer,
    corrections: &mut Corrections,
    args: &OptimizeArgs,
    stopwatch: &mut Stopwatch,
    mut on_step: impl FnMut(&RefineStep) -> bool,
) -> Result<(Gaussians, TrainProgress)> {
    let OptimizeArgs { photos, depth, config, budget, seed, background, progress: earlier } = *args;
    let _threads = KernelThreads::take();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_word_pos(earlier.random);
    let (begun, mut elapsed, mut last) = (Instant::now(), Duration::ZERO, Duration::ZERO);
    let mut step = earlier.steps;
    loop {
        let start = Instant::now();
        let (progress, is_over) = match budget {
            Budget::Steps(steps) => (step as f64 / steps as f64, step >= steps),
            Budget::Time(time) => {
                let spent = earlier.time + begun.elapsed();
                // A step that would not end in time is not started.
                (spent.as_secs_f64() / time.as_secs_f64(), step > earlier.steps && spent + last > time)
            }
        };
        if is_over {
            break;
        }
        let TrainBatch { which, views: batch, depths: known } =
            stopwatch.time("photos", || photos.sample(progress, config.views, &mut random));
        let gaussians = stopwatch.time("activation", || optimizer.gaussians(progress));
        let cameras = Cameras { w2c: corrections.w2c(&batch, &which), ..batch.cameras() };
        let mut rendered =
            stopwatch.time("render", || render(&gaussians, &cameras, default_eps2d(&gaussians)))?;
        rendered.rgb = corrections.apply_exposures(rendered.rgb, &which);
        let background = background.map(|background| background.color(&mut random));
        let loss = stopwatch.time("loss", || {
            let loss = loss(&gaussians, &rendered, &batch, background, config, depth);
            let weight = config.depth_weight_at(progress);
            let difference = (weight > 0.).then(|| known_depths_loss(&rendered.depth, &known)).flatten();
            match difference {
                Some(difference) => loss + difference * weight,
                None => loss,
            }
        });
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
        step += 1;
        if !on_step(&RefineStep { step, progress, elapsed, optimizer, loss: &loss }) {
            break;
        }
    }
    let progress =
        TrainProgress { steps: step, time: earlier.time + begun.elapsed(), random: random.get_word_pos() };
    Ok((optimizer.averaged_gaussians(), progress))
}

/// Returns the loss: the difference between rendered images and photos, plus the regularization of the Gaussians. Masked pixels of the
/// photos are left out, or have the color `background`, over which the splat is seen.
fn loss(
    gaussians: &Gaussians,
    rendered: &RenderOutput,
    photos: &ViewBatch,
    background: Option<[f32; 3]>,
    config: &RefineConfig,
    depth: f64,
) -> Tensor {
    let (l1_weight, ssim_weight) = (1. - config.ssim_weight, -config.ssim_weight);
    let difference = match background {
        Some(color) => {
            let color = Tensor::from_slice(&color).view([3, 1, 1]).to_device(photos.images.device());
            let rgb = &rendered.rgb + (1. - rendered.alpha.unsqueeze(2)) * &color;
            let filled = photos.masks.as_ref().map(|masks| fill_masked(&photos.images, &color, masks));
            photometric(&rgb, filled.as_ref().unwrap_or(&photos.images), None, l1_weight, ssim_weight)
        }
        None => photometric(&rendered.rgb, &photos.images, photos.masks.as_ref(), l1_weight, ssim_weight),
    };
    let mut loss = difference + config.ssim_weight;
    if config.opacity_reg > 0. {
        loss += gaussians.opacities.mean(Kind::Float) * config.opacity_reg;
    }
    if config.scale_reg > 0. {
        loss += gaussians.scales.mean(Kind::Float) * (config.scale_reg / depth);
    }
    if config.depth_smoothness_weight > 0. {
        let masks = photos.masks.as_ref().map(|masks| masks.squeeze_dim(2));
        let weight = config.depth_smoothness_weight;
        loss += depth_smoothness(&rendered.depth, &photos.images, masks.as_ref(), weight);
    }
    loss
}

/// Returns the mean of [`KnownDepths::loss`] over the rendered photos, whose depths are [1, C, H, W]. Photos without known depths count as 0.
/// Returns `None` if none has any.
fn known_depths_loss(depths: &Tensor, known: &[Option<&KnownDepths>]) -> Option<Tensor> {
    let count = known.len() as f64;
    let of = |(index, known): (usize, &Option<&KnownDepths>)| {
        Some((*known)?.loss(&depths.get(0).get(index as i64)) / count)
    };
    known.iter().enumerate().filter_map(of).reduce(|a, b| a + b)
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
    use crate::data::view_batch;
    use crate::device::num_threads;
    use crate::metrics::score_views;
    use crate::render::DEFAULT_EPS2D;
    use crate::scene::{Intrinsics, RawGaussians};
    use glam::{DMat4, DVec3};
    use globalsplat_csrc::runtime::{RecordedOp, WAITING, computing, record_ops};
    use tch::Device;

    const SIDE: i64 = 64;

    /// Returns the views of a wall with a wave pattern at depth 4, and the same with a bright square that moves in front of it, which a mask
    /// leaves out if `is_masked`.
    fn wall(is_masked: bool) -> [Vec<View>; 2] {
        let options = (Kind::Float, Device::Cpu);
        let side = SIDE as f64;
        let intrinsics = Intrinsics { fx: side, fy: side, cx: side / 2., cy: side / 2. };
        let view = |index: i64| {
            let at = 0.25 * index as f64 - 0.75;
            let axis = |offset: f64| (Tensor::arange(SIDE, options) + 0.5 - side / 2.) / side * 4. + offset;
            let (x, y) = (axis(at).view([1, SIDE]), axis(0.).view([SIDE, 1]));
            let wave = ((&x * 5.).sin() * (&y * 4.).cos() + (&x * 11. + &y * 7.).sin()) * 0.2 + 0.4;
            let c2w = DMat4::from_translation(DVec3::X * at);
            let camera = Camera { intrinsics, c2w, width: SIDE as u32, height: SIDE as u32 };
            let image = wave.expand([3, SIDE, SIDE], false).contiguous();
            View { name: index.to_string(), image: image.into(), mask: None, camera }
        };
        let clean: Vec<View> = (0..7).map(view).collect();
        let blobs = clean.iter().enumerate().map(|(index, view)| {
            let square = |t: &Tensor| {
                let (row, column) = (7 * index as i64, 23 * index as i64 % 48);
                t.narrow(1, row, 16).narrow(2, column, 16)
            };
            let (image, mask) = (view.image.to_float().copy(), Tensor::ones([1, SIDE, SIDE], options));
            let _ = square(&image).fill_(1.);
            let _ = square(&mask).fill_(0.);
            View { image: image.into(), mask: is_masked.then(|| mask.into()), ..view.shallow_clone() }
        });
        [blobs.collect(), clean]
    }

    /// Returns 40 Gaussians of the wall, and its first `count` cameras.
    fn gaussians_of_wall(count: usize) -> (Gaussians, Cameras) {
        let [_, views] = wall(false);
        let scene =
            gaussians_from_photos(&views, &[], 40, 0, ExposureCorrection::Off, |_| true).expect("depths");
        let poses: Vec<DMat4> = views[..count].iter().map(|view| view.camera.c2w).collect();
        (scene.gaussians.activate(), view_batch(&views[..count], &poses, Device::Cpu).cameras())
    }

    /// Refines a splat on `views`, which starts from the depths of `start`, and returns it.
    fn refined(start: &[View], views: &[View], background: Option<MaskBackground>, seed: u64) -> Gaussians {
        let _guard = num_threads::lock_exclusive();
        let config = RefineConfig::default();
        let off = ExposureCorrection::Off;
        let raw = gaussians_from_photos(start, &[], 400, seed, off, |_| true).expect("depths").gaussians;
        let depth = scene_depth(&raw.activate(), views).unwrap();
        let mut optimizer = GaussianOptimizer::new(&raw, depth, &config, 0);
        let photos = Photos::new(views, &[], &config, Device::Cpu);
        let budget = Budget::Steps(400);
        let args = OptimizeArgs {
            photos: &photos,
            depth,
            config: &config,
            budget,
            seed,
            background,
            progress: TrainProgress::default(),
        };
        refine(&mut optimizer, &mut Corrections::none(), &args, |_| true).unwrap().0
    }

    /// A bright thing that moves through the photos costs a lot of quality on a view that isn't among them, and most of it is recovered if
    /// it is masked out. A single seed can be off by decibels.
    #[test]
    fn a_mask_leaves_out_what_moves() {
        const SEEDS: u64 = 4;
        let ([masked, clean], [unmasked, _]) = (wall(true), wall(false));
        let truth = clean[3].shallow_clone();
        let mean_psnr = |mut views: Vec<View>| {
            views.remove(3);
            let psnr = |seed| {
                let splat = refined(&views, &views, None, seed);
                let scores =
                    score_views("wall", &splat, std::slice::from_ref(&truth), None, |_| true).unwrap();
                scores.unwrap().mean.psnr
            };
            (0..SEEDS).map(psnr).sum::<f64>() / SEEDS as f64
        };
        let [of_clean, of_masked, of_unmasked] = [clean, masked, unmasked].map(mean_psnr);
        let scores =
            format!("{of_clean} dB without the square, {of_masked} dB masked, {of_unmasked} dB unmasked");
        assert!(of_unmasked < of_clean - 3., "{scores}");
        assert!(of_clean - of_masked < 0.25 * (of_clean - of_unmasked), "{scores}");
    }

    /// A random background removes what is under a mask; without a background, it stays.
    #[test]
    fn a_random_mask_background_leaves_emptiness() {
        let [_, whole] = wall(false);
        let mut views: Vec<View> = whole.iter().map(View::shallow_clone).collect();
        for (index, view) in views.iter_mut().enumerate() {
            let end = SIDE / 2 - (index as i64 - 3) * 4;
            let mask = Tensor::ones([1, SIDE, SIDE], (Kind::Float, Device::Cpu));
            let _ = mask.narrow(2, end, SIDE - end).zero_();
            view.mask = Some(mask.into());
        }
        let middle = [views[3].camera];
        let [ignored, random] = [None, Some(MaskBackground::Random)].map(|background| {
            let alpha =
                render_views(&refined(&whole, &views, background, 0), &middle).unwrap().remove(0).alpha;
            let mean = |first: i64| alpha.narrow(1, first, SIDE / 2 - 4).mean(Kind::Double).double_value(&[]);
            [mean(0), mean(SIDE / 2 + 4)]
        });
        // How much is left behind an ignored mask depends on the learning rates.
        assert!(random[0] > 0.9 && random[1] < 0.1, "{random:?}");
        assert!(ignored[1] > 4. * random[1], "{random:?}, {ignored:?}");
    }

    #[test]
    fn without_any_depths_there_are_no_gaussians() {
        let [_, views] = wall(false);
        assert!(gaussians_from_photos(&views, &[], 40, 0, ExposureCorrection::Auto, |_| false).is_none());
    }

    /// The number of Gaussians grows to the requested one, also if no relocation is due.
    #[test]
    fn the_number_of_gaussians_grows() {
        let _guard = num_threads::lock_exclusive();
        let [_, views] = wall(false);
        let off = ExposureCorrection::Off;
        let raw = gaussians_from_photos(&views, &[], 40, 0, off, |_| true).expect("depths").gaussians;
        let depth = scene_depth(&raw.activate(), &views).unwrap();
        for relocate_every in [0, 3] {
            let config = RefineConfig { relocate_every, ..RefineConfig::default() };
            let photos = Photos::new(&views, &[], &config, Device::Cpu);
            let (budget, mut counts) = (Budget::Steps(20), vec![]);
            let args = OptimizeArgs {
                photos: &photos,
                depth,
                config: &config,
                budget,
                seed: 0,
                background: None,
                progress: TrainProgress::default(),
            };
            let mut optimizer = GaussianOptimizer::new(&raw, depth, &config, 90);
            let splat = refine(&mut optimizer, &mut Corrections::none(), &args, |step| {
                counts.push(step.gaussians().count());
                true
            });
            assert_eq!((splat.unwrap().0.count(), counts[0]), (90, 40));
            assert!(counts.is_sorted() && counts[12] == 90, "{counts:?}");
            // Before the growth ends at step 12, Gaussians are only added with a relocation.
            assert_eq!(counts[8] > 40 && counts[8] < 90, relocate_every > 0, "{counts:?}");
        }
    }

    /// The splat is compared over the background: one that is empty matches a photo that is masked out.
    #[test]
    fn masked_pixels_have_the_background_s_color() {
        let (gaussians, cameras) = gaussians_of_wall(1);
        let rendered = render(&gaussians, &cameras, DEFAULT_EPS2D).unwrap();
        let config = RefineConfig { opacity_reg: 0., ..RefineConfig::default() };
        let loss_of = |alpha: f64, masked: bool, background: [f32; 3]| {
            let (rgb, full) = (rendered.rgb.zeros_like(), rendered.alpha.ones_like());
            let rendered = RenderOutput { rgb, alpha: &full * alpha, depth: full.zeros_like() };
            let views = ViewBatch {
                images: rendered.rgb.ones_like() * 0.3,
                masks: masked.then(|| full.zeros_like().unsqueeze(2)),
                depths: None,
                c2w: cameras.w2c.inverse(),
                w2c: cameras.w2c.shallow_clone(),
                intrinsics: cameras.intrinsics.shallow_clone(),
            };
            loss(&gaussians, &rendered, &views, Some(background), &config, 1.).double_value(&[])
        };
        for color in [[0.; 3], [1.; 3], [0.2, 0.9, 0.4]] {
            let found = loss_of(0., true, color);
            assert!(found.abs() < 1e-4, "{color:?}: {found}");
        }
        assert!(loss_of(1., true, [1.; 3]) > 0.5 && loss_of(1., true, [0.; 3]).abs() < 1e-4);
        // Photos without a mask are compared over the background, too.
        assert!(loss_of(0., false, [0.3; 3]).abs() < 1e-4 && loss_of(1., false, [0.3; 3]) > 0.1);
    }

    /// A step copies nothing between devices beyond what is counted here: photos, Gaussians and corrections are on the device. It waits for
    /// the device only where memory for (splat, tile) pairs is allocated.
    #[test]
    fn a_step_makes_only_expected_device_copies() {
        let (gaussians, cameras) = gaussians_of_wall(4);
        let rendered = render(&gaussians, &cameras, DEFAULT_EPS2D).unwrap();
        let c2w = cameras.w2c.inverse();
        let intrinsics = cameras.intrinsics.shallow_clone();
        let views = ViewBatch {
            images: rendered.rgb,
            masks: None,
            depths: None,
            c2w,
            w2c: cameras.w2c.shallow_clone(),
            intrinsics,
        };
        let settings =
            ["relocate_every=0", "opacity_reg=0.01", "scale_reg=0.01", "depth_smoothness_weight=0.1"]
                .map(String::from);
        let config = RefineConfig::with(&settings, false).unwrap();
        let photos = Photos::from_batch(views);
        let args_of = |steps| OptimizeArgs {
            photos: &photos,
            depth: 1.,
            config: &config,
            budget: Budget::Steps(steps),
            seed: 0,
            background: None,
            progress: TrainProgress::default(),
        };
        let steps = |count| {
            let mut optimizer =
                GaussianOptimizer::new(&RawGaussians::from_gaussians(&gaussians), 1., &config, 0);
            let mut corrections = Corrections::new(4, true, Some(&[[0.; 3]; 4]), 1., &config, Device::Cpu);
            let _guard = num_threads::lock_exclusive();
            refine(&mut optimizer, &mut corrections, &args_of(count), |_| true).unwrap();
        };
        let count = |ops: &[RecordedOp], name: &str| ops.iter().filter(|op| op.name == name).count();
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
        let kernels = (computing(&five) - computing(&two)) / 3;
        assert!((50..=125).contains(&kernels), "{kernels}");
    }
}
