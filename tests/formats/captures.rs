//! Published splats of real captures, rendered from the captures' own cameras.

use crate::common::program::Sandbox;
use crate::common::{captures, has_lpips, relative_error, rerun_test, skip};
use glam::{DMat3, DMat4, DVec3};
use globalsplat::data::{PhotoSize, open_capture};
use globalsplat::eval::{EvalScene, Method};
use globalsplat::io::read_splat;
use globalsplat::metrics::{Perceptual, psnr};
use globalsplat::render::{move_cameras, render_views, transform};
use globalsplat::scene::{Gaussians, Similarity};
use std::path::Path;

/// Mean PSNR, SSIM, and LPIPS by VGG-16 and AlexNet over a capture's views that the published splat must reach.
const PUBLISHED: [(&str, [f64; 4]); 2] = [
    ("322261824c4a3003", [29.089, 0.9160, 0.1148, 0.0500]),
    ("5aca87f95a9412c6", [27.222, 0.9175, 0.1020, 0.0484]),
];

/// Largest differences from [`PUBLISHED`].
const TOLERANCES: [f64; 4] = [0.01, 0.0005, 0.0005, 0.0005];

#[test]
fn published_splats_reach_their_scores() {
    let Some(paths) = captures() else { return };
    let perceptual = Perceptual::new(tch::Device::Cpu);
    let mut known = 0;
    for path in &paths {
        let capture = open_capture(path).expect("a capture");
        let Some((name, expected)) = PUBLISHED.iter().find(|(name, _)| *name == capture.name) else {
            continue;
        };
        known += 1;
        let scene = EvalScene::without_context(&capture, None, PhotoSize::Own).expect("views");
        let splat = Method::Splat(path.join("reference.ply"));
        let scored = splat.score(&scene, tch::Device::Cpu, Some(&perceptual), |_, _, _, _| Ok(()));
        let mean = scored.expect("scores").scores.mean;
        assert_eq!(Perceptual::explain_missing(&mean).is_none(), has_lpips());
        let found = [Some(mean.psnr), Some(mean.ssim), mean.lpips_vgg, mean.lpips_alex];
        for ((found, expected), tolerance) in found.into_iter().zip(expected).zip(TOLERANCES) {
            assert!(
                found.is_none_or(|found| (found - expected).abs() < tolerance),
                "{name}: {found:?}, not {expected}"
            );
        }
    }
    if known == 0 {
        skip("captures with known scores", &format!("none of the {} captures has known scores", paths.len()));
    }
}

#[test]
fn a_moved_splat_looks_the_same_to_moved_cameras() {
    for path in captures().unwrap_or_default() {
        let capture = open_capture(&path).expect("a capture");
        let splat = Gaussians::from_splat(&read_splat(&path.join("reference.ply")).expect("a splat"));
        let to = Similarity {
            rotation: DMat3::from_euler(glam::EulerRot::XYZ, 0.7, -1.1, 2.3),
            translation: DVec3::new(3., -2., 5.),
            scale: 2.5,
        };
        let moved = transform(&splat, &to);
        let cameras = &capture.cameras()[..2];
        let matrix = DMat4::from_mat3_translation(to.rotation * to.scale, to.translation);
        let moved_cameras = move_cameras(cameras, &matrix);
        let before = render_views(&splat, cameras).expect("pictures");
        let after = render_views(&moved, &moved_cameras).expect("pictures");
        for (a, b) in before.iter().zip(&after) {
            // Not bit-identical: positions of size 10 instead of 1 have fewer fractional digits in float32.
            assert!(psnr(&b.rgb, &a.rgb) > 60.);
            assert!(relative_error(&b.depth, &(&a.depth * to.scale)) < 1e-3);
        }
    }
}

#[test]
fn missing_captures_are_reported() {
    let (another, empty) = (Sandbox::new(), Sandbox::empty());
    for (name, captures, what) in [
        ("captures::published_splats_reach_their_scores", another.folder(), "captures with known scores\n"),
        ("captures::published_splats_reach_their_scores", empty.folder(), "captures\n"),
        ("captures::a_moved_splat_looks_the_same_to_moved_cameras", empty.folder(), "captures\n"),
    ] {
        let run = |strict: &str| {
            let variables = [("GLOBALSPLAT_CAPTURES", captures), ("GLOBALSPLAT_NO_SKIPS", Path::new(strict))];
            rerun_test(name, &variables)
        };
        assert_eq!(run(""), (true, what.into()), "{name}");
        assert_eq!(run("1"), (false, String::new()), "{name}");
    }
}
