//! Splats on their way through the program: what `convert` loses and what every command leaves out. The formats themselves are tested in
//! crates/splat-file.

#[path = "../../crates/splat-file/tests/splats/common.rs"]
mod splat_files;

use crate::common::program::{arg, refuse, room, run_json, succeed};
use globalsplat::io::{ShLimits, fit_splat, read_splat, write_splat};
use globalsplat::scene::{Gaussians, RawGaussians};
use serde_json::Value;
use splat_files::{
    Random, assert_says, files_with_invalid_values, files_without_a_rotation, random_splat, written,
};
use std::path::Path;

/// Gaussians keep the bits of a splat's parameters, and give them back unless they are infinite.
#[test]
fn splats_are_gaussians_and_back() {
    let mut splat = random_splat(300, 2, 3);
    let raw = RawGaussians::from_splat(&splat);
    let gaussians = Gaussians::from_splat(&splat);
    assert!(raw.activate().scales.equal(&gaussians.scales) && raw.means.equal(&gaussians.means));
    assert_eq!(Vec::<f32>::try_from(raw.log_scales.flatten(0, -1)).unwrap(), splat.log_scales.as_flattened());
    assert_eq!(raw.sh.size(), [1, 300, 9, 3]);
    assert_eq!(raw.sh.double_value(&[0, 7, 8, 1]), f64::from(splat.sh_of(7)[8][1]));
    let origin = glam::DVec3::new(1e6, 2., 3.);
    let back = gaussians.to_splat(origin).unwrap();
    assert_eq!((&back.means, &back.quaternions, &back.sh), (&splat.means, &splat.quaternions, &splat.sh));
    assert_eq!((back.origin, back.sh_degree), (origin, 2));
    let error = splat_files::largest_error(back.log_scales.as_flattened(), splat.log_scales.as_flattened());
    assert!(error < 1e-6, "{error}");
    for index in 0..300 {
        assert!((back.opacity(index) - splat.opacity(index)).abs() < 2e-6);
    }
    // Gaussians that aren't drawn, and scales and opacities without a finite logarithm or logit.
    splat.quaternions[100..150].fill([0.; 4]);
    splat.log_scales[0][1] = f32::NEG_INFINITY;
    splat.opacity_logits[..2].copy_from_slice(&[f32::INFINITY, f32::NEG_INFINITY]);
    let gaussians = Gaussians::from_splat(&splat);
    assert_eq!([0, 1].map(|index| gaussians.opacities.double_value(&[0, index])), [1., 0.]);
    assert_eq!(gaussians.scales.double_value(&[0, 0, 1]), 0.);
    let made = gaussians.to_splat(origin).unwrap();
    assert_eq!(made.len(), 250);
    assert_says(&made.warnings[0], &["50 of 300 Gaussians are left out", "length 0"]);
    assert!(made.log_scales[0][1].is_finite() && made.opacity_logits.iter().all(|logit| logit.is_finite()));
    let two = gaussians.map(|tensor| tch::Tensor::cat(&[tensor, tensor], 0));
    assert_says(&two.to_splat(origin).unwrap_err().to_string(), &["a splat holds one scene, found 2"]);
}

/// `convert` reports both files and the loss, measured on an orbit or from a capture's cameras.
#[test]
fn convert_reports_the_loss() {
    let (folder, room) = room();
    let ground_truth = room.join("truth.ply");
    let convert = |to: &str, more: &[&str]| -> Value {
        let to = folder.path().join(to);
        let report = succeed(&[&["convert", arg(&ground_truth), arg(&to), "--json"], more].concat());
        serde_json::from_str(&report).unwrap()
    };
    let same = convert("a.ply", &[]);
    assert_eq!(same["from"]["gaussians"], same["to"]["gaussians"]);
    assert_eq!(same["same_pixels"], true, "{same}");
    assert_eq!(std::fs::read(&ground_truth).unwrap(), std::fs::read(folder.path().join("a.ply")).unwrap());
    let small = convert("a.spz", &["--scene", arg(&room)]);
    assert_eq!((small["views"].as_u64(), small["same_pixels"].as_bool()), (Some(9), Some(false)));
    assert!(small["psnr"].as_f64().unwrap() > 30., "{small}");
    assert_eq!(small["to"]["bytes"], std::fs::metadata(folder.path().join("a.spz")).unwrap().len());
    assert!(small["to"]["bytes"].as_u64() < small["from"]["bytes"].as_u64());
    for degree in ["0", "3"] {
        let report = convert("b.compressed.ply", &["--sh-degree", degree]);
        assert_eq!(report["to"]["sh_degree"].to_string(), degree);
        assert_eq!(report["views"], 8);
    }
    let report = succeed(&["convert", arg(&ground_truth), arg(&folder.path().join("c.splat"))]);
    assert!(report.contains("Gaussians, SH degree 0, ") && report.contains("dB between renders"), "{report}");
    let out = folder.path().join("d.ply");
    let higher =
        crate::common::program::globalsplat(&["convert", arg(&ground_truth), arg(&out), "--sh-degree", "4"]);
    assert_eq!(higher.status.code(), Some(2));
}

/// Edits are applied in their order and counted, and the loss is measured by cameras that move along.
#[test]
fn convert_edits_in_the_given_order() {
    let (folder, room) = room();
    let original = room.join("truth.ply");
    let to = folder.path().join("edited.ply");
    let convert = |options: &[&str]| -> Value {
        run_json(&[&["convert", arg(&original), arg(&to), "--json"], options].concat())
    };
    let counts = |report: &Value| -> Vec<u64> {
        report["edits"].as_array().unwrap().iter().map(|edit| edit["gaussians"].as_u64().unwrap()).collect()
    };
    let splat = read_splat(&original).unwrap();
    let all = splat.len() as u64;
    let moved =
        convert(&["--rotate", "20,-40,100", "--scale", "3", "--translate", "-4,5,-6", "--scene", arg(&room)]);
    assert_eq!(counts(&moved), [all; 3]);
    // Rounded positions change the order of Gaussians at the same depth.
    assert!(moved["psnr"].as_f64().unwrap() > 35., "{moved}");
    // The moved cameras see of the moved splat what the capture's cameras see of the original.
    let cameras = folder.path().join("moved.json");
    let turned = ["--rotate", "20,-40,100", "--scale", "3"];
    convert(&[&turned[..], &["--scene", arg(&room), "--cameras-out", arg(&cameras)]].concat());
    let views = |splat: &Path, path: &Path| {
        let out = folder.path().join("views.png");
        succeed(&["render", "--splat", arg(splat), "--path", arg(path), "--out", arg(&out)]);
        globalsplat::io::tensor_from_rgb(&image::open(&out).unwrap().into_rgb8())
    };
    let psnr =
        globalsplat::metrics::psnr(&views(&original, &room.join("cameras.json")), &views(&to, &cameras));
    assert!(psnr > 33., "{psnr} dB");
    convert(&[&turned[..], &["--translate", "-4,5,-6"]].concat());
    for file in [&original, &to] {
        let cameras = ["--scene", arg(&room), "--cameras-out", arg(file)];
        let error = refuse(&[&["convert", arg(&original), arg(&to)][..], &cameras].concat());
        assert_says(&error, &["expected another name"]);
    }
    let back =
        ["--translate", "4,-5,6", "--scale", "0.333333333333333", "--rotate=0,0,-100", "--rotate=0,40,0"];
    let again = folder.path().join("again.ply");
    succeed(&[&["convert", arg(&to), arg(&again)][..], &back, &["--rotate=-20,0,0"]].concat());
    let again = read_splat(&again).unwrap();
    let farthest = splat_files::largest_error(again.means.as_flattened(), splat.means.as_flattened());
    assert!(farthest < 1e-5, "{farthest}");
    // A box before and after the splat is moved into it.
    let crop = ["--crop-box", "100,-9,-9,109,9,9"];
    let translate = ["--translate", "104,0,0"];
    assert!(counts(&convert(&[translate, crop].concat()))[1] > all / 2);
    assert_says(
        &refuse(&[&["convert", arg(&original), arg(&to)], &crop[..], &translate].concat()),
        &["edit 1 of 2 removes all "],
    );
    // The Gaussians that are seen most matter most.
    let half = (all / 2).to_string();
    let [decimated, cut] = [
        &["--decimate", &half, "--scene", arg(&room)][..],
        &["--crop-box", "-99,-99,-99,0,99,99", "--scene", arg(&room)],
    ]
    .map(&convert);
    assert_eq!(counts(&decimated), [all / 2]);
    assert!(decimated["psnr"].as_f64() > cut["psnr"].as_f64(), "{decimated} {cut}");
    // A Gaussian behind all cameras isn't seen, one far from all others is isolated, wherever the splat has been moved.
    let stray = {
        let mut stray = splat.select(&[0]);
        stray.means[0] = [0., 0., -500.];
        written(folder.path(), "stray.ply", &stray)
    };
    let seen = ["--merge", arg(&stray), "--scale", "2", "--prune-unseen", arg(&room), "--scene", arg(&room)];
    let seen = convert(&seen);
    assert_eq!(counts(&seen)[..2], [all + 1, all + 1]);
    assert!(counts(&seen)[2] <= all && seen["psnr"].as_f64().unwrap() > 35., "{seen}");
    assert!(read_splat(&to).unwrap().means.iter().all(|mean| mean[2] > -100.), "the stray one is gone");
    assert_eq!(counts(&convert(&["--merge", arg(&stray), "--filter-floaters=30"])), [all + 1, all]);
    let random = written(folder.path(), "random.ply", &random_splat(200, 1, 2));
    let filters = ["--min-opacity", "0.5", "--max-scale", "0.3", "--merge", arg(&stray)];
    let report = succeed(&[&["convert", arg(&random), arg(&to)][..], &filters].concat());
    assert_says(&report, &["--min-opacity=0.5: ", "--max-scale=0.3: ", "stray.ply: ", " Gaussians\n"]);
    let kept = read_splat(&to).unwrap();
    let passes =
        |index: usize| kept.opacity(index) >= 0.5 && kept.scale(index).iter().all(|&scale| scale <= 0.3);
    assert!((0..kept.len() - 1).all(passes) && kept.len() > 10 && kept.len() < 100, "{report}");
    let error = refuse(&["convert", arg(&original), arg(&to), "--matrix", "1,0,0,0,0,1,0,0,0,0,2,0,0,0,0,1"]);
    assert_says(&error, &["the matrix", "the same scale along all axes"]);
}

/// Coefficients beyond SPZ's range are clamped without a capture; with a capture the others are fitted to its cameras.
#[test]
fn convert_preserves_the_views_of_a_capture() {
    let (folder, room) = room();
    let strong = folder.path().join("strong.ply");
    let mut splat = read_splat(&room.join("truth.ply")).unwrap().with_sh_degree(3);
    let mut random = Random::new(3);
    for of_one in splat.sh.chunks_exact_mut(16) {
        of_one[1..].iter_mut().for_each(|color| *color = random.symmetric().map(|number: f32| 3. * number));
    }
    write_splat(&strong, &splat).unwrap();
    let cameras = globalsplat::data::open_capture(&room).unwrap().cameras();
    for (ending, gain, always) in [
        ("spz", 6., &[][..]),
        ("splat", 0.5, &[]),
        ("sog", 6., &[]),
        ("ply", 6., &["--clamp-sh"]),
        ("spz", 6., &["--clamp-sh"]),
    ] {
        let psnr = |options: &[&str]| {
            let to = folder.path().join(format!("a.{ending}"));
            succeed(&[&["convert", arg(&strong), arg(&to)], options, always].concat());
            let copy = read_splat(&to).unwrap();
            if !always.is_empty() {
                let limits = ShLimits::of_viewers(3);
                let is_within = |index: usize| {
                    copy.sh_of(index).iter().enumerate().all(|(basis, color)| {
                        let (low, high) = limits.range_of(basis);
                        // Formats round to steps of 0.03 or less.
                        color.iter().all(|&value| (low - 0.02..high + 0.02).contains(&value.into()))
                    })
                };
                assert!((0..copy.len()).all(is_within), "{ending}: beyond what viewers hold");
            }
            globalsplat::metrics::psnr_between(&splat, &copy, &cameras).unwrap().unwrap()
        };
        let (cut_off, fitted) = (psnr(&[]), psnr(&["--scene", arg(&room)]));
        assert!(fitted > cut_off + gain, "{ending}: {cut_off} dB cut off, {fitted} dB fitted");
    }
    // A message appears only without a capture.
    let (out, own) = (folder.path().join("b.spz"), folder.path().join("b.ply"));
    let convert = |more: &[&str]| said(&[&["convert", arg(&strong), arg(&out)], more].concat()).0;
    assert_says(&convert(&[]), &["beyond what the format holds"]);
    assert_says(&convert(&["--clamp-sh"]), &["beyond what viewers hold"]);
    assert_eq!(convert(&["--scene", arg(&room)]), "");
    for to in [&out, &own] {
        let refine = ["refine", "--splat", arg(&strong), "--scene", arg(&room), "--steps", "1", "--out"];
        succeed(&[&refine[..], &[arg(to)]].concat());
    }
    let [small, large] = [&out, &own].map(|path| read_splat(path).unwrap());
    let psnr = globalsplat::metrics::psnr_between(&large, &small, &cameras).unwrap().unwrap();
    let cut = fit_splat(&out, &large, &ShLimits::up_to(3), &[]).unwrap();
    let cut_off = globalsplat::metrics::psnr_between(&large, &cut, &cameras).unwrap().unwrap();
    assert!(psnr > cut_off + 6., "{psnr} dB, {cut_off} dB cut off");
}

/// Returns standard error and standard output of a command that succeeds.
fn said(arguments: &[&str]) -> (String, String) {
    let done = crate::common::program::globalsplat(arguments);
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let (stdout, stderr) = (text(done.stdout), text(done.stderr));
    assert!(done.status.success(), "{arguments:?}: {stderr}");
    (stderr, stdout)
}

/// `convert` removes Gaussians with invalid values or without a rotation, and counts them; other commands refuse the file and name it.
#[test]
fn convert_repairs_invalid_gaussians() {
    let (folder, room) = room();
    let (path, field, property) = files_with_invalid_values(folder.path()).swap_remove(0);
    let (picture, out) = (folder.path().join("orbit.png"), folder.path().join("refined.ply"));
    for command in [
        &["render", "--splat", arg(&path), "--orbit", "--out", arg(&picture)][..],
        &["refine", "--splat", arg(&path), "--scene", arg(&room), "--out", arg(&out)],
        &["eval", "--splat", arg(&path), "--scene", arg(&room)],
    ] {
        assert_says(&refuse(command), &[field, "`globalsplat convert` leaves out"]);
    }
    let [without_rotation, _] = files_without_a_rotation(folder.path());
    let to = folder.path().join("repaired.spz");
    for (path, why) in [
        (path, format!("whose numbers aren't finite or are out of range: {property}")),
        (without_rotation, "whose rotations have length 0".into()),
    ] {
        let expected = format!("{}: 1 of 3 Gaussians are left out, {why}\n", path.display());
        assert_eq!(said(&["inspect", arg(&path)]).0, expected);
        assert!(said(&["convert", arg(&path), arg(&to)]).0.starts_with(&expected));
        assert_eq!(read_splat(&to).unwrap().len(), 2);
    }
}
