//! Optimizes a splat on posed photos, in seconds. Without an initial splat, Gaussians are initialized where the depths of several photos
//! agree. [`RefineSession`] runs everything, from a capture to a splat and its scores.

mod events;
mod exposures;
mod gaussian_optimizer;
mod gaussian_params;
mod init;
mod known_depths;
mod options;
mod photo_opt;
mod photos;
mod relocate;
mod session;
mod state;
mod time_budget;

pub use events::{EvalPoint, RefineEvent, RefineLog};
pub use init::{PhotoInit, SceneInit, gaussians_from_photos};
pub use options::{Budget, ExposureCorrection, MaskBackground, RefineOptions};
pub use photo_opt::Correction;
pub use session::{RefineResult, RefineSession};
pub use state::RefineState;

pub(crate) use gaussian_optimizer::GaussianOptimizer;
pub(crate) use photo_opt::PhotoOpt;
pub(crate) use photos::Photos;
pub(crate) use state::TrainProgress;

use self::known_depths::KnownDepths;
use self::photos::TrainBatch;
use crate::data::{View, ViewBatch};
use crate::device::Stopwatch;
use crate::error::{Error, Result};
use crate::loss::{depth_smoothness, photometric};
use crate::render::cpu::KernelThreads;
use crate::render::{Cameras, RenderOutput, default_eps2d, render, render_views};
use crate::scene::{Camera, Gaussians};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::time::{Duration, Instant};
use tch::{Kind, Tensor};

/// State of the optimization after a step.
pub(crate) struct RefineStep<'a> {
    /// Number of steps done.
    pub step: u64,
    /// Progress from 0 to 1.
    pub progress: f64,
    pub optimizer: &'a GaussianOptimizer,
    /// Loss of the step. On a GPU reading it waits for the step.
    pub loss: &'a Tensor,
}

/// Inputs of an optimization.
#[derive(Debug)]
pub(crate) struct OptimizeArgs<'a> {
    /// Photos that have to be matched.
    pub photos: &'a Photos,
    /// Options with their settings.
    pub options: &'a RefineOptions,
    /// Number of steps, or time.
    pub budget: Budget,
    /// Progress of the earlier optimization that this one continues. The budget includes its steps and its time.
    pub progress: TrainProgress,
}

/// Optimizes the Gaussians of `optimizer` and the corrections of the photos, and records the time of each part of a step in `stopwatch`.
/// `on_step` is called after every step and ends the work if it returns `false`. Returns the progress at the end.
///
/// # Errors
/// Fails if rendering fails.
pub(crate) fn refine(
    optimizer: &mut GaussianOptimizer,
    photo_opt: &mut PhotoOpt,
    args: &OptimizeArgs,
    stopwatch: &mut Stopwatch,
    mut on_step: impl FnMut(&RefineStep) -> bool,
) -> Result<TrainProgress> {
    let OptimizeArgs { photos, options, budget, progress: earlier } = *args;
    let _threads = KernelThreads::take();
    let mut random = ChaCha8Rng::seed_from_u64(options.seed);
    random.set_word_pos(earlier.random);
    let (begun, mut last) = (Instant::now(), Duration::ZERO);
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
            stopwatch.time("photos", || photos.sample(progress, options.views, &mut random));
        let gaussians = stopwatch.time("activation", || optimizer.gaussians(progress));
        let cameras = Cameras { w2c: photo_opt.w2c(&batch, &which), ..batch.cameras() };
        let mut rendered =
            stopwatch.time("render", || render(&gaussians, &cameras, default_eps2d(&gaussians)))?;
        rendered.rgb = photo_opt.apply_exposures(rendered.rgb, &which);
        let background = options.mask_background.map(|background| background.color(&mut random));
        let loss = stopwatch.time("loss", || {
            let loss = loss(&gaussians, &rendered, &batch, background, options, optimizer.depth);
            let weight = options.depth_weight_at(progress);
            let difference = (weight > 0.).then(|| known_depths_loss(&rendered.depth, &known)).flatten();
            match difference {
                Some(difference) => loss + difference * weight,
                None => loss,
            }
        });
        stopwatch.time("backward", || {
            optimizer.zero_grad();
            photo_opt.zero_grad();
            loss.backward();
        });
        stopwatch.time("optimizer", || {
            optimizer.step(progress, step, &mut random)?;
            photo_opt.step(progress)
        })?;
        last = start.elapsed();
        step += 1;
        if !on_step(&RefineStep { step, progress, optimizer, loss: &loss }) {
            break;
        }
    }
    Ok(TrainProgress { steps: step, time: earlier.time + begun.elapsed(), random: random.get_word_pos() })
}

/// Returns the loss: the difference between rendered images and photos, plus the regularization of the Gaussians. Masked pixels of the
/// photos, which are over black then, are left out, or have the color `background`, over which the splat is seen. `depth` is the depth of
/// the scene.
fn loss(
    gaussians: &Gaussians,
    rendered: &RenderOutput,
    photos: &ViewBatch,
    background: Option<[f32; 3]>,
    options: &RefineOptions,
    depth: f64,
) -> Tensor {
    let (l1_weight, ssim_weight) = (1. - options.ssim_weight, -options.ssim_weight);
    let difference = match background {
        Some(color) => {
            let color = Tensor::from_slice(&color).view([3, 1, 1]).to_device(photos.images.device());
            let rgb = &rendered.rgb + (1. - rendered.alpha.unsqueeze(2)) * &color;
            let filled = photos.masks.as_ref().map(|masks| &photos.images + (1. - masks) * &color);
            photometric(&rgb, filled.as_ref().unwrap_or(&photos.images), None, l1_weight, ssim_weight)
        }
        None => photometric(&rendered.rgb, &photos.images, photos.masks.as_ref(), l1_weight, ssim_weight),
    };
    let mut loss = difference + options.ssim_weight;
    if options.opacity_reg > 0. {
        loss += gaussians.opacities.mean(Kind::Float) * options.opacity_reg;
    }
    if options.scale_reg > 0. {
        loss += gaussians.scales.mean(Kind::Float) * (options.scale_reg / depth);
    }
    if options.depth_smoothness_weight > 0. {
        let masks = photos.masks.as_ref().map(|masks| masks.squeeze_dim(2));
        let weight = options.depth_smoothness_weight;
        loss += depth_smoothness(&rendered.depth, &photos.images, masks.as_ref(), weight);
    }
    loss
}

/// Returns the mean of [`KnownDepths::loss`] over the rendered photos, whose depths are [1, C, H, W]. Photos without known depths count as 0.
/// Returns `None` if none has any.
fn known_depths_loss(depths: &Tensor, known: &[Option<&KnownDepths>]) -> Option<Tensor> {
    let loss_of = |(index, known): (usize, &Option<&KnownDepths>)| {
        Some((*known)?.loss(&depths.get(0).get(index as i64)) / depths.size()[1] as f64)
    };
    known.iter().enumerate().filter_map(loss_of).reduce(|a, b| a + b)
}

/// Maximum number of views that are rendered for the median depth, as the time is better spent on steps.
const DEPTH_VIEWS: usize = 32;

/// Returns the median depth of a splat in the views, or in some that are spread over all. It is the unit of lengths.
///
/// # Errors
/// Fails if the views see nothing of the splat.
pub(crate) fn scene_depth(gaussians: &Gaussians, views: &[View]) -> Result<f64> {
    let every = views.len().div_ceil(DEPTH_VIEWS).max(1);
    let cameras: Vec<Camera> = views.iter().step_by(every).map(|view| view.camera).collect();
    let rendered = render_views(gaussians, &cameras)?;
    let seen: Vec<Tensor> =
        rendered.iter().map(|view| view.depth.masked_select(&view.alpha.gt(0.5))).collect();
    let depths = Tensor::cat(&seen, 0);
    if depths.numel() == 0 {
        return Err(Error::request("no camera sees the splat: are both in the same world coordinates?"));
    }
    Ok(depths.median().double_value(&[]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::{WALL_SIDE as SIDE, view_batch, wall};
    use crate::device::num_threads;
    use crate::metrics::score_views;
    use crate::render::DEFAULT_EPS2D;
    use crate::scene::RawGaussians;
    use crate::stereo::SWEEP_SIDE;
    use globalsplat_csrc::runtime::{RecordedOp, WAITING, computing, record_ops};
    use tch::Device;

    /// Returns seven views of the wall.
    fn walls() -> Vec<View> {
        (0..7).map(|index| wall(0.25 * f64::from(index) - 0.75)).collect()
    }

    /// Returns `views` with pixels that are left out by a mask: those of the part that `part` selects of each view's tensors.
    fn masked(views: &[View], part: impl Fn(i64, &Tensor) -> Tensor) -> Vec<View> {
        let masked = |(index, view): (usize, &View)| {
            let mask = Tensor::ones([1, SIDE, SIDE], (Kind::Float, Device::Cpu));
            let _ = part(index as i64, &mask).zero_();
            View { mask: Some(mask.into()), ..view.shallow_clone() }
        };
        views.iter().enumerate().map(masked).collect()
    }

    /// Returns `count` Gaussians at the depths on which the photos agree.
    pub(super) fn start(views: &[View], count: usize, seed: u64) -> RawGaussians {
        let off = ExposureCorrection::Off;
        gaussians_from_photos(views, &[], count, SWEEP_SIDE, seed, off, |_| true).expect("depths").gaussians
    }

    fn args_of<'a>(photos: &'a Photos, options: &'a RefineOptions, steps: u64) -> OptimizeArgs<'a> {
        OptimizeArgs { photos, options, budget: Budget::Steps(steps), progress: TrainProgress::default() }
    }

    /// Refines a splat on `views`, which starts from the depths of `initial`, and returns it.
    fn refined(
        initial: &[View],
        views: &[View],
        mask_background: Option<MaskBackground>,
        seed: u64,
    ) -> Gaussians {
        let _guard = num_threads::lock_exclusive();
        let options = RefineOptions { seed, mask_background, ..RefineOptions::default() };
        let raw = start(initial, 400, seed);
        let depth = scene_depth(&raw.activate(), views).unwrap();
        let mut optimizer = GaussianOptimizer::new(&raw, depth, &options, 0);
        let photos = Photos::new(views, &[], &options);
        let args = args_of(&photos, &options, 400);
        refine(&mut optimizer, &mut PhotoOpt::none(), &args, &mut Stopwatch::default(), |_| true).unwrap();
        optimizer.averaged_gaussians()
    }

    /// A bright thing that moves through the photos costs a lot of quality on a view that isn't among them, and most of it is recovered if
    /// it is masked out. A single seed can be off by decibels.
    #[test]
    fn a_mask_leaves_out_what_moves() {
        const SEEDS: u64 = 4;
        let square = |index: i64, t: &Tensor| t.narrow(1, 7 * index, 16).narrow(2, 23 * index % 48, 16);
        let clean = walls();
        let truth = clean[3].shallow_clone();
        let bright = |(index, view): (usize, &View)| {
            let image = view.image.to_float().copy();
            let _ = square(index as i64, &image).fill_(1.);
            View { image: image.into(), ..view.shallow_clone() }
        };
        let unmasked: Vec<View> = clean.iter().enumerate().map(bright).collect();
        let mean_psnr = |mut views: Vec<View>| {
            views.remove(3);
            let psnr = |seed| {
                let splat = refined(&views, &views, None, seed);
                let scores = score_views("wall", &splat, std::slice::from_ref(&truth), None, |_| true);
                scores.unwrap().unwrap().mean.psnr
            };
            (0..SEEDS).map(psnr).sum::<f64>() / SEEDS as f64
        };
        let masked = masked(&unmasked, square);
        let [of_clean, of_masked, of_unmasked] = [clean, masked, unmasked].map(mean_psnr);
        let scores =
            format!("{of_clean} dB without the square, {of_masked} dB masked, {of_unmasked} dB unmasked");
        assert!(of_unmasked < of_clean - 3., "{scores}");
        assert!(of_clean - of_masked < 0.25 * (of_clean - of_unmasked), "{scores}");
    }

    /// A random background removes what is under a mask; without a background, it stays.
    #[test]
    fn a_random_mask_background_leaves_emptiness() {
        let whole = walls();
        let mut views = masked(&whole, |index, mask| {
            let end = SIDE / 2 - (index - 3) * 4;
            mask.narrow(2, end, SIDE - end)
        });
        for view in &mut views {
            view.image = (view.image.to_float() * view.mask_or_ones().to_float()).into();
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

    /// The number of Gaussians grows to the requested one, also if no relocation is due.
    #[test]
    fn the_number_of_gaussians_grows() {
        let _guard = num_threads::lock_exclusive();
        let views = walls();
        assert!(
            gaussians_from_photos(&views, &[], 40, SWEEP_SIDE, 0, ExposureCorrection::Auto, |_| false)
                .is_none()
        );
        let raw = start(&views, 40, 0);
        let depth = scene_depth(&raw.activate(), &views).unwrap();
        for relocate_every in [0, 3] {
            let options = RefineOptions { relocate_every, ..RefineOptions::default() };
            let photos = Photos::new(&views, &[], &options);
            let args = args_of(&photos, &options, 20);
            let mut optimizer = GaussianOptimizer::new(&raw, depth, &options, 90);
            let mut counts = vec![];
            let (none, stopwatch) = (&mut PhotoOpt::none(), &mut Stopwatch::default());
            let count = |step: &RefineStep| {
                counts.push(step.optimizer.count());
                true
            };
            refine(&mut optimizer, none, &args, stopwatch, count).unwrap();
            assert_eq!((optimizer.averaged_gaussians().count(), counts[0]), (90, 40));
            assert!(counts.is_sorted() && counts[12] == 90, "{counts:?}");
            // Before the growth ends at step 12, Gaussians are only added with a relocation.
            assert_eq!(counts[8] > 40 && counts[8] < 90, relocate_every > 0, "{counts:?}");
        }
    }

    /// The splat is compared over the background: one that is empty matches a photo that is masked out, and one that is as transparent as
    /// the photo matches it.
    #[test]
    fn masked_pixels_have_the_background_s_color() {
        let view = wall(0.);
        let gaussians = start(&walls(), 40, 0).activate();
        let options = RefineOptions { opacity_reg: 0., ..RefineOptions::default() };
        // A splat of black, or of the photo's color.
        let loss_of = |alpha: f64, level: f64, weight: f64, background: [f32; 3]| {
            let views = view_batch(std::slice::from_ref(&view), &[view.camera.c2w], Device::Cpu);
            let (ones, full) = (views.images.ones_like(), views.images.select(2, 0).ones_like());
            let images = &ones * (0.3 * weight);
            let masks = (weight < 1.).then(|| full.unsqueeze(2) * weight);
            let (rgb, depth) = (ones * (level * alpha), full.zeros_like());
            let rendered = RenderOutput { rgb, alpha: full * alpha, depth };
            let views = ViewBatch { images, masks, ..views };
            loss(&gaussians, &rendered, &views, Some(background), &options, 1.).double_value(&[])
        };
        for color in [[0.; 3], [1.; 3], [0.2, 0.9, 0.4]] {
            for weight in [0., 0.5, 1.] {
                let found = loss_of(weight, 0.3, weight, color);
                assert!(found.abs() < 1e-4, "{weight} {color:?}: {found}");
            }
        }
        assert!(loss_of(1., 0., 0., [1.; 3]) > 0.5 && loss_of(1., 0., 0., [0.; 3]).abs() < 1e-4);
        // Photos without a mask are compared over the background, too.
        assert!(loss_of(0., 0., 1., [0.3; 3]).abs() < 1e-4 && loss_of(1., 0., 1., [0.3; 3]) > 0.1);
    }

    /// A step copies nothing between devices beyond what is counted here: photos, Gaussians and corrections are on the device. It waits for
    /// the device only where memory for (splat, tile) pairs is allocated.
    #[test]
    fn a_step_makes_only_expected_device_copies() {
        let views = &walls()[..4];
        let raw = start(&walls(), 40, 0);
        let gaussians = raw.activate();
        let options = RefineOptions {
            correct_poses: true,
            relocate_every: 0,
            resolution_schedule: Some(vec![]),
            opacity_reg: 0.01,
            scale_reg: 0.01,
            depth_smoothness_weight: 0.1,
            ..RefineOptions::default()
        };
        let photos = Photos::new(views, &[], &options);
        let steps = |count| {
            let mut optimizer = GaussianOptimizer::new(&raw, 1., &options, 0);
            let mut photo_opt = PhotoOpt::new(views, Some(&[[0.; 3]; 4]), 1., &options);
            let _guard = num_threads::lock_exclusive();
            let (args, stopwatch) = (args_of(&photos, &options, count), &mut Stopwatch::default());
            refine(&mut optimizer, &mut photo_opt, &args, stopwatch, |_| true).unwrap();
        };
        let count = |ops: &[RecordedOp], name: &str| ops.iter().filter(|op| op.name == name).count();
        let [two, five] = [2, 5].map(|number| record_ops(|| steps(number)).1);
        let of_a_step = |name: &str| (count(&five, name) - count(&two, name)) as f64 / 3.;
        let cameras = Cameras::single(&views[0].camera);
        let (_, of_a_render) = record_ops(|| render(&gaussians, &cameras, DEFAULT_EPS2D).unwrap());
        // Both losses move the images to the photos' device and move their value back, which counts even on one device.
        let sent = count(&of_a_render, "aten::to.device") + 2 * 3;
        assert_eq!(of_a_step("aten::to.device"), sent as f64);
        for op in WAITING {
            // On the CPU, the backward pass of each loss reads its incoming gradient, to skip a multiplication by 1.
            let expected = if op == "aten::_local_scalar_dense" { 2. } else { 0. };
            assert_eq!(of_a_step(op), expected, "{op}");
        }
        let kernels = (computing(&five) - computing(&two)) / 3;
        assert!((50..=125).contains(&kernels), "{kernels}");
    }
}
