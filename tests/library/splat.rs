//! The splat op, as far as `parity/` doesn't compare it: instruction sets, threads, kernels for GPUs, and invalid input.

use crate::common::{Random, exit_code_of_test, largest_error, relative_error};
use globalsplat::render::cpu::simd_level;
use globalsplat::render::{Cameras, DEFAULT_EPS2D, RenderOutput, render};
use globalsplat::scene::Gaussians;
use std::collections::BTreeMap;
use std::path::Path;
use tch::{Device, Kind, Tensor};

/// Returns Gaussians in front of the cameras of [`cameras`], with sizes and opacities typical of a trained scene, uniformly
/// random rotations and SH of `degree`.
fn gaussians(scenes: i64, count: i64, degree: i64, kind: Kind, seed: u64) -> Gaussians {
    let mut random = Random::new(seed);
    let means = random.uniform(&[scenes, count, 3]) * 2. - 1.;
    Gaussians {
        means: means + Tensor::from_slice(&[0f32, 0., 2.2]),
        scales: (random.uniform(&[scenes, count, 3]) * 2. - 3.5).exp(),
        quaternions: random.symmetric(&[scenes, count, 4]),
        opacities: random.uniform(&[scenes, count]) * 0.9 + 0.05,
        sh: random.symmetric(&[scenes, count, (degree + 1) * (degree + 1), 3]) * 0.5,
        antialiased: false,
    }
    .map(|t| t.to_kind(kind))
}

/// Returns cameras side by side, the last ones turned inwards.
fn cameras(scenes: i64, count: i64, width: i64, height: i64, kind: Kind) -> Cameras {
    let (mut w2c, mut intrinsics) = (vec![], vec![]);
    for i in 0..scenes * count {
        let (sin, cos) = (0.12 * i as f64).sin_cos();
        w2c.extend([cos, 0., sin, -0.1 * i as f64, 0., 1., 0., 0.05, -sin, 0., cos, 0.1, 0., 0., 0., 1.]);
        let (focal, cx, cy) = (0.9 * width as f64, width as f64 / 2. + 0.3, height as f64 / 2.);
        intrinsics.extend([focal, 0., cx, 0., focal * 1.1, cy, 0., 0., 1.]);
    }
    Cameras {
        w2c: Tensor::from_slice(&w2c).view([scenes, count, 4, 4]).to_kind(kind),
        intrinsics: Tensor::from_slice(&intrinsics).view([scenes, count, 3, 3]).to_kind(kind),
        width,
        height,
    }
}

/// Returns a scalar that weighs every pixel of every image differently, the same on every call.
fn objective(p: &RenderOutput) -> Tensor {
    let weigh = |t: &Tensor, phase: f64| {
        let n = t.numel() as i64;
        let weights = (Tensor::arange(n, (Kind::Double, Device::Cpu)) * 0.7 + phase).sin().view_as(t);
        (t.to_kind(Kind::Double) * weights).sum(Kind::Double)
    };
    weigh(&p.rgb, 0.1) + weigh(&p.alpha, 0.9) + weigh(&p.depth, 1.7)
}

/// Returns `g` with quaternions of lengths from 1e-30 to 1e30, by powers of two: the rotations are bit-identical.
fn of_any_length(g: &Gaussians) -> Gaussians {
    let count = g.count();
    let exponents =
        Tensor::from_slice(&[0f64, -66., 66., -100., 100.]).repeat([count / 5 + 1]).narrow(0, 0, count);
    let powers = exponents.exp2().view([1, count, 1]).to_kind(g.quaternions.kind());
    Gaussians { quaternions: &g.quaternions * powers, ..g.map(Tensor::shallow_clone) }
}

/// Returns the rendered images, and the gradients of [`objective`].
fn differentiated(g: &Gaussians, c: &Cameras) -> (RenderOutput, [(&'static str, Tensor); 5]) {
    let g = g.map(|t| t.detach().copy().set_requires_grad(true));
    let p = render(&g, c, DEFAULT_EPS2D).expect("shapes that fit");
    objective(&p).backward();
    let gradients = [
        ("means", g.means.grad()),
        ("scales", g.scales.grad()),
        ("quaternions", g.quaternions.grad()),
        ("opacities", g.opacities.grad()),
        ("sh", g.sh.grad()),
    ];
    (p, gradients)
}

#[test]
fn gaussians_without_a_rotation_are_dropped() {
    for kind in [Kind::Float, Kind::Double] {
        let (subnormal, infinite) = (if kind == Kind::Float { 1e-40 } else { 1e-310 }, f64::INFINITY);
        let parts = [
            [0.; 4],
            [f64::NAN, 1., 0., 0.],
            [1., 0., 0., -infinite],
            [infinite; 4],
            [subnormal, 0., 0., 0.],
        ];
        let (g, c) = (gaussians(1, 60, 1, kind, 15), cameras(1, 2, 61, 43, kind));
        let special = Tensor::from_slice2(&parts).to_kind(kind);
        g.quaternions.select(0, 0).narrow(0, 0, parts.len() as i64).copy_(&special);
        // Scales of 0 are valid: the low-pass filter widens these Gaussians.
        let _ = g.scales.select(0, 0).narrow(0, 30, 3).zero_();
        let (p, gradients) = differentiated(&g, &c);
        let without = g.map(|t| t.narrow(1, parts.len() as i64, 60 - parts.len() as i64));
        let (expected, _) = differentiated(&without, &c);
        assert!(
            p.rgb.equal(&expected.rgb) && p.alpha.equal(&expected.alpha) && p.depth.equal(&expected.depth)
        );
        for (name, gradient) in &gradients {
            assert_eq!(gradient.isfinite().all().int64_value(&[]), 1, "{name}");
            let of_dropped = gradient.narrow(1, 0, parts.len() as i64).abs().max().double_value(&[]);
            assert_eq!(of_dropped, 0., "{kind:?}: {name}");
        }
    }
}

/// Environment variable that names the file to which a repeated test saves its tensors.
const OUT: &str = "GLOBALSPLAT_TEST_OUT";
/// Exit code of a repeated test on a machine without the instruction set.
const UNSUPPORTED: i32 = 77;

/// Repeats `test` with each of `values` of the environment variable `variable`, which a process reads once. Returns the tensors that it
/// saves to `OUT`, with their value; a value that this machine doesn't support is left out.
fn repeat_with<'a>(
    test: &str,
    variable: &str,
    values: &[&'a str],
) -> Vec<(&'a str, BTreeMap<String, Tensor>)> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut answers = vec![];
    for &value in values {
        let out = folder.path().join(value);
        match exit_code_of_test(test, &[(variable, Path::new(value)), (OUT, &out)]) {
            Some(0) => {
                let tensors = Tensor::read_safetensors(&out).expect("what was written");
                answers.push((value, tensors.into_iter().collect()));
            }
            code => assert_eq!(code, Some(UNSUPPORTED), "{value}"),
        }
    }
    answers
}

/// Returns the rendered images and the gradients of [`objective`], by name.
fn tensors(g: &Gaussians, c: &Cameras) -> Vec<(&'static str, Tensor)> {
    let c = Cameras {
        w2c: c.w2c.detach().set_requires_grad(true),
        intrinsics: c.intrinsics.shallow_clone(),
        ..*c
    };
    let (p, gradients) = differentiated(g, &c);
    let images = [("rgb", p.rgb), ("alpha", p.alpha), ("depth", p.depth), ("w2c", c.w2c.grad())];
    images.into_iter().chain(gradients).collect()
}

#[test]
fn instruction_sets_agree() {
    if let Some(out) = std::env::var_os(OUT) {
        if simd_level().is_err() {
            std::process::exit(UNSUPPORTED);
        }
        let g = gaussians(1, 4096, 3, Kind::Float, 4);
        // Small Gaussians: with many of them behind each pixel, gradients would magnify the rounding.
        let g = Gaussians { scales: &g.scales * 0.1, ..of_any_length(&g) };
        let tensors = tensors(&g, &cameras(1, 12, 128, 128, Kind::Float));
        return Tensor::write_safetensors(&tensors, out).expect("a writable file");
    }
    let levels = ["avx512", "avx2", "neon", "portable"];
    let answers = repeat_with("splat::instruction_sets_agree", "GLOBALSPLAT_SIMD", &levels);
    // Other processors have only one instruction set.
    if answers.len() < 2 && cfg!(target_arch = "x86_64") {
        crate::common::skip("a second instruction set", "the processor has none but the portable one");
    }
    let (_, first) = answers.first().expect("an instruction set");
    for (level, tensors) in &answers[1..] {
        for (name, expected) in first {
            let error =
                largest_error(&tensors[name], expected) / expected.abs().max().double_value(&[]).max(1.);
            assert!(error <= 1e-5, "{level}: {name} differs by {error:.1e}");
        }
    }
}

/// Compares the CUDA kernels, emulated on the CPU, with the CPU's own: images bit by bit, gradients within rounding.
///
/// If the CPU has fused multiply-add, gradients differ only by the order of summation. `portable` rounds a product and a sum
/// separately (`add_product` in csrc/kernels/simd.h). Both kernels compute the loss behind a splat as the loss of the whole
/// pixel less the part in front of it, a difference that magnifies rounding. The two float32 gradients then differ by about as
/// much as each differs from the float64 gradient, and this distance is the bound.
#[test]
fn kernels_for_gpus_draw_the_cpus_bits() {
    let answer = |kind: Kind| {
        let g = of_any_length(&gaussians(2, 300, 3, Kind::Float, 21)).map(|t| t.to_kind(kind));
        let c = cameras(2, 1, 45, 35, Kind::Float);
        tensors(&g, &Cameras { w2c: c.w2c.to_kind(kind), intrinsics: c.intrinsics.to_kind(kind), ..c })
    };
    let was_cpu = || globalsplat::render::cpu::stage_times().blend_backward > 0.;
    if let Some(out) = std::env::var_os(OUT) {
        Tensor::write_safetensors(&answer(Kind::Float), out).expect("a writable file");
        assert!(!was_cpu());
        return;
    }
    let expected = answer(Kind::Float);
    assert!(was_cpu());
    let has_fused_gradients = simd_level().expect("an instruction set") != "portable";
    // The second order renders the tiles in another order.
    let test = "splat::kernels_for_gpus_draw_the_cpus_bits";
    let answers = repeat_with(test, "GLOBALSPLAT_CUDA_ON_CPU", &["1", "2"]);
    for ((name, expected), (_, exact)) in expected.iter().zip(&answer(Kind::Double)) {
        let [found, other] = [&answers[0].1[*name], &answers[1].1[*name]];
        assert!(found.equal(other), "{name} depends on the order");
        let rounding = relative_error(expected, exact);
        if ["rgb", "alpha", "depth"].contains(name) {
            assert!(found.equal(expected), "{name}");
            // If a pixel blended other Gaussians in float64, the distance of the gradients would be large.
            assert!(rounding < 1e-6, "{name}: float64 differs by {rounding:.1e}");
            continue;
        }
        let difference = relative_error(found, expected);
        assert!(
            difference <= rounding,
            "{name}: {difference:.1e} from the CPU's, which is {rounding:.1e} from float64"
        );
        let error = largest_error(found, expected) / expected.abs().max().double_value(&[]);
        assert!(!has_fused_gradients || error < 1e-5, "{name}: {error:.1e}");
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    let run = |threads: i32| {
        tch::set_num_threads(threads);
        tensors(&gaussians(2, 3000, 3, Kind::Float, 9), &cameras(2, 3, 150, 90, Kind::Float))
    };
    let before = tch::get_num_threads();
    let (one, two) = (run(1), run(2));
    tch::set_num_threads(before);
    assert!(one.iter().zip(&two).all(|((_, a), (_, b))| a.equal(b)));
}

#[test]
fn mismatched_shapes_are_refused() {
    let c = cameras(1, 1, 20, 10, Kind::Float);
    let good = || gaussians(1, 4, 1, Kind::Float, 13);
    let zeros = |shape: &[i64]| Tensor::zeros(shape, (Kind::Float, Device::Cpu));
    for (bad, found) in [
        (Gaussians { scales: zeros(&[1, 3, 3]), ..good() }, "scales has shape"),
        (Gaussians { sh: zeros(&[1, 4, 5, 3]), ..good() }, "5 basis functions"),
    ] {
        let error = render(&bad, &c, DEFAULT_EPS2D).unwrap_err().to_string();
        assert!(error.contains(found), "{error}");
    }
}
