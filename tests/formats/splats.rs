//! Splats on their way through the program: what `convert` loses and what every command leaves out. The formats themselves are tested in
//! crates/splat-file.

#[path = "../../crates/splat-file/tests/splats/common.rs"]
mod splat_files;

use crate::common::program::{Sandbox, assert_says};
use crate::common::psnr;
use glam::{DMat4, DVec3};
use globalsplat::data::open_capture;
use globalsplat::io::{ShLimits, Splat, fit_splat, read_image, read_splat};
use globalsplat::metrics::psnr_between;
use globalsplat::scene::{Gaussians, RawGaussians};
use rand::SeedableRng;
use rand::rngs::StdRng;
use serde_json::{Value, json};
use splat_files::{files_with_invalid_values, files_without_a_rotation, random_splat, symmetric, written};

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
    let origin = DVec3::new(1e6, 2., 3.);
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
    let sandbox = Sandbox::new();
    let convert = |options: &str| sandbox.json(&format!("convert @room/truth.ply {options}"));
    let same = convert("@a.ply");
    assert_eq!(same["from"]["gaussians"], same["to"]["gaussians"]);
    assert_eq!(same["same_pixels"], true, "{same}");
    assert_eq!(sandbox.read("room/truth.ply"), sandbox.read("a.ply"));
    let small = convert("@a.spz --scene @room");
    assert_eq!((small["views"].as_u64(), small["same_pixels"].as_bool()), (Some(9), Some(false)));
    assert!(small["psnr"].as_f64().unwrap() > 30., "{small}");
    assert_eq!(small["to"]["bytes"], sandbox.read("a.spz").len());
    assert!(small["to"]["bytes"].as_u64() < small["from"]["bytes"].as_u64());
    for degree in ["0", "3"] {
        let report = convert(&format!("@b.compressed.ply --sh-degree {degree}"));
        assert_eq!(report["to"]["sh_degree"].to_string(), degree);
        assert_eq!(report["views"], 8);
    }
    let report = sandbox.succeed("convert @room/truth.ply @c.splat");
    assert_says(&report, &["Gaussians, SH degree 0, ", "dB between renders"]);
    assert_eq!(sandbox.output("convert @room/truth.ply @d.ply --sh-degree 4").0, Some(2));
}

/// A splat of a tilted capture is turned upright, and scaled by a known length.
#[test]
fn convert_turns_upright_and_scales_to_a_length() {
    let sandbox = Sandbox::new();
    let matrix = |report: &Value| {
        let rows: [[f64; 4]; 4] = serde_json::from_value(report["transform"]["matrix"].clone()).unwrap();
        DMat4::from_cols_array_2d(&rows).transpose()
    };
    let tilt = "convert @room/truth.ply @turned.ply --rotate 20,-40,100 --translate 1,2,3";
    let tilt = matrix(&sandbox.json(tilt));
    sandbox.change_json("room/cameras.json", |json| {
        for view in json["views"].as_array_mut().unwrap() {
            let rows: [[f64; 4]; 4] = serde_json::from_value(view["c2w"].take()).unwrap();
            view["c2w"] = json!((DMat4::from_cols_array_2d(&rows) * tilt.transpose()).to_cols_array_2d());
        }
    });
    let report =
        sandbox.json("convert @turned.ply @upright.ply --upright --scene @room --length 0,0,0 3,4,0 1");
    let all = matrix(&report) * tilt;
    let angle = all.transform_vector3(DVec3::Y).angle_between(DVec3::Y).to_degrees();
    assert!(angle < 2., "{angle}°");
    assert!((all.transform_vector3(DVec3::X).length() * 5. - 1.).abs() < 1e-9, "{all}");
    let [before, after] = ["turned.ply", "upright.ply"].map(|name| read_splat(&sandbox.path(name)).unwrap());
    let (distance, half) = (
        |splat: &Splat, a: usize, b: usize| {
            DVec3::from(splat.means[a].map(f64::from)).distance(DVec3::from(splat.means[b].map(f64::from)))
        },
        before.len() / 2,
    );
    let ratio = distance(&after, 0, half) / distance(&before, 0, half);
    assert!((5. * ratio - 1.).abs() < 1e-3, "{ratio}");
    let edits: Vec<&str> =
        report["edits"].as_array().unwrap().iter().map(|edit| edit["edit"].as_str().unwrap()).collect();
    assert_eq!(edits, ["--upright", "--length=0,0,0 3,4,0 1"]);
    assert_says(
        &sandbox.succeed("convert @turned.ply @upright.ply --upright --scene @room"),
        &["upright by the "],
    );
    assert_says(
        &sandbox.refuse("convert @turned.ply @upright.ply --upright"),
        &["--upright needs the cameras of --scene"],
    );
    assert_says(
        &sandbox.refuse("convert @turned.ply @upright.ply --length 1,2,3 1,2,3 1"),
        &["--length=1,2,3 1,2,3 1: expected two points that differ"],
    );
}

/// Edits are applied in their order and counted, and the loss is measured by cameras that move along.
#[test]
fn convert_edits_in_the_given_order() {
    let sandbox = Sandbox::new();
    let convert = |edits: &str| sandbox.json(&format!("convert @room/truth.ply @edited.ply {edits}"));
    let refuse = |edits: &str| sandbox.refuse(&format!("convert @room/truth.ply @edited.ply {edits}"));
    let edited = || read_splat(&sandbox.path("edited.ply")).unwrap();
    let counts = |report: &Value| -> Vec<u64> {
        report["edits"].as_array().unwrap().iter().map(|edit| edit["gaussians"].as_u64().unwrap()).collect()
    };
    let splat = read_splat(&sandbox.path("room/truth.ply")).unwrap();
    let all = splat.len() as u64;
    let moved = convert("--rotate 20,-40,100 --scale 3 --translate -4,5,-6 --scene @room");
    assert_eq!(counts(&moved), [all; 3]);
    // Rounded positions change the order of Gaussians at the same depth.
    assert!(moved["psnr"].as_f64().unwrap() > 35., "{moved}");
    // The moved cameras see of the moved splat what the capture's cameras see of the original.
    convert("--rotate 20,-40,100 --scale 3 --scene @room --cameras-out @moved.json");
    let [before, after] =
        [("room/truth.ply", "room/cameras.json"), ("edited.ply", "moved.json")].map(|(splat, path)| {
            sandbox.succeed(&format!("render --splat @{splat} --path @{path} --out @views.png"));
            read_image(&sandbox.path("views.png")).unwrap()
        });
    let psnr = psnr(&before, &after);
    assert!(psnr > 33., "{psnr} dB");
    for file in ["room/truth.ply", "edited.ply"] {
        let error = refuse(&format!("--scene @room --cameras-out @{file}"));
        assert_says(&error, &["expected another name"]);
    }
    convert("--rotate 20,-40,100 --scale 3 --translate -4,5,-6");
    let back =
        "--translate 4,-5,6 --scale 0.333333333333333 --rotate=0,0,-100 --rotate=0,40,0 --rotate=-20,0,0";
    sandbox.succeed(&format!("convert @edited.ply @again.ply {back}"));
    let again = read_splat(&sandbox.path("again.ply")).unwrap();
    let farthest = splat_files::largest_error(again.means.as_flattened(), splat.means.as_flattened());
    assert!(farthest < 1e-5, "{farthest}");
    // A box before and after the splat is moved into it.
    assert!(counts(&convert("--translate 104,0,0 --crop-box 100,-9,-9,109,9,9"))[1] > all / 2);
    let error = refuse("--crop-box 100,-9,-9,109,9,9 --translate 104,0,0");
    assert_says(&error, &["edit 1 of 2 removes all "]);
    // The Gaussians that are seen most matter most.
    let decimated = convert(&format!("--decimate {} --scene @room", all / 2));
    let cut = convert("--crop-box -99,-99,-99,0,99,99 --scene @room");
    assert_eq!(counts(&decimated), [all / 2]);
    assert!(decimated["psnr"].as_f64() > cut["psnr"].as_f64(), "{decimated} {cut}");
    // A Gaussian behind all cameras isn't seen, one far from all others is isolated, wherever the splat has been moved.
    let mut stray = splat.select(&[0]);
    stray.means[0] = [0., 0., -500.];
    written(sandbox.folder(), "stray.ply", &stray);
    let seen = convert("--merge @stray.ply --scale 2 --prune-unseen @room --scene @room");
    assert_eq!(counts(&seen)[..2], [all + 1, all + 1]);
    assert!(counts(&seen)[2] <= all && seen["psnr"].as_f64().unwrap() > 35., "{seen}");
    assert!(edited().means.iter().all(|mean| mean[2] > -100.), "the stray one is gone");
    assert_eq!(counts(&convert("--merge @stray.ply --filter-floaters=30")), [all + 1, all]);
    written(sandbox.folder(), "random.ply", &random_splat(200, 1, 2));
    let filters = "--min-opacity 0.5 --max-scale 0.3 --merge @stray.ply";
    let report = sandbox.succeed(&format!("convert @random.ply @edited.ply {filters}"));
    assert_says(&report, &["--min-opacity=0.5: ", "--max-scale=0.3: ", "stray.ply: ", " Gaussians\n"]);
    let kept = edited();
    let passes =
        |index: usize| kept.opacity(index) >= 0.5 && kept.scale(index).iter().all(|&scale| scale <= 0.3);
    assert!((0..kept.len() - 1).all(passes) && kept.len() > 10 && kept.len() < 100, "{report}");
    let error = refuse("--matrix 1,0,0,0,0,1,0,0,0,0,2,0,0,0,0,1");
    assert_says(&error, &["the matrix", "the same scale along all axes"]);
}

/// Coefficients beyond SPZ's range are clamped without a capture; with a capture the others are fitted to its cameras.
#[test]
fn convert_preserves_the_views_of_a_capture() {
    let sandbox = Sandbox::new();
    let mut splat = read_splat(&sandbox.path("room/truth.ply")).unwrap().with_sh_degree(3);
    let random = &mut StdRng::seed_from_u64(3);
    for of_one in splat.sh.chunks_exact_mut(16) {
        of_one[1..].iter_mut().for_each(|color| *color = symmetric(random).map(|number| 3. * number));
    }
    written(sandbox.folder(), "strong.ply", &splat);
    let cameras = open_capture(&sandbox.path("room")).unwrap().cameras();
    for (ending, gain, always) in [
        ("spz", 6., ""),
        ("splat", 0.5, ""),
        ("sog", 6., ""),
        ("ply", 6., "--clamp-sh"),
        ("spz", 6., "--clamp-sh"),
    ] {
        let [cut_off, fitted] = ["", "--scene @room"].map(|options| {
            sandbox.succeed(&format!("convert @strong.ply @a.{ending} {options} {always}"));
            let copy = read_splat(&sandbox.path(&format!("a.{ending}"))).unwrap();
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
            psnr_between(&splat, &copy, &cameras).unwrap().unwrap()
        });
        assert!(fitted > cut_off + gain, "{ending}: {cut_off} dB cut off, {fitted} dB fitted");
    }
    // A message appears only without a capture.
    let messages =
        |more: &str| sandbox.succeed_with_messages(&format!("convert @strong.ply @b.spz {more}")).1;
    assert_says(&messages(""), &["beyond what the format holds"]);
    assert_says(&messages("--clamp-sh"), &["beyond what viewers hold"]);
    assert_eq!(messages("--scene @room"), "");
    let [small, large] = ["b.spz", "b.ply"].map(|to| {
        sandbox.succeed(&format!("refine --splat @strong.ply --scene @room --steps 1 --out @{to}"));
        read_splat(&sandbox.path(to)).unwrap()
    });
    let psnr = psnr_between(&large, &small, &cameras).unwrap().unwrap();
    let cut = fit_splat(&sandbox.path("b.spz"), &large, &ShLimits::up_to(3), &[]).unwrap();
    let cut_off = psnr_between(&large, &cut, &cameras).unwrap().unwrap();
    assert!(psnr > cut_off + 6., "{psnr} dB, {cut_off} dB cut off");
}

/// `convert` removes Gaussians with invalid values or without a rotation, and counts them; other commands refuse the file and name it.
#[test]
fn convert_repairs_invalid_gaussians() {
    let sandbox = Sandbox::new();
    let (path, field, property) = files_with_invalid_values(sandbox.folder()).swap_remove(0);
    let name = path.file_name().unwrap().to_str().unwrap();
    for command in
        ["render --orbit --out @orbit.png", "refine --scene @room --out @refined.ply", "eval --scene @room"]
    {
        let error = sandbox.refuse(&format!("{command} --splat @{name}"));
        assert_says(&error, &[field, "`globalsplat convert` leaves out"]);
    }
    let [without_rotation, _] = files_without_a_rotation(sandbox.folder());
    for (path, why) in [
        (path, format!("whose numbers aren't finite or are out of range: {property}")),
        (without_rotation, "whose rotations have length 0".into()),
    ] {
        let name = path.file_name().unwrap().to_str().unwrap();
        let expected = format!("{}: 1 of 3 Gaussians are left out, {why}\n", path.display());
        assert_eq!(sandbox.succeed_with_messages(&format!("inspect @{name}")).1, expected);
        let messages = sandbox.succeed_with_messages(&format!("convert @{name} @repaired.spz")).1;
        assert!(messages.starts_with(&expected));
        assert_eq!(read_splat(&sandbox.path("repaired.spz")).unwrap().len(), 2);
    }
}
