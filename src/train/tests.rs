//! Tests that all ways to compute a step give the same gradient, and that a step of several ranks equals that of a single one.

use super::schedule::subsets;
use super::{StepReport, Trainer};
use crate::config::{Config, TrainConfig};
use crate::data::{Batch, Capture, LoadedScene};
use crate::device::{Stopwatch, num_threads};
use crate::distributed::ProcessGroup;
use crate::distributed::tests::{require_gloo, run_on_ranks};
use crate::loss::{
    LossConfig, Losses, PerceptualBackbone, PerceptualKind, PerceptualNetwork, StepFraction, Term, losses,
};
use crate::model::{ModelConfig, Precision, Stage, Streams};
use crate::render::{DEFAULT_EPS2D, render};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat4, DVec3};
use globalsplat_csrc::runtime::{count_device_copies, record_ops};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::sync::Arc;
use tch::{Device, Kind, Tensor, nn};

const SIZE: u32 = 32;
const STAGE: Stage = Stage { index: 2, mix: 0.4 };

/// Returns a sample of three scenes.
fn sample() -> Batch {
    Batch::from_scenes(&scenes(3), Device::Cpu).unwrap()
}

/// Returns scenes of five context and two target views, with noise as images.
fn scenes(count: usize) -> Vec<LoadedScene> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let intrinsics = Intrinsics { fx: 30., fy: 30., cx: 16., cy: 16. };
    let scene = |number: usize| {
        let at = |view: usize| DVec3::new(0.1 * view as f64 - 0.2 + 0.3 * number as f64, 0., 0.);
        let camera =
            |view| Camera { intrinsics, c2w: DMat4::from_translation(at(view)), width: SIZE, height: SIZE };
        LoadedScene {
            name: format!("noise_{number}"),
            images: (0..5 * 3 * SIZE * SIZE).map(|_| random.random()).collect(),
            masks: None,
            depths: None,
            size: [SIZE, SIZE].into(),
            cameras: (0..5).map(camera).collect(),
            context: vec![0, 1, 2, 3, 4],
            target: vec![1, 3],
            far: 10. + number as f64,
        }
    };
    (0..count).map(scene).collect()
}

/// Returns the scenes of [`sample`], with the left third of the images of two of them masked out, at half weight next to it, and set to
/// `value`.
fn masked_scenes(value: u8) -> Vec<LoadedScene> {
    let mut scenes = scenes(3);
    for scene in &mut scenes[..2] {
        let side = SIZE as usize;
        let weight = |pixel: usize| match pixel % side {
            ..10 => 0,
            10 => 127,
            _ => 255,
        };
        scene
            .images
            .iter_mut()
            .enumerate()
            .filter(|(i, _)| weight(*i) == 0)
            .for_each(|(_, byte)| *byte = value);
        scene.masks = Some((0..5 * side * side).map(weight).collect());
    }
    scenes
}

fn config(model: ModelConfig, train: TrainConfig) -> Config {
    // Factors that let every term of the loss contribute.
    let loss = LossConfig {
        perceptual: PerceptualKind::None,
        consistency_alpha: 0.5,
        consistency_depth: 0.5,
        frustum: 0.5,
        decoder_opacity: true,
        ..Default::default()
    };
    Config { model, train, loss, ..Default::default() }
}

fn small() -> ModelConfig {
    ModelConfig {
        latents: 12,
        width: 32,
        rgb_width: 24,
        ray_width: 16,
        rounds: 2,
        self_attention_blocks: 1,
        heads: 4,
        candidates: 4,
        ..Default::default()
    }
}

/// Loss and gradients of a step.
type Step = (Losses<f64>, BTreeMap<String, Tensor>);

/// Computes the loss and gradients of a step with the trainer.
fn gradients(config: &Config, sample: &Batch) -> Step {
    of_model(config, |trainer| {
        numbers(&trainer.gradients(sample, STAGE, &mut Stopwatch::default()).expect("a step"))
    })
}

/// Converts packed losses to numbers.
fn numbers(losses: &Tensor) -> Losses<f64> {
    Losses::unpacked(&Vec::try_from(losses).expect("float64").try_into().expect("all terms"))
}

/// Returns the losses that `compute` returns for a model that is [`perturbed_trainer`], and the gradients that it leaves there.
fn of_model(config: &Config, compute: impl FnOnce(&mut Trainer) -> Losses<f64>) -> Step {
    let mut trainer = perturbed_trainer(config);
    let values = compute(&mut trainer);
    let variables = trained(&trainer);
    (values, variables.into_iter().map(|(name, variable)| (name, variable.grad().copy())).collect())
}

/// Returns a trainer's trained variables, by name.
fn trained(trainer: &Trainer) -> BTreeMap<String, Tensor> {
    let mut variables: BTreeMap<String, Tensor> = trainer.vs.variables().into_iter().collect();
    variables.retain(|_, variable| variable.requires_grad());
    variables
}

/// Returns a trainer whose weights are far enough from their initial values for all modules to matter. They are always the same.
fn perturbed_trainer(config: &Config) -> Trainer {
    let scenes = Arc::new(Vec::<Capture>::new());
    let mut trainer = Trainer::new(config, scenes, Device::Cpu).expect("a model");
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let mut variables = trained(&trainer);
    for (name, variable) in &mut variables {
        let noise: Vec<f32> = (0..variable.numel()).map(|_| random.random_range(-0.15..0.15)).collect();
        let noise = Tensor::from_slice(&noise).view(variable.size().as_slice());
        // All values that were drawn for the initial model are replaced, because other tests draw from the same generator.
        let is_norm = name.ends_with(".weight") && noise.dim() == 1;
        let value = if is_norm { noise + 1. } else { noise };
        tch::no_grad(|| variable.copy_(&value));
    }
    // Some Gaussians outside of all frusta. Opacities are initially 0.007, which would be almost invisible.
    let _ = tch::no_grad(|| {
        variables["gaussian_decoder.geo_pos_readout.bias"].shallow_clone().g_mul_scalar_(20.)
    });
    // The weights of the perceptual network are in a file that may be missing in tests, so they are drawn here.
    let perceptual = nn::VarStore::new(Device::Cpu);
    trainer.perceptual = Some(PerceptualNetwork::new(&perceptual.root(), PerceptualBackbone::Vgg19));
    for (name, mut weight) in perceptual.variables().into_iter().collect::<BTreeMap<_, _>>() {
        if name.ends_with(".weight") {
            let inputs = weight.numel() as f64 / weight.size()[0] as f64;
            let bound = (6. / inputs).sqrt() as f32;
            let noise: Vec<f32> = (0..weight.numel()).map(|_| random.random_range(-bound..bound)).collect();
            tch::no_grad(|| weight.copy_(&Tensor::from_slice(&noise).view(weight.size().as_slice())));
        }
        let _ = weight.set_requires_grad(false);
    }
    let mut opacities = variables["gaussian_decoder.geo_param_readout.bias"].view([-1, 10]).select(1, 9);
    let _ = tch::no_grad(|| opacities.g_add_scalar_(4.));
    trainer
}

/// Asserts that losses and gradients equal those that were computed in another way.
fn assert_same(found: &Step, expected: &Step, tolerance: f64) {
    let ((loss, found), (expected_loss, expected)) = (found, expected);
    let terms = Term::ALL.map(|term| (term.name(), loss[term], expected_loss[term]));
    for (name, found, expected) in terms.into_iter().chain([("total", loss.total, expected_loss.total)]) {
        assert!(expected > 0., "{name} counts");
        assert!((found / expected - 1.).abs() <= tolerance, "{name}: {found}, expected {expected}");
    }
    assert_same_gradients(found, expected, tolerance);
}

/// Asserts that gradients are equal. Errors of key biases, whose gradient is zero in exact arithmetic, are relative to the largest
/// gradient.
fn assert_same_gradients(
    found: &BTreeMap<String, Tensor>,
    expected: &BTreeMap<String, Tensor>,
    tolerance: f64,
) {
    let norm = |t: &Tensor| t.to_kind(Kind::Double).norm().double_value(&[]);
    let largest = expected.values().map(norm).fold(0., f64::max);
    for (name, expected) in expected {
        let scale = if name.ends_with("mem_k.bias") { largest } else { norm(expected) };
        assert!(scale > 0., "{name} has a gradient");
        let error = norm(&(&found[name] - expected)) / scale;
        assert!(error <= tolerance, "{name}: relative error {error:.1e}");
    }
}

#[test]
fn slices_of_a_step_add_up_to_it() {
    for sample in [sample(), Batch::from_scenes(&masked_scenes(0), Device::Cpu).unwrap()] {
        let whole = gradients(&config(small(), TrainConfig::default()), &sample);
        for micro_batch in [1, 2] {
            let sliced = config(small(), TrainConfig { micro_batch, ..Default::default() });
            assert_same(&gradients(&sliced, &sample), &whole, 1e-5);
        }
    }
}

/// A step doesn't depend on the colors of masked pixels, neither of the context nor of the targets.
#[test]
fn masked_pixels_contribute_nothing_to_a_step() {
    let _guard = num_threads::lock_shared();
    let config = config(small(), TrainConfig::default());
    let [black, gray] = [0, 77].map(|value| Batch::from_scenes(&masked_scenes(value), Device::Cpu).unwrap());
    assert!(!black.target.images.equal(&gray.target.images));
    // The features of a photo's pixels beside its mask depend on those under it.
    let of = |sample: &Batch| {
        of_model(&config, |trainer| {
            trainer.perceptual = None;
            numbers(&trainer.gradients(sample, STAGE, &mut Stopwatch::default()).expect("a step"))
        })
    };
    let [(losses_of_black, of_black), (losses_of_gray, of_gray)] = [of(&black), of(&gray)];
    assert_eq!(losses_of_black.total, losses_of_gray.total);
    assert!(of_black == of_gray);
    // Without the masks, it would.
    let unmasked = |sample: &Batch| {
        let mut sample = sample.slice(0, 3);
        (sample.context.masks, sample.target.masks) = (None, None);
        of(&sample).0.total
    };
    assert_ne!(unmasked(&black), unmasked(&gray));
}

/// Parallel slices give the same step every time, in one, two and three slices. Only the mean connects the scenes of this step. In bf16,
/// the gradients of weights are rounded in each slice.
#[test]
fn parallel_slices_make_the_same_step_every_time() {
    let _guard = num_threads::lock_exclusive();
    let sample = sample();
    let threads = tch::get_num_threads();
    for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::Bf16, 1e-2)] {
        let mut config = config(small(), TrainConfig { precision, ..Default::default() });
        config.loss.consistency_depth = 0.;
        let by = |threads: i32| {
            tch::set_num_threads(threads);
            of_model(&config, |trainer| {
                trainer.perceptual = None;
                let mut step = || {
                    let losses =
                        trainer.gradients(&sample, STAGE, &mut Stopwatch::default()).expect("a step");
                    assert_eq!(tch::get_num_threads(), threads);
                    numbers(&losses)
                };
                step();
                // This time, there are gradients to clear.
                let losses = step();
                assert_eq!(trainer.replicas.len() + 1, threads as usize);
                // Three threads can't share four scenes more evenly than two can.
                assert_eq!(trainer.slices_at_once(4), [1, 2, 2][threads as usize - 1]);
                losses
            })
        };
        let (whole_losses, whole) = by(1);
        for threads in [2, 3] {
            let [(losses, gradients), again] = [(); 2].map(|()| by(threads));
            assert!((losses.total / whole_losses.total - 1.).abs() < tolerance, "{}", losses.total);
            assert_same_gradients(&gradients, &whole, tolerance);
            assert!(losses.total == again.0.total && gradients == again.1, "other bits the second time");
        }
    }
    tch::set_num_threads(threads);
}

/// A step in parts, with rounds that are kept or recomputed, has the gradients of one backward pass through the whole network.
#[test]
fn a_step_in_parts_matches_one_backward_pass() {
    let sample = sample();
    for streams in [Streams::Dual, Streams::Single] {
        let with = |checkpoint_rounds| {
            config(
                ModelConfig { streams, ..small() },
                TrainConfig { checkpoint_rounds, ..Default::default() },
            )
        };
        let whole = of_model(&with(false), |trainer| {
            let sample = sample.paired(&subsets(sample.context_views(), 0));
            let decoded = trainer.model.forward(&sample.context.model_input(), STAGE);
            let rendered =
                render(&decoded.gaussians, &sample.target.cameras(), DEFAULT_EPS2D).expect("rendered images");
            let (loss, perceptual) = (&trainer.config.loss, trainer.perceptual.as_ref());
            let losses = losses(loss, perceptual, &sample, &decoded, &rendered, &StepFraction::WHOLE);
            losses.total.backward();
            numbers(&losses.packed())
        });
        for checkpoint_rounds in [false, true] {
            assert_same(&gradients(&with(checkpoint_rounds), &sample), &whole, 1e-6);
        }
    }
}

/// The GPU is waited for once in a step, for the losses; rendering moves its images to the device of the Gaussians.
#[test]
fn a_step_makes_only_expected_device_copies() {
    let sample = sample();
    for (micro_batch, checkpoint_rounds, precision) in
        [(0, false, Precision::F32), (2, false, Precision::Bf16), (1, true, Precision::F32)]
    {
        let train = TrainConfig { micro_batch, checkpoint_rounds, precision, ..Default::default() };
        of_model(&config(small(), train), |trainer| {
            let (decoded, ops) = record_ops(|| trainer.model.forward(&sample.context.model_input(), STAGE));
            assert_eq!(count_device_copies(&ops), 0, "an inference");
            let cameras = sample.target.cameras();
            let (_, ops) = record_ops(|| render(&decoded.gaussians, &cameras, DEFAULT_EPS2D));
            let of_rendering = count_device_copies(&ops);
            let (report, ops) =
                record_ops(|| trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true));
            let renders = match micro_batch {
                0 => 1,
                // Depths are compared over all slices, so their pixels are counted in an earlier pass.
                count => 2 * sample.scenes().div_ceil(count),
            };
            assert_eq!(count_device_copies(&ops), 1 + renders * of_rendering, "slices of {micro_batch}");
            report.expect("a step").losses
        });
    }
}

/// Number of scenes in a step of all ranks together.
const SCENES: usize = 6;
const STEPS: usize = 10;
/// Variable of the model that no step changes.
const FROZEN_VARIABLE: &str = "gaussian_decoder.patch_center_bias";

fn training(train: TrainConfig) -> Config {
    // There is no warm-up, so that the learning rate is about the same in all steps.
    config(small(), TrainConfig { steps: 100, warmup: 0., learning_rate: 3e-5, ..train })
}

/// Trains a trainer for some steps on its rank's share of `scenes`, which `perturb` changes before each step. Returns the trainer and its
/// reports.
fn train_steps(
    config: &Config,
    group: ProcessGroup,
    perturb: impl Fn(usize, &mut [LoadedScene]),
) -> (Trainer, Vec<StepReport>) {
    let (rank, share) = (group.rank(), SCENES / group.world_size());
    let mut trainer = perturbed_trainer(config).with_group(group);
    // L_perc takes most of the time. It is a mean over scenes like L_mse, so the tests don't need it.
    trainer.perceptual = None;
    let step = |step: usize| {
        let mut scenes = scenes(SCENES);
        perturb(step, &mut scenes);
        let sample = Batch::from_scenes(&scenes[rank * share..][..share], Device::Cpu).unwrap();
        trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).expect("a step")
    };
    let reports = (0..STEPS).map(step).collect();
    (trainer, reports)
}

/// Returns copies of the trained weights.
fn weights(trainer: &Trainer) -> BTreeMap<String, Tensor> {
    trained(trainer).into_iter().map(|(name, value)| (name, value.detach().copy())).collect()
}

/// Returns the distance of `a` from `b`, relative to the norm of `b`.
fn distance(a: &Tensor, b: &Tensor) -> f64 {
    ((a - b).norm() / b.norm()).double_value(&[])
}

/// Compares ranks that train with `config` to a trainer that does the same steps alone, with `alone`. Returns the reports of the latter.
fn assert_matches_single_rank(
    ranks: usize,
    config: &Config,
    alone: &Config,
    tolerance: f64,
    perturb: impl Fn(usize, &mut [LoadedScene]) + Copy + Sync,
) -> Vec<StepReport> {
    let _guard = num_threads::lock_shared();
    let start = weights(&perturbed_trainer(config));
    let (alone, expected) = train_steps(alone, ProcessGroup::single(), perturb);
    let alone = weights(&alone);
    let found = run_on_ranks(ranks, |group| {
        let (trainer, reports) = train_steps(config, group, perturb);
        (weights(&trainer), reports)
    });
    for (rank, (weights, reports)) in found.iter().enumerate() {
        for (name, value) in weights {
            assert!(*value == found[0].0[name], "rank {rank} has other bits than the first in {name}");
            // A key's bias adds the same value to all scores of a query, so its gradient is 0.
            if name.ends_with("mem_k.bias") {
                assert!(*value == start[name], "{name} moved");
                continue;
            }
            let (off, moved) = (distance(value, &alone[name]), distance(value, &start[name]));
            assert!(
                off <= tolerance && moved > 1e-4,
                "{name} of {ranks} ranks is off by {off:.1e}, moved by {moved:.1e}"
            );
        }
        for (report, expected) in reports.iter().zip(&expected) {
            assert_eq!((report.step, report.skipped), (expected.step, expected.skipped));
            let numbers = |of: &StepReport| {
                Term::ALL
                    .map(|term| of.losses[term])
                    .into_iter()
                    .chain([of.losses.total, of.gradient_norm])
                    .collect::<Vec<_>>()
            };
            for (found, expected) in numbers(report).into_iter().zip(numbers(expected)) {
                let agree = (found.is_nan() && expected.is_nan())
                    || (found - expected).abs() <= 1e-4 * expected.abs();
                assert!(agree, "{found}, expected {expected}");
            }
        }
    }
    expected
}

/// Several ranks make the step of one up to rounding, however the step is cut into slices. Adam amplifies gradients that are nothing but
/// rounding errors.
#[test]
fn ranks_match_a_single_process() {
    if !require_gloo() {
        return;
    }
    let alone = training(TrainConfig::default());
    for (ranks, train) in [
        (2, TrainConfig { micro_batch: 2, ..Default::default() }),
        // Slices of one scene, with recomputed rounds.
        (3, TrainConfig { micro_batch: 1, checkpoint_rounds: true, ..Default::default() }),
    ] {
        assert_matches_single_rank(ranks, &training(train), &alone, 1e-5, |_, _| {});
    }
}

/// A loss of NaN on one rank skips the step on all ranks, which report the scenes of all.
#[test]
fn a_nan_loss_on_one_rank_skips_the_step_on_all_ranks() {
    if !require_gloo() {
        return;
    }
    let perturb = |step: usize, scenes: &mut [LoadedScene]| {
        if step == 1 {
            // A scene of the last rank.
            scenes[SCENES - 1].far = f64::NAN;
        }
    };
    let with = |micro_batch| training(TrainConfig { micro_batch, ..Default::default() });
    let reports = assert_matches_single_rank(2, &with(0), &with(3), 0., perturb);
    assert!(reports.iter().enumerate().all(|(step, report)| report.skipped == (step == 1)));
    let names = |range: std::ops::Range<usize>| range.map(|i| format!("noise_{i}")).collect::<Vec<_>>();
    let found = run_on_ranks(2, |group| {
        train_steps(&with(0), group, perturb).1.into_iter().map(|report| report.scenes).collect::<Vec<_>>()
    });
    assert!(found.iter().all(|scenes| scenes[1] == names(0..6)), "{found:?}");
    assert_eq!((&found[0][0], &found[1][0]), (&names(0..3), &names(3..6)));
}

/// All ranks take over the state of the first one: weights, moments, step and position in the data.
#[test]
fn broadcast_state_copies_rank_0() {
    if !require_gloo() {
        return;
    }
    let config = training(TrainConfig::default());
    let found = run_on_ranks(2, |group| {
        let mut trainer = perturbed_trainer(&config);
        if group.is_main_process() {
            let sample = Batch::from_scenes(&scenes(1), Device::Cpu).unwrap();
            trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true).expect("a step");
            trainer.samples = 7;
            // Weights from elsewhere may have another value here.
            let _ = trainer.vs.variables()[FROZEN_VARIABLE].shallow_clone().fill_(0.25);
        }
        let mut trainer = trainer.with_group(group);
        trainer.broadcast_state().expect("the first rank");
        let moments: Vec<Tensor> = trainer.optimizer.moments().map(Tensor::copy).collect();
        let variables: BTreeMap<_, _> =
            trainer.vs.variables().into_iter().map(|(name, value)| (name, value.detach().copy())).collect();
        (variables, moments, trainer.optimizer.steps(), trainer.step, trainer.samples)
    });
    let [first, second] = &found[..] else { panic!("two ranks") };
    assert!(first.0.iter().all(|(name, value)| *value == second.0[name]), "weights");
    assert_eq!(second.0[FROZEN_VARIABLE].double_value(&[0, 0, 0]), 0.25);
    assert!(first.1.iter().zip(&second.1).all(|(a, b)| a == b), "moments");
    assert!(
        first.1.iter().any(|moment| moment.abs().max().double_value(&[]) > 0.),
        "moments other than zero"
    );
    assert_eq!((second.2, second.3, second.4), (1, 1, 7));
}
