//! The splat op, compared with finite differences and with a brute-force renderer.

use crate::common::{Random, exit_code_of_test, largest_error};
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
        let focal = 0.9 * width as f64;
        intrinsics.extend([
            focal,
            0.,
            width as f64 / 2. + 0.3,
            0.,
            focal * 1.1,
            height as f64 / 2.,
            0.,
            0.,
            1.,
        ]);
    }
    Cameras {
        w2c: Tensor::from_slice(&w2c).view([scenes, count, 4, 4]).to_kind(kind),
        intrinsics: Tensor::from_slice(&intrinsics).view([scenes, count, 3, 3]).to_kind(kind),
        width,
        height,
    }
}

fn draw(g: &Gaussians, c: &Cameras) -> RenderOutput {
    render(g, c, DEFAULT_EPS2D).expect("shapes that fit")
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

/// Returns copies of [`Gaussians`] that require gradients.
fn leaves(g: &Gaussians) -> Gaussians {
    g.map(|t| t.detach().copy().set_requires_grad(true))
}

fn fields(g: &Gaussians) -> [(&'static str, &Tensor); 5] {
    [
        ("means", &g.means),
        ("scales", &g.scales),
        ("quaternions", &g.quaternions),
        ("opacities", &g.opacities),
        ("sh", &g.sh),
    ]
}

/// Returns `g` with quaternions of lengths from 1e-30 to 1e30, by powers of two: the rotations are bit-identical.
fn of_any_length(g: &Gaussians) -> Gaussians {
    let count = g.count();
    let exponents =
        Tensor::from_slice(&[0f64, -66., 66., -100., 100.]).repeat([count / 5 + 1]).narrow(0, 0, count);
    let powers = exponents.exp2().view([1, count, 1]).to_kind(g.quaternions.kind());
    Gaussians { quaternions: &g.quaternions * powers, ..g.map(Tensor::shallow_clone) }
}

/// Checks that an antialiased Gaussian keeps its integral of opacity · 2π √(det Σ), however small it is, while another one grows by the
/// filter's variance.
#[test]
fn antialiasing_keeps_the_integral_of_a_gaussian() {
    let camera = straight_camera(1, 33, 33);
    let integral = |sigma: f64, antialiased: bool| {
        let number = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).view(shape);
        let gaussian = Gaussians {
            means: number(&[0.; 3], &[1, 1, 3]) + Tensor::from_slice(&[0f32, 0., 1.]),
            scales: number(&[sigma as f32 / 100.; 3], &[1, 1, 3]),
            quaternions: number(&[1., 0., 0., 0.], &[1, 1, 4]),
            opacities: number(&[0.8], &[1, 1]),
            sh: number(&[0.; 3], &[1, 1, 1, 3]),
            antialiased,
        };
        let rendered = render(&gaussian, &camera, 0.3).unwrap();
        rendered.alpha.sum(Kind::Double).double_value(&[]) / (0.8 * 2. * std::f64::consts::PI)
    };
    for sigma in [2f64, 1., 0.5, 0.25] {
        let (kept, grown) = (integral(sigma, true), integral(sigma, false));
        let variance = sigma * sigma;
        // Values of α below 1/255 are cut off.
        assert!((kept / variance - 1.).abs() < 0.05, "σ {sigma}: {kept}");
        assert!((grown / (variance + 0.3) - 1.).abs() < 0.05, "σ {sigma}: {grown}");
    }
}

/// Returns the rendered images, and the gradients of [`objective`].
fn differentiated(g: &Gaussians, c: &Cameras) -> (RenderOutput, [(&'static str, Tensor); 5]) {
    let g = leaves(g);
    let p = draw(&g, c);
    objective(&p).backward();
    (p, fields(&g).map(|(name, leaf)| (name, leaf.grad())))
}

#[test]
fn quaternions_of_any_length_turn_the_same() {
    for (kind, exponents) in
        [(Kind::Float, [-100., -66., 66., 126.]), (Kind::Double, [-1000., -66., 66., 1022.])]
    {
        let (g, c) = (gaussians(1, 300, 2, kind, 14), cameras(1, 2, 61, 43, kind));
        let (expected, gradients) = differentiated(&g, &c);
        assert!(expected.alpha.max().double_value(&[]) > 0.3, "an empty picture proves nothing");
        for exponent in exponents {
            let length = f64::exp2(exponent);
            let scaled = Gaussians { quaternions: &g.quaternions * length, ..g.map(Tensor::shallow_clone) };
            let (p, found) = differentiated(&scaled, &c);
            let pictures =
                [(&p.rgb, &expected.rgb), (&p.alpha, &expected.alpha), (&p.depth, &expected.depth)];
            assert!(pictures.iter().all(|(a, b)| a.equal(b)), "{kind:?}, length {length:e}");
            for ((name, found), (_, expected)) in found.iter().zip(&gradients) {
                // The gradient scales inversely: ∂L/∂(s q) = ∂L/∂q / s.
                let found = if *name == "quaternions" { found * length } else { found.shallow_clone() };
                let error = crate::common::relative_error(&found, expected);
                assert!(error < 1e-6, "{kind:?}, length {length:e}: {name} is off by {error:.1e}");
            }
        }
    }
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

#[test]
fn gradients_match_finite_differences() {
    // Central differences in float64 along random directions, one input at a time and all of its elements at once. The image is
    // discontinuous where some α crosses 1/255: a direction whose difference quotient changes with the step met such a
    // discontinuity and is drawn again.
    const DIRECTIONS: u64 = 4;
    for (degree, seed) in [(0, 1), (1, 2), (2, 3), (3, 4)] {
        let (scenes, views) = (2, 3);
        let base = gaussians(scenes, 40, degree, Kind::Double, seed);
        let c = cameras(scenes, views, 37, 29, Kind::Double);
        let (g, c) = (leaves(&base), Cameras { w2c: c.w2c.set_requires_grad(true), ..c });
        objective(&draw(&g, &c)).backward();
        for (index, (name, leaf)) in fields(&g).into_iter().chain([("w2c", &c.w2c)]).enumerate() {
            let gradient = leaf.grad();
            let (mut compared, mut drawn) = (0, 0);
            while compared < DIRECTIONS {
                assert!(drawn < 4 * DIRECTIONS, "degree {degree} {name}: no direction without a jump");
                let direction = Random::new(1000 * seed + 100 * index as u64 + drawn).symmetric(&leaf.size());
                drawn += 1;
                let quotient = |h: f64| {
                    let at = |step: f64| {
                        let moved = leaf.detach() + &direction * step;
                        let mut g = base.map(Tensor::shallow_clone);
                        let mut c = Cameras {
                            w2c: c.w2c.detach(),
                            intrinsics: c.intrinsics.shallow_clone(),
                            width: c.width,
                            height: c.height,
                        };
                        *[
                            &mut g.means,
                            &mut g.scales,
                            &mut g.quaternions,
                            &mut g.opacities,
                            &mut g.sh,
                            &mut c.w2c,
                        ][index] = moved;
                        objective(&draw(&g, &c)).double_value(&[])
                    };
                    (at(h) - at(-h)) / (2. * h)
                };
                let (numeric, coarse) = (quotient(1e-7), quotient(2e-7));
                if (numeric - coarse).abs() > 1e-3 * numeric.abs().max(1.) {
                    continue;
                }
                let analytic = (&gradient * &direction).sum(Kind::Double).double_value(&[]);
                let error = (analytic - numeric).abs() / numeric.abs().max(1.);
                assert!(error <= 1e-6, "degree {degree} {name}: {analytic} against {numeric}");
                compared += 1;
            }
        }
    }
}

/// Renders by spec 6.2 to 6.4, pixel by pixel over every Gaussian, in float64 and without any culling.
fn brute_force(g: &Gaussians, c: &Cameras) -> RenderOutput {
    let values = |t: &Tensor| Vec::<f64>::try_from(t.to_kind(Kind::Double).flatten(0, -1)).expect("numbers");
    let [means, scales, quaternions, opacities, sh] = fields(g).map(|(_, t)| values(t));
    let (w2c, intrinsics) = (values(&c.w2c), values(&c.intrinsics));
    let (scenes, n, bases) = (g.sh.size()[0] as usize, g.sh.size()[1] as usize, g.sh.size()[2] as usize);
    assert_eq!(bases, 1, "brute force knows degree 0 alone; gradients prove the others");
    let views = c.w2c.size()[1] as usize;
    let (w, h) = (c.width as usize, c.height as usize);
    let (mut rgb, mut alpha, mut depth) = (vec![], vec![], vec![]);
    for scene in 0..scenes {
        for view in 0..views {
            let m = &w2c[(scene * views + view) * 16..][..16];
            let k = &intrinsics[(scene * views + view) * 9..][..9];
            let (fx, fy, cx, cy) = (k[0], k[4], k[2], k[5]);
            let mut seen = vec![];
            for i in scene * n..(scene + 1) * n {
                let t: Vec<f64> = (0..3)
                    .map(|r| (0..3).map(|j| m[4 * r + j] * means[3 * i + j]).sum::<f64>() + m[4 * r + 3])
                    .collect();
                if t[2] <= 0.01 {
                    continue;
                }
                let q = &quaternions[4 * i..][..4];
                let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
                let q = glam::DQuat::from_xyzw(q[1] / norm, q[2] / norm, q[3] / norm, q[0] / norm);
                let world = glam::DMat3::from_quat(q)
                    * glam::DMat3::from_diagonal(glam::DVec3::from_slice(&scales[3 * i..][..3]));
                let view =
                    glam::DMat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
                let (wf, hf) = (w as f64, h as f64);
                let a = (t[0] / t[2]).clamp(-cx / fx - 0.15 * wf / fx, (wf - cx) / fx + 0.15 * wf / fx);
                let b = (t[1] / t[2]).clamp(-cy / fy - 0.15 * hf / fy, (hf - cy) / fy + 0.15 * hf / fy);
                let j = [
                    glam::DVec3::new(fx / t[2], 0., -fx * a / t[2]),
                    glam::DVec3::new(0., fy / t[2], -fy * b / t[2]),
                ];
                let factor = (view * world).transpose();
                let rows = [factor * j[0], factor * j[1]];
                let cov = [
                    rows[0].dot(rows[0]) + DEFAULT_EPS2D,
                    rows[0].dot(rows[1]),
                    rows[1].dot(rows[1]) + DEFAULT_EPS2D,
                ];
                let det = cov[0] * cov[2] - cov[1] * cov[1];
                let color: Vec<f64> =
                    (0..3).map(|ch| (0.28209479177387814 * sh[3 * i + ch] + 0.5).max(0.)).collect();
                let mean = [fx * t[0] / t[2] + cx, fy * t[1] / t[2] + cy];
                seen.push((t[2], mean, [cov[2] / det, -cov[1] / det, cov[0] / det], opacities[i], color));
            }
            seen.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut planes = vec![vec![0f64; w * h]; 3];
            #[expect(clippy::needless_range_loop, reason = "a pixel is more than its place in a plane")]
            for pixel in 0..w * h {
                let (x, y) = ((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5);
                let (mut transmittance, mut z_sum) = (1f64, 0f64);
                for (z, mean, conic, opacity, color) in &seen {
                    let (dx, dy) = (mean[0] - x, mean[1] - y);
                    let sigma = 0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy;
                    let a = (opacity * (-sigma).exp()).min(0.999);
                    if a < 1. / 255. {
                        continue;
                    }
                    if transmittance * (1. - a) <= 1e-4 {
                        break;
                    }
                    let weight = transmittance * a;
                    for channel in 0..3 {
                        planes[channel][pixel] += weight * color[channel];
                    }
                    z_sum += weight * z;
                    transmittance *= 1. - a;
                }
                let a = 1. - transmittance;
                alpha.push(a);
                depth.push(if a > 1e-10 { z_sum / a } else { 0. });
            }
            rgb.extend(planes.concat());
        }
    }
    let (s, v, w, h) = (scenes as i64, views as i64, w as i64, h as i64);
    RenderOutput {
        rgb: Tensor::from_slice(&rgb).view([s, v, 3, h, w]),
        alpha: Tensor::from_slice(&alpha).view([s, v, h, w]),
        depth: Tensor::from_slice(&depth).view([s, v, h, w]),
    }
}

#[test]
fn images_match_brute_force() {
    for (seed, width, height, count) in [(5, 1, 1, 30), (6, 17, 3, 60), (7, 64, 48, 300), (8, 131, 67, 800)] {
        let g = gaussians(2, count, 0, Kind::Double, seed);
        let c = cameras(2, 2, width, height, Kind::Double);
        let (ours, expected) = (draw(&g, &c), brute_force(&g, &c));
        assert!(expected.alpha.max().double_value(&[]) > 0.3, "an empty picture proves nothing");
        assert!(largest_error(&ours.rgb, &expected.rgb) < 1e-9);
        assert!(largest_error(&ours.alpha, &expected.alpha) < 1e-9);
        assert!(largest_error(&ours.depth, &expected.depth) < 1e-9);

        let single = draw(&g.map(|t| t.to_kind(Kind::Float)), &cameras(2, 2, width, height, Kind::Float));
        assert!(largest_error(&single.rgb, &expected.rgb) < 1e-4);
        assert!(largest_error(&single.alpha, &expected.alpha) < 1e-4);
    }
}

/// Returns Gaussians that culling is likely to lose, one per scene: needles at any angle, large and tiny ones, faint ones,
/// centres on the borders of tiles and blocks, and outside the image. The camera is that of [`straight_camera`].
fn lone_gaussians(width: f64, height: f64, seed: u64) -> Gaussians {
    const COUNT: usize = 600;
    let mut random = Random::new(seed);
    let mut number = || random.uniform(&[1]).double_value(&[0]);
    let (mut means, mut scales, mut quaternions, mut opacities) = (vec![], vec![], vec![], vec![]);
    for i in 0..COUNT {
        let (mut x, mut y) = (width * (2. * number() - 0.5), height * (2. * number() - 0.5));
        if i % 3 == 0 {
            (x, y) = (4. * (x / 4.).round(), 4. * (y / 4.).round());
        }
        // Standard deviations in pixels, at depth 1 and focal length 1 pixel · 100.
        let size = [[3., 3.], [60., 0.05], [200., 0.3], [0.02, 0.02], [8., 1.], [300., 40.]][i % 6];
        let opacity = [0.99, 0.5, 1.02 / 255., 0.05, 1., 4. / 255.][(i / 6) % 6];
        let half_turn = std::f64::consts::PI * number() / 2.;
        means.extend([(x - width / 2.) / 100., (y - height / 2.) / 100., 1.]);
        scales.extend([size[0] / 100., size[1] / 100., 1e-4]);
        quaternions.extend([half_turn.cos(), 0., 0., half_turn.sin()]);
        opacities.push(opacity);
    }
    let n = COUNT as i64;
    let tensor = |values: &[f64], shape: &[i64]| Tensor::from_slice(values).view(shape).to_kind(Kind::Float);
    Gaussians {
        means: tensor(&means, &[n, 1, 3]),
        scales: tensor(&scales, &[n, 1, 3]),
        quaternions: tensor(&quaternions, &[n, 1, 4]),
        opacities: tensor(&opacities, &[n, 1]),
        sh: Tensor::zeros([n, 1, 1, 3], (Kind::Float, Device::Cpu)),
        antialiased: false,
    }
}

/// Returns a camera at the origin, looking along z, focal length 100 pixels; one for each of `scenes`.
fn straight_camera(scenes: i64, width: i64, height: i64) -> Cameras {
    let intrinsics = [100., 0., width as f64 / 2., 0., 100., height as f64 / 2., 0., 0., 1.];
    Cameras {
        w2c: Tensor::eye(4, (Kind::Float, Device::Cpu)).repeat([scenes, 1, 1, 1]),
        intrinsics: Tensor::from_slice(&intrinsics)
            .view([3, 3])
            .to_kind(Kind::Float)
            .repeat([scenes, 1, 1, 1]),
        width,
        height,
    }
}

#[test]
fn a_gaussian_is_seen_wherever_it_reaches() {
    // float32 is compared with brute force in float64. They may disagree about a pixel only where α is 1/255 up to rounding.
    let threshold = 1. / 255.;
    for (width, height, seed) in [(96, 80, 14), (33, 50, 15), (16, 16, 16)] {
        let g = lone_gaussians(width as f64, height as f64, seed);
        let c = straight_camera(g.means.size()[0], width, height);
        let ours = draw(&g, &c).alpha.to_kind(Kind::Double);
        let expected = brute_force(&g, &c).alpha;
        assert!((expected.gt(0.)).sum(Kind::Int64).int64_value(&[]) > 10_000, "empty pictures prove nothing");
        let doubtful = expected.maximum(&ours).lt(threshold * (1. + 1e-3));
        let lost = expected.gt(0.).logical_and(&ours.eq(0.)).logical_and(&doubtful.logical_not());
        assert_eq!(lost.sum(Kind::Int64).int64_value(&[]), 0, "{width}×{height}: pixels were lost");
        let error = ((&ours - &expected).abs() / expected.clamp_min(threshold)).masked_fill(&doubtful, 0.);
        let error = error.max().double_value(&[]);
        assert!(error < 2e-3, "{width}×{height}: α is wrong by a share of {error:.1e}");
    }
}

#[test]
fn instruction_sets_agree() {
    // The instruction set is selected once per process: this test runs itself again for every set, to render and save.
    const OUT: &str = "GLOBALSPLAT_TEST_OUT";
    const UNSUPPORTED: i32 = 77;
    if let Some(out) = std::env::var_os(OUT) {
        if globalsplat::render::cpu::simd_level().is_err() {
            std::process::exit(UNSUPPORTED);
        }
        let g = gaussians(1, 16384, 3, Kind::Float, 4);
        // Small Gaussians: with many of them behind each pixel, gradients would magnify the rounding.
        let g = leaves(&Gaussians { scales: &g.scales * 0.1, ..of_any_length(&g) });
        let p = draw(&g, &cameras(1, 12, 256, 256, Kind::Float));
        objective(&p).backward();
        let mut tensors = vec![("rgb", p.rgb), ("alpha", p.alpha), ("depth", p.depth)];
        tensors.extend(fields(&g).map(|(name, leaf)| (name, leaf.grad())));
        return Tensor::write_safetensors(&tensors, out).expect("a writable file");
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut answers = vec![];
    for level in ["avx512", "avx2", "neon", "portable"] {
        let out = folder.path().join(level);
        let variables = [("GLOBALSPLAT_SIMD", Path::new(level)), (OUT, &out)];
        match exit_code_of_test("splat::instruction_sets_agree", &variables) {
            Some(0) => {
                let tensors = Tensor::read_safetensors(&out).expect("what was written");
                answers.push((level, tensors.into_iter().collect::<BTreeMap<_, _>>()));
            }
            code => assert_eq!(code, Some(UNSUPPORTED), "{level}"),
        }
    }
    println!("compared: {:?}", answers.iter().map(|(level, _)| level).collect::<Vec<_>>());
    // Other processors have only one instruction set.
    if answers.len() < 2 && cfg!(target_arch = "x86_64") {
        crate::common::skip("a second instruction set", "the processor has none but the portable one");
    }
    let (_, first) = answers.first().expect("an instruction set");
    for (level, tensors) in &answers[1..] {
        for (name, expected) in first {
            let found = &tensors[name];
            let error = largest_error(found, expected) / expected.abs().max().double_value(&[]).max(1.);
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
    // An environment variable selects the kernels: this test runs itself again, to render and save.
    const OUT: &str = "GLOBALSPLAT_TEST_OUT";
    let answer = |kind: Kind| {
        let g = of_any_length(&gaussians(2, 700, 3, Kind::Float, 21)).map(|t| t.to_kind(kind));
        let (g, c) = (leaves(&g), cameras(2, 2, 75, 50, Kind::Float));
        let w2c = c.w2c.to_kind(kind).set_requires_grad(true);
        let c = Cameras { w2c, intrinsics: c.intrinsics.to_kind(kind), ..c };
        let p = draw(&g, &c);
        objective(&p).backward();
        let drawn = [("rgb", p.rgb), ("alpha", p.alpha), ("depth", p.depth)];
        let gradients = fields(&g).into_iter().chain([("w2c", &c.w2c)]).map(|(name, t)| (name, t.grad()));
        drawn.into_iter().chain(gradients).collect::<Vec<_>>()
    };
    let was_cpu = || globalsplat::render::cpu::stage_times().blend_backward > 0.;
    if let Some(out) = std::env::var_os(OUT) {
        Tensor::write_safetensors(&answer(Kind::Float), out).expect("a writable file");
        assert!(!was_cpu());
        return;
    }
    let expected = answer(Kind::Float);
    assert!(was_cpu());
    let exact = answer(Kind::Double);
    let has_fused_gradients =
        globalsplat::render::cpu::simd_level().expect("an instruction set") != "portable";
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut answers = vec![];
    for order in ["1", "2"] {
        let out = folder.path().join(order);
        let variables = [("GLOBALSPLAT_CUDA_ON_CPU", Path::new(order)), (OUT, &out)];
        assert_eq!(exit_code_of_test("splat::kernels_for_gpus_draw_the_cpus_bits", &variables), Some(0));
        let tensors = Tensor::read_safetensors(&out).expect("what was written");
        answers.push(tensors.into_iter().collect::<BTreeMap<_, _>>());
    }
    for (place, ((name, expected), (_, exact))) in expected.iter().zip(&exact).enumerate() {
        let [found, other] = [&answers[0][*name], &answers[1][*name]];
        assert!(found.equal(other), "{name} depends on the order");
        let rounding = crate::common::relative_error(expected, exact);
        let is_picture = place < 3;
        if is_picture {
            assert!(found.equal(expected), "{name}");
            // If a pixel blended other Gaussians in float64, the distance of the gradients would be large.
            assert!(rounding < 1e-6, "{name}: float64 differs by {rounding:.1e}");
            continue;
        }
        let difference = crate::common::relative_error(found, expected);
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
        let g = leaves(&gaussians(2, 3000, 3, Kind::Float, 9));
        let c = cameras(2, 3, 150, 90, Kind::Float);
        let c = Cameras { w2c: c.w2c.set_requires_grad(true), ..c };
        let p = draw(&g, &c);
        objective(&p).backward();
        let gradients: Vec<Tensor> =
            fields(&g).into_iter().map(|(_, leaf)| leaf).chain([&c.w2c]).map(Tensor::grad).collect();
        (p, gradients)
    };
    let before = tch::get_num_threads();
    let ((p, gradients), (q, others)) = (run(1), run(2));
    tch::set_num_threads(before);
    assert!(p.rgb.equal(&q.rgb) && p.alpha.equal(&q.alpha) && p.depth.equal(&q.depth));
    for (a, b) in gradients.iter().zip(&others) {
        assert!(a.equal(b));
    }
}

#[test]
fn float32_gradients_are_near_those_of_float64() {
    let run = |kind: Kind| {
        let g = leaves(&gaussians(1, 500, 3, Kind::Double, 10).map(|t| t.to_kind(kind)));
        objective(&draw(&g, &cameras(1, 3, 80, 60, kind))).backward();
        fields(&g).map(|(name, leaf)| (name, leaf.grad()))
    };
    for ((name, single), (_, double)) in run(Kind::Float).iter().zip(&run(Kind::Double)) {
        let error = crate::common::relative_error(single, double);
        assert!(error < 1e-4, "{name}: {error:.2e}");
    }
}

#[test]
fn extreme_gaussians_leave_everything_finite() {
    let mut g = gaussians(1, 64, 3, Kind::Float, 11);
    let set = |t: &mut Tensor, row: i64, values: &[f32]| {
        t.select(0, 0).select(0, row).copy_(&Tensor::from_slice(values));
    };
    set(&mut g.means, 0, &[0., 0., -1.]); // behind
    set(&mut g.means, 1, &[0., 0., 0.01]); // on the near plane
    set(&mut g.means, 2, &[0.02, 0., 0.0101]); // just beyond it
    set(&mut g.means, 3, &[1e6, 0., 1.]); // far outside
    set(&mut g.scales, 4, &[1e3, 1e3, 1e3]); // huge
    set(&mut g.scales, 5, &[1e-8, 1e-8, 3.]); // a needle
    set(&mut g.scales, 6, &[0., 0., 0.]);
    for (row, opacity) in [(7, 0f32), (8, 1.)] {
        let _ = g.opacities.select(0, 0).select(0, row).fill_(f64::from(opacity));
    }
    let first = g.means.select(0, 0).select(0, 10).copy();
    g.means.select(0, 0).select(0, 9).copy_(&first); // equal depths
    let g = leaves(&g);
    let p = draw(&g, &cameras(1, 2, 70, 50, Kind::Float));
    objective(&p).backward();
    for t in [&p.rgb, &p.alpha, &p.depth] {
        assert_eq!(t.isfinite().all().int64_value(&[]), 1);
    }
    assert!(p.alpha.min().double_value(&[]) >= 0. && p.alpha.max().double_value(&[]) <= 1.);
    for (name, leaf) in fields(&g) {
        assert_eq!(leaf.grad().isfinite().all().int64_value(&[]), 1, "{name}");
    }
}

#[test]
fn zero_gaussians_render_black() {
    let g = leaves(&gaussians(1, 0, 3, Kind::Float, 12));
    let p = draw(&g, &cameras(1, 1, 20, 10, Kind::Float));
    assert_eq!(p.rgb.abs().max().double_value(&[]) + p.alpha.max().double_value(&[]), 0.);
    objective(&p).backward();
    assert_eq!(g.sh.grad().size(), [1, 0, 16, 3]);
}

#[test]
fn mismatched_shapes_are_refused() {
    let c = cameras(1, 1, 20, 10, Kind::Float);
    let good = || gaussians(1, 4, 1, Kind::Float, 13);
    let bad_scales = Gaussians { scales: Tensor::zeros([1, 3, 3], (Kind::Float, Device::Cpu)), ..good() };
    let error = render(&bad_scales, &c, DEFAULT_EPS2D).unwrap_err().to_string();
    assert!(error.contains("scales has shape"), "{error}");
    let bad_sh = Gaussians { sh: Tensor::zeros([1, 4, 5, 3], (Kind::Float, Device::Cpu)), ..good() };
    let error = render(&bad_sh, &c, DEFAULT_EPS2D).unwrap_err().to_string();
    assert!(error.contains("5 basis functions"), "{error}");
}
