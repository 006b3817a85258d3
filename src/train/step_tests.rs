//! Tests that all ways to compute a step give the same gradient.

use super::{Trainer, subsets};
use crate::config::{Config, TrainConfig};
use crate::data::{Batch, Capture, LoadTimes, LoadedScene};
use crate::device::{Stopwatch, num_threads};
use crate::loss::{LossConfig, Losses, PerceptualKind, PerceptualLoss, StepFraction, Term, Vgg19, losses};
use crate::model::{ImageTokens, ModelConfig, Precision, Stage, Streams, backward_from_grads, leaf};
use crate::render::{DEFAULT_EPS2D, RenderOutput, render};
use crate::scene::{Camera, Intrinsics};
use glam::{DMat4, DVec3};
use globalsplat_csrc::ops::{
    computing, count_device_copies, record_ops, record_outermost_ops, without_own_linear_layers,
};
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
pub(super) fn scenes(count: usize) -> Vec<LoadedScene> {
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
            times: LoadTimes::default(),
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

pub(super) fn config(model: ModelConfig, train: TrainConfig) -> Config {
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

pub(super) fn small() -> ModelConfig {
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

/// Returns the losses that `compute` returns for a model that is [`far_from_the_start`], and the gradients that it leaves there.
fn of_model(config: &Config, compute: impl FnOnce(&mut Trainer) -> Losses<f64>) -> Step {
    let mut trainer = far_from_the_start(config);
    let values = compute(&mut trainer);
    let variables = trained(&trainer);
    (values, variables.into_iter().map(|(name, variable)| (name, variable.grad().copy())).collect())
}

/// Returns a trainer's trained variables, by name.
pub(super) fn trained(trainer: &Trainer) -> BTreeMap<String, Tensor> {
    let mut variables: BTreeMap<String, Tensor> = trainer.vs.variables().into_iter().collect();
    variables.retain(|_, variable| variable.requires_grad());
    variables
}

/// Returns a trainer whose weights are far enough from their initial values for all modules to matter. They are always the same.
pub(super) fn far_from_the_start(config: &Config) -> Trainer {
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
    trainer.perceptual = Some(PerceptualLoss::Vgg19(Vgg19::new(&perceptual.root())));
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

/// A step doesn't depend on the colours of masked pixels, neither of the context nor of the targets, and the loss has no gradient there.
#[test]
fn masked_pixels_contribute_nothing_to_a_step() {
    let _guard = num_threads::keep();
    let config = config(small(), TrainConfig::default());
    let [black, grey] = [0, 77].map(|value| Batch::from_scenes(&masked_scenes(value), Device::Cpu).unwrap());
    assert!(!black.target.images.equal(&grey.target.images));
    // The features of a photo's pixels beside its mask depend on those under it.
    let of = |sample: &Batch| {
        of_model(&config, |trainer| {
            trainer.perceptual = None;
            numbers(&trainer.gradients(sample, STAGE, &mut Stopwatch::default()).expect("a step"))
        })
    };
    let [(losses_of_black, of_black), (losses_of_grey, of_grey)] = [of(&black), of(&grey)];
    assert_eq!(losses_of_black.total, losses_of_grey.total);
    assert!(of_black == of_grey);
    // Without the masks, it would.
    let unmasked = |sample: &Batch| {
        let mut sample = sample.slice(0, 3);
        (sample.context.masks, sample.target.masks) = (None, None);
        of(&sample).0.total
    };
    assert_ne!(unmasked(&black), unmasked(&grey));

    let trainer = far_from_the_start(&config);
    let sample = black.paired(&subsets(black.context_views(), 0));
    let decoded = tch::no_grad(|| trainer.model.forward(&sample.context.model_input(), STAGE));
    let RenderOutput { rgb, alpha, depth } =
        render(&decoded.gaussians, &sample.target.cameras(), DEFAULT_EPS2D).expect("pictures");
    let rendered = RenderOutput { rgb: leaf(&rgb), alpha: leaf(&alpha), depth: leaf(&depth) };
    let perceptual = trainer.perceptual.as_ref();
    losses(&config.loss, perceptual, &sample, &decoded, &rendered, &StepFraction::WHOLE).total.backward();
    for (name, leaf) in [("rgb", &rendered.rgb), ("alpha", &rendered.alpha), ("depth", &rendered.depth)] {
        let largest = |scene: i64, column: i64| {
            leaf.grad().select(0, scene).narrow(-1, column, 10).abs().max().double_value(&[])
        };
        for scene in [0, 1, 3, 4] {
            assert_eq!(largest(scene, 0), 0., "{name} of scene {scene}");
            assert!(largest(scene, 12) > 0., "{name} of scene {scene}");
        }
        // This scene has no mask.
        assert!(largest(2, 0) > 0., "{name}");
    }
}

/// Parallel slices give the same step every time, in one, two and three slices. Only the mean connects the scenes of this step. In bf16,
/// the gradients of weights are rounded in each slice.
#[test]
fn parallel_slices_make_the_same_step_every_time() {
    let _guard = num_threads::change();
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

#[test]
fn recomputed_rounds_give_the_same_gradients() {
    let sample = sample();
    for streams in [Streams::Dual, Streams::Single] {
        let model = ModelConfig { streams, ..small() };
        let [kept, again] = [false, true].map(|checkpoint_rounds| {
            gradients(
                &config(model.clone(), TrainConfig { checkpoint_rounds, ..Default::default() }),
                &sample,
            )
        });
        assert_same(&again, &kept, 1e-6);
    }
}

#[test]
fn a_step_in_parts_matches_one_backward_pass() {
    let sample = sample();
    for streams in [Streams::Dual, Streams::Single] {
        let config = config(ModelConfig { streams, ..small() }, TrainConfig::default());
        let plain = of_model(&config, |trainer| {
            let sample = sample.paired(&subsets(sample.context_views(), 0));
            let decoded = trainer.model.forward(&sample.context.model_input(), STAGE);
            let pictures =
                render(&decoded.gaussians, &sample.target.cameras(), DEFAULT_EPS2D).expect("pictures");
            let perceptual = trainer.perceptual.as_ref();
            let losses = losses(&config.loss, perceptual, &sample, &decoded, &pictures, &StepFraction::WHOLE);
            losses.total.backward();
            numbers(&losses.packed())
        });
        assert_same(&gradients(&config, &sample), &plain, 1e-6);
    }
}

#[test]
fn the_network_of_l_perc_has_the_model_s_precision() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("vgg19.safetensors");
    let vs = nn::VarStore::new(Device::Cpu);
    Vgg19::new(&vs.root());
    vs.save(&file).expect("weights");
    for (precision, kind) in [(Precision::F32, Kind::Float), (Precision::Bf16, Kind::BFloat16)] {
        let mut config = config(small(), TrainConfig { precision, ..Default::default() });
        config.loss.perceptual = PerceptualKind::Vgg19;
        config.loss.perceptual_weights = file.display().to_string();
        let scenes = Arc::new(Vec::<Capture>::new());
        let trainer = Trainer::new(&config, scenes, Device::Cpu).expect("a trainer");
        let Some(PerceptualLoss::Vgg19(network)) = trainer.perceptual else { panic!("a network") };
        let features = network.features(&Tensor::zeros([1, 3, 16, 16], (Kind::Float, Device::Cpu)));
        // The image itself is compared in float32.
        let kinds: Vec<Kind> = features.iter().map(Tensor::kind).collect();
        assert_eq!(kinds, [Kind::Float, kind, kind, kind, kind, kind]);
        assert_eq!(network.compare(&features, &features).kind(), Kind::Float);
        let side_by_side = features[1..].iter().all(|layer| layer.stride()[1] == 1);
        assert_eq!(side_by_side, precision == Precision::Bf16, "a pixel's channels");
    }
}

/// A step launches few kernels. Most are libtorch's ops, forward and backward: those of the main model's layers, of all losses without
/// L_perc's network, and of the tokens. In addition, there are nine kernels of the rasterizer, and a few of the optimizer.
#[test]
fn a_step_takes_few_kernels() {
    // A narrow model, in float64 and with an odd number of heads, as in the test of a pass of the model.
    let model =
        ModelConfig { latents: 16, width: 24, heads: 3, rgb_width: 16, ray_width: 8, ..Default::default() };
    let mut trainer = far_from_the_start(&config(model, TrainConfig::default()));
    let (network, sample) = (&trainer.model, Batch::from_scenes(&scenes(2), Device::Cpu).unwrap());
    let sample = Batch { paired: true, ..sample };
    let with_gradient = |t: &Tensor| {
        let leaf = leaf(t);
        leaf.sum(leaf.kind()).backward();
        leaf
    };
    let (tokens, forward) = record_outermost_ops(|| network.tokens(&sample.context.model_input(), None));
    let leaf_of_tokens = with_gradient(&tokens.centered);
    let (_, backward) = record_outermost_ops(|| backward_from_grads(&[(&tokens.centered, &leaf_of_tokens)]));
    // Two layers, forward and for the gradients of their weights.
    let of_tokens = computing(&without_own_linear_layers([forward, backward].concat())) + 2 * 2;

    let decoded = network.decode(&network.encode(&tokens), None, STAGE).map(leaf);
    let cameras = sample.target.cameras();
    let pictures = render(&decoded.gaussians, &cameras, DEFAULT_EPS2D).expect("pictures");
    let (_, of_losses) = record_outermost_ops(|| {
        losses(&trainer.config.loss, None, &sample, &decoded, &pictures, &StepFraction::WHOLE)
            .total
            .backward();
    });

    trainer.vs.double();
    let [centered, mean] = [tokens.centered, tokens.mean].map(|t| t.to_kind(Kind::Double));
    let tokens = ImageTokens { centered: leaf(&centered), mean };
    let (decoded, forward) = record_outermost_ops(|| network.decode(&network.encode(&tokens), None, STAGE));
    let leaves = decoded.map(with_gradient);
    let (_, backward) = record_outermost_ops(|| backward_from_grads(&decoded.zip_tensors(&leaves)));
    let counts = [of_tokens, computing(&forward), computing(&backward), computing(&of_losses)];
    assert!((1000..=2100).contains(&counts.iter().sum::<usize>()), "{counts:?}");
}

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
            let is_fused = |op: &&String| {
                op.starts_with("aten::_scaled_dot_product_flash_attention") || *op == "globalsplat::attention"
            };
            // Every round of each stream has a cross-attention to the memory and a self-attention among the slots.
            assert_eq!(ops.iter().filter(is_fused).count(), 2 * 2 * 2, "attention");
            let cameras = sample.target.cameras();
            let (pictures, ops) = record_ops(|| render(&decoded.gaussians, &cameras, DEFAULT_EPS2D));
            // Rendering moves the rendered images to the device of the Gaussians.
            let of_pictures = count_device_copies(&ops);
            let pictures = pictures.expect("pictures");
            let perceptual = trainer.perceptual.as_ref();
            let (_, ops) = record_ops(|| {
                losses(&trainer.config.loss, perceptual, &sample, &decoded, &pictures, &StepFraction::WHOLE)
            });
            assert_eq!(count_device_copies(&ops), 0, "the losses");

            let (report, ops) =
                record_ops(|| trainer.train_step(&sample, &mut Stopwatch::default(), &mut || true));
            let renders = match micro_batch {
                0 => 1,
                // Depths are compared over all slices, so their pixels are counted in an earlier pass.
                count => 2 * sample.scenes().div_ceil(count),
            };
            assert_eq!(
                count_device_copies(&ops),
                1 + renders * of_pictures,
                "a step in slices of {micro_batch}"
            );
            report.expect("a step").losses
        });
    }
}
