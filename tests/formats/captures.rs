//! Published splats of real captures, rendered from the captures' own cameras.

use crate::common::program::room;
use crate::common::{captures, has_lpips, rerun_test, skip};
use glam::{DMat3, DVec3};
use globalsplat::data::{Capture, PhotoSize, find_captures, open_capture};
use globalsplat::eval::{EvalScene, Method, score_output};
use globalsplat::io::{read_splat, write_splat};
use globalsplat::metrics::{CaptureScores, Perceptual};
use globalsplat::render::transform;
use globalsplat::scene::{Gaussians, Similarity};
use std::path::{Path, PathBuf};

/// Mean PSNR and SSIM over a capture's views that the published splat must reach.
const PUBLISHED: [(&str, [f64; 2]); 2] =
    [("322261824c4a3003", [29.089, 0.9160]), ("5aca87f95a9412c6", [27.222, 0.9175])];

/// Returns the captures that are in `table`, with its values, at least one; if only other captures are available, none.
fn known(table: &[(&str, [f64; 2])]) -> Vec<(PathBuf, Capture, [f64; 2])> {
    let Some(paths) = captures() else { return vec![] };
    let known: Vec<_> = paths
        .iter()
        .filter_map(|path| {
            let capture = open_capture(path).expect("a capture");
            let scores = table.iter().find(|(name, _)| *name == capture.name)?.1;
            Some((path.clone(), capture, scores))
        })
        .collect();
    if known.is_empty() {
        skip("captures with known scores", &format!("none of the {} captures has known scores", paths.len()));
    }
    known
}

/// Scores the published splat of the capture in `folder` at all of its cameras.
fn published_scores(folder: &Path, capture: &Capture, perceptual: &Perceptual) -> CaptureScores {
    let scene = EvalScene::without_context(capture, None, PhotoSize::Own).expect("views");
    let mut made = Method::Splat(folder.join("reference.ply"))
        .render_targets(scene, tch::Device::Cpu)
        .expect("a picture");
    score_output(&mut made, perceptual, |_, _, _| Ok(())).expect("scores")
}

#[test]
fn published_splats_reach_their_scores() {
    let perceptual = Perceptual::find(tch::Device::Cpu).expect("weights");
    for (path, capture, [psnr, ssim]) in known(&PUBLISHED) {
        let scores = published_scores(&path, &capture, &perceptual);
        assert!((scores.mean.psnr - psnr).abs() < 0.01, "{}: PSNR {}", capture.name, scores.mean.psnr);
        assert!((scores.mean.ssim - ssim).abs() < 0.0005, "{}: SSIM {}", capture.name, scores.mean.ssim);
    }
}

/// Mean LPIPS over a capture's views, by VGG-16 and AlexNet, that the published splat must reach.
const PUBLISHED_LPIPS: [(&str, [f64; 2]); 2] =
    [("322261824c4a3003", [0.1148, 0.0500]), ("5aca87f95a9412c6", [0.1020, 0.0484])];

#[test]
fn published_splats_look_as_they_are_known_to() {
    if !has_lpips() {
        return;
    }
    let perceptual = Perceptual::find(tch::Device::Cpu).expect("weights");
    for (path, capture, [vgg, alex]) in known(&PUBLISHED_LPIPS) {
        let scores = published_scores(&path, &capture, &perceptual);
        assert!(perceptual.explain_missing(&scores.mean).is_none());
        let (found_vgg, found_alex) =
            (scores.mean.lpips_vgg.expect("LPIPS-VGG"), scores.mean.lpips_alex.expect("LPIPS-Alex"));
        assert!((found_vgg - vgg).abs() < 0.0005, "{}: LPIPS-VGG {found_vgg}", capture.name);
        assert!((found_alex - alex).abs() < 0.0005, "{}: LPIPS-Alex {found_alex}", capture.name);
    }
}

#[test]
fn a_splat_survives_being_written() {
    for path in captures().unwrap_or_default() {
        let file = path.join("reference.ply");
        let splat = read_splat(&file).expect("a splat");
        let folder = tempfile::tempdir().expect("a folder");
        let copy = folder.path().join("copy.ply");
        write_splat(&copy, &splat).expect("a written splat");
        if splat.len() == 16_384 && splat.bases() == 16 {
            assert_eq!(std::fs::metadata(&copy).expect("a file").len(), 4_064_762);
        }
        assert_eq!(read_splat(&copy).expect("a splat"), splat);
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
        let cameras = capture.cameras();
        let moved_cameras: Vec<_> = cameras[..2]
            .iter()
            .map(|camera| {
                let mut c2w = glam::DMat4::from_mat3(to.rotation) * camera.c2w;
                c2w.w_axis =
                    (to.scale * (to.rotation * camera.c2w.w_axis.truncate()) + to.translation).extend(1.);
                globalsplat::scene::Camera { c2w, ..*camera }
            })
            .collect();
        let before = globalsplat::render::render_views(&splat, &cameras[..2]).expect("pictures");
        let after = globalsplat::render::render_views(&moved, &moved_cameras).expect("pictures");
        for (a, b) in before.iter().zip(&after) {
            // Not bit-identical: positions of size 10 instead of 1 have fewer fractional digits in float32.
            assert!(globalsplat::metrics::psnr(&b.rgb, &a.rgb) > 60.);
            assert!(crate::common::relative_error(&b.depth, &(&a.depth * to.scale)) < 1e-3);
        }
    }
}

#[test]
fn folders_of_captures_are_found() {
    let Some(paths) = captures() else { return };
    let found = find_captures(paths[0].parent().expect("a parent")).expect("captures").captures;
    assert_eq!(found.len(), paths.len());
    let above = tempfile::tempdir().expect("a folder");
    std::os::unix::fs::symlink(paths[0].parent().expect("a parent"), above.path().join("re10k"))
        .expect("a link");
    assert_eq!(find_captures(above.path()).expect("captures").captures.len(), paths.len());
    let mut names: Vec<_> = found.iter().map(|capture| capture.name.as_str()).collect();
    names.sort_unstable();
    assert!(paths.iter().map(|path| path.file_name().expect("a name")).eq(names));
}

#[test]
fn missing_captures_are_reported() {
    let (another, _) = room();
    let empty = tempfile::tempdir().expect("a folder");
    for (name, captures, what) in [
        ("captures::published_splats_reach_their_scores", another.path(), "captures with known scores\n"),
        ("captures::published_splats_reach_their_scores", empty.path(), "captures\n"),
        ("captures::a_splat_survives_being_written", empty.path(), "captures\n"),
        ("captures::a_moved_splat_looks_the_same_to_moved_cameras", empty.path(), "captures\n"),
    ] {
        let run = |strict: &str| {
            rerun_test(
                name,
                &[("GLOBALSPLAT_CAPTURES", captures), ("GLOBALSPLAT_NO_SKIPS", Path::new(strict))],
            )
        };
        assert_eq!(run(""), (true, what.into()), "{name}");
        assert_eq!(run("1"), (false, String::new()), "{name}");
    }
}
