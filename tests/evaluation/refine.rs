//! Refinement of splats on photos improves held-out views, is bit-identical with any number of threads, and reports impossible
//! requests in one sentence.

use crate::common::formats::{Format, rewrite, write_points};
use crate::common::program::{arg, command, refuse, room, succeed};
use crate::common::{captures, fox};
use glam::DVec3;
use globalsplat::data::{Capture, Holdout, PhotoSize, load_all_views, open_capture, read_points};
use globalsplat::io::{read_splat, write_splat};
use globalsplat::refine::{
    ExposureCorrection, RefineEvent, RefineOptions, RefineResult, RefineSession, RefineState, SceneInit,
    gaussians_from_photos,
};
use globalsplat::scene::Gaussians;
use serde_json::Value;
use std::path::Path;
use tch::Kind;

/// Writes a video of a synthetic scene as chunks, and returns the path of its scene.
fn world(folder: &Path, size: &str) -> String {
    let out = folder.join("world");
    succeed(&["synth", "--out", arg(&out), "--seed", "7", "--frames", "12", "--size", size]);
    format!("{}#7_000000", out.join("000000.torch").display())
}

/// Runs the program and returns the JSON that it prints.
fn run_json(arguments: &[&str]) -> Value {
    serde_json::from_str(&succeed(arguments)).expect("JSON")
}

fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} in {value}"))
}

/// Refinement from photos alone shows held-out views better than the initial Gaussians do, and writes the splat.
#[test]
fn photos_alone_become_a_splat() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, out, sheet) =
        (world(folder.path(), "64"), folder.path().join("a.ply"), folder.path().join("a.png"));
    let done = run_json(&[
        "refine",
        "--scene",
        &scene,
        "--out",
        arg(&out),
        "--holdout",
        "every:4+1",
        "--gaussians",
        "2000",
        "--steps",
        "120",
        "--contact-sheet",
        arg(&sheet),
        "--json",
    ]);
    let (before, after) = (number(&done, "/held_out/before/psnr"), number(&done, "/held_out/after/psnr"));
    assert!(after > before + 3., "{before} → {after}");
    assert_eq!(done["gaussians"], 2000);
    assert_eq!(done["steps"], 120);
    let curve = done["held_out"]["curve"].as_array().unwrap();
    assert!(curve.last().unwrap()["psnr"] == done["held_out"]["after"]["psnr"]);
    // The reported scores are those of the written splat.
    let scored = run_json(&["eval", "--splat", arg(&out), "--scene", &scene, "--json"]);
    let held_out: Vec<f64> = [1, 5, 9].map(|i| number(&scored, &format!("/views/{i}/psnr"))).into();
    assert!((held_out.iter().sum::<f64>() / 3. - after).abs() < 0.01, "{held_out:?}, told {after}");
    assert!(sheet.is_file());
}

/// A refinement from a model's reconstruction improves it and has the requested number of Gaussians, even if these are fewer than the model's.
#[test]
fn a_reconstruction_becomes_a_splat_of_the_requested_size() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, out) = (world(folder.path(), "64"), folder.path().join("a.ply"));
    let options = ["--init", "model", "--gaussians", "4000", "--steps", "400", "--holdout", "every:4+1"];
    let done =
        run_json(&[&["refine", "--scene", &scene, "--out", arg(&out), "--json"], &options[..]].concat());
    let (before, after) = (number(&done, "/held_out/before/psnr"), number(&done, "/held_out/after/psnr"));
    assert!(after > before + 1., "{before} → {after}");
    assert_eq!(done["gaussians"], 4000);
}

/// Commands leave out what the masks in a folder cover.
#[test]
fn masks_in_a_folder_are_left_out() {
    let (folder, room) = room();
    let masks = folder.path().join("masks");
    for photo in open_capture(&room).unwrap().names() {
        let mut pixels = image::open(room.join(photo)).unwrap().to_rgb8();
        let (width, height) = pixels.dimensions();
        let mut mask = image::GrayImage::from_pixel(width, height, image::Luma([255]));
        for (x, y) in (0..width / 2).flat_map(|x| (0..height).map(move |y| (x, y))) {
            pixels.put_pixel(x, y, image::Rgb([255, 0, 255]));
            mask.put_pixel(x, y, image::Luma([0]));
        }
        pixels.save(room.join(photo)).unwrap();
        let mask_file = masks.join(photo).with_extension("png");
        std::fs::create_dir_all(mask_file.parent().unwrap()).unwrap();
        mask.save(mask_file).unwrap();
    }
    let (truth, scene, masks) = (room.join("truth.ply"), arg(&room), arg(&masks));
    let eval = ["eval", "--splat", arg(&truth), "--scene", scene];
    let masked = run_json(&[&eval[..], &["--masks", masks, "--json"]].concat());
    let unmasked = run_json(&[&eval[..], &["--json"]].concat());
    assert!(number(&masked, "/psnr") > number(&unmasked, "/psnr") + 10., "{masked}");
    assert_eq!(number(&masked, "/pixel_fraction"), 0.5);
    assert!(unmasked.get("pixel_fraction").is_none());
    let table = succeed(&[&eval[..], &["--masks", masks]].concat());
    assert!(table.ends_with("scored over 50.0 % of the pixels: the others are masked out\n"), "{table}");

    let out = folder.path().join("out.ply");
    let bytes = |arguments: &[&str]| {
        succeed(&[arguments, &["--scene", scene, "--out", arg(&out)]].concat());
        std::fs::read(&out).unwrap()
    };
    let reconstruct = ["reconstruct", "--views", "2"];
    assert!(bytes(&[&reconstruct[..], &["--masks", masks]].concat()) != bytes(&reconstruct));
    let refine = ["refine", "--steps", "3", "--gaussians", "200", "--masks", masks];
    let ignored = bytes(&refine);
    for color in ["black", "white", "random"] {
        assert!(bytes(&[&refine[..], &["--mask-background", color]].concat()) != ignored, "{color}");
    }
}

/// The number of threads does not change the bytes with the same steps and seed; another seed gives others.
#[test]
fn threads_do_not_change_the_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let scene = world(folder.path(), "48");
    // Enough steps to improve on the initial splat, which would be kept otherwise.
    for options in [&["--gaussians", "500"][..], &["--init", "model", "--gaussians", "6000"]] {
        let bytes = |name: &str, threads: &str, seed: &str| {
            let out = folder.path().join(name);
            let mut arguments =
                vec!["refine", "--scene", &scene, "--out", arg(&out), "--steps", "60", "--seed", seed];
            arguments.extend(["--set", "relocate_every=7"]);
            arguments.extend(options);
            let done = command(&arguments).env("OMP_NUM_THREADS", threads).output().unwrap();
            assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
            std::fs::read(out).unwrap()
        };
        let one = bytes("one.ply", "1", "3");
        assert!(one == bytes("three.ply", "3", "3"), "{options:?}: threads change the bytes");
        assert!(one != bytes("other.ply", "1", "4"), "{options:?}: another seed changes nothing");
    }
}

/// Rewrites the views of a room's cameras.json.
fn rewrite_views(room: &Path, change: impl FnOnce(Vec<Value>) -> Vec<Value>) {
    let file = room.join("cameras.json");
    let mut cameras: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let views = cameras["views"].as_array().unwrap().clone();
    cameras["views"] = change(views).into();
    std::fs::write(&file, cameras.to_string()).unwrap();
}

/// Returns the positions of the cameras, [V][3].
fn centres(views: &[Value]) -> Vec<[f64; 3]> {
    let number = |view: &Value, axis: usize| view["c2w"][axis][3].as_f64().unwrap();
    views.iter().map(|view| [0, 1, 2].map(|axis| number(view, axis))).collect()
}

fn put_centre(view: &mut Value, centre: [f64; 3]) {
    (0..3).for_each(|axis| view["c2w"][axis][3] = centre[axis].into());
}

/// Repeated photos, from exactly the same position or from nearby positions, as of a camera at rest, change the result only by
/// chance.
#[test]
fn photos_of_one_place_count_once() {
    let reached = |copies: usize, jitter: f64| {
        let (folder, room) = room();
        let whole = room.join("whole.json");
        std::fs::copy(room.join("cameras.json"), &whole).unwrap();
        rewrite_views(&room, |views| {
            let shown: Vec<Value> =
                views.into_iter().enumerate().filter(|(i, _)| i % 3 != 1).map(|(_, view)| view).collect();
            let centres = centres(&shown);
            let extent =
                centres.iter().map(|c| DVec3::from(*c).distance(centres[0].into())).fold(0., f64::max);
            let copy = |(index, view): (usize, &Value), copy: usize| {
                let mut view = view.clone();
                // Offsets are within a ball; the first copy is at the original position.
                let phase = (7 * index + 13 * copy) as f64;
                let off = DVec3::new(phase.sin(), (1.7 * phase).cos(), (2.3 * phase).sin()) * jitter * extent;
                let off = if copy == 0 { DVec3::ZERO } else { off };
                put_centre(&mut view, (DVec3::from(centres[index]) + off).to_array());
                view
            };
            let copies = (0..copies).flat_map(|k| shown.iter().enumerate().map(move |of| copy(of, k)));
            copies.collect()
        });
        let out = folder.path().join("a.ply");
        let options = ["--gaussians", "2000", "--steps", "200", "--json"];
        run_json(&[&["refine", "--scene", arg(&room), "--out", arg(&out)][..], &options].concat());
        std::fs::copy(&whole, room.join("cameras.json")).unwrap();
        let scores = run_json(&["eval", "--splat", arg(&out), "--scene", arg(&room), "--json"]);
        [1, 4, 7].map(|view| number(&scores, &format!("/views/{view}/psnr"))).iter().sum::<f64>() / 3.
    };
    let plain = reached(1, 0.);
    for (copies, jitter) in [(2, 0.), (3, 1e-9), (5, 1e-4), (3, 1e-2)] {
        let copied = reached(copies, jitter);
        assert!((copied - plain).abs() < 1.5, "{copies} copies, {jitter}: {copied}, without them {plain}");
    }
}

/// Cameras that don't move give no depth: a warning says so, and the photos are placed at one distance.
#[test]
fn photos_from_one_place_are_shown_at_one_distance() {
    let (folder, room) = room();
    let out = folder.path().join("a.ply");
    rewrite_views(&room, |mut views| {
        let first = centres(&views)[0];
        views.iter_mut().for_each(|view| put_centre(view, first));
        // Otherwise all of them would be near duplicates, which is fine.
        (0..3).for_each(|row| views[1]["c2w"][row] = views[0]["c2w"][row].clone());
        views
    });
    let arguments =
        ["refine", "--scene", arg(&room), "--out", arg(&out), "--gaussians", "500", "--steps", "20"];
    let done = command(&arguments).output().unwrap();
    let message = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success() && message.contains("depth can't be estimated"), "{message}");
    let means = read_splat(&out).unwrap().means;
    assert!(means.as_flattened().iter().all(|coordinate| coordinate.is_finite()));
}

/// An interrupted refinement returns a splat at any time, once there is one.
#[test]
fn an_interrupted_refinement_returns_its_gaussians() {
    let (_folder, room) = room();
    let capture = open_capture(&room).unwrap();
    let options = RefineOptions { steps: Some(1_000_000), gaussians: Some(300), ..RefineOptions::default() };
    // Returns the number of steps done if the work stops at the first event of a kind.
    let steps = |ends: fn(&RefineEvent) -> bool| {
        let mut session =
            RefineSession::load(&capture, &options, SceneInit::Photos, move |event| !ends(&event))?;
        session.start()?;
        let result = session.run()?;
        // Their number has hardly begun to grow from a fifth.
        assert_eq!(result.gaussians.count(), 60);
        assert_eq!(result.gaussians.means.isfinite().all().int64_value(&[]), 1);
        Ok::<u64, globalsplat::Error>(result.steps)
    };
    for nothing_yet in [
        |event: &RefineEvent| matches!(event, RefineEvent::Loading { .. }),
        |event: &RefineEvent| *event == RefineEvent::Starting(0),
    ] {
        let why = steps(nothing_yet).unwrap_err().to_string();
        assert!(why.starts_with("stopped before") && why.ends_with("nothing is written"), "{why}");
    }
    assert_eq!(steps(|event| *event == RefineEvent::Starting(2)).unwrap(), 0);
    let tenth = |event: &RefineEvent| matches!(event, RefineEvent::Optimizing { steps: 10, .. });
    assert_eq!(steps(tenth).unwrap(), 10);
}

/// A refinement that continues from the state of a stopped one ends with the bytes of one without a break.
#[test]
fn a_continued_refinement_equals_one_without_a_break() {
    let (folder, room) = room();
    let capture = open_capture(&room).unwrap();
    // Enough steps for the number of Gaussians to grow, before and after the break.
    let options = |steps| RefineOptions {
        set: vec!["sh_every=0.2".into()],
        steps: Some(steps),
        gaussians: Some(300),
        correct_poses: true,
        correct_exposures: ExposureCorrection::On,
        size: Some(PhotoSize::Within(48)),
        ..RefineOptions::default()
    };
    let whole = options(500);
    // Returns the result of a session that is ended after `ends_at` steps.
    fn run(
        capture: &Capture,
        options: &RefineOptions,
        init: SceneInit,
        ends_at: u64,
    ) -> globalsplat::Result<RefineResult> {
        let is_end = move |event: RefineEvent| matches!(event, RefineEvent::Optimizing { steps, .. } if steps == ends_at);
        let mut session = RefineSession::load(capture, options, init, move |event| !is_end(event))?;
        session.start()?;
        session.run()
    }
    let unbroken = run(&capture, &whole, SceneInit::Photos, 500).unwrap();
    let file = folder.path().join("room.state.safetensors");
    // The second break is among the last steps, over which the parameters are averaged.
    for (ends_at, counts) in [(170, 61..300), (430, 300..301)] {
        let stopped = run(&capture, &whole, SceneInit::Photos, ends_at).unwrap();
        stopped.state.unwrap().write(&file).unwrap();
        let state = RefineState::read(&file).unwrap();
        assert_eq!((state.steps(), state.count()), (ends_at, stopped.gaussians.count() as usize));
        assert!(counts.contains(&state.count()), "{}", state.count());
        let continued = run(&capture, &whole, SceneInit::State(&state), 500).unwrap();
        assert_eq!((continued.steps, continued.corrections.len()), (500, unbroken.corrections.len()));
        assert!(continued.splat == unbroken.splat);
    }
    let state = RefineState::read(&file).unwrap();

    // What doesn't fit is refused in a sentence.
    let refusal = |options: &RefineOptions| {
        let error = run(&capture, options, SceneInit::State(&state), 0).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        error.to_string().replace(&format!("{}/", folder.path().display()), "")
    };
    assert_eq!(
        refusal(&options(430)),
        "room.state.safetensors: the refinement is one of 430 steps already, expected more steps in all"
    );
    let others = RefineOptions { holdout: Holdout::Every { every: 4, first: 0 }, ..whole.clone() };
    let message = refusal(&others);
    assert!(
        message.starts_with("room.state.safetensors: the list of photos is that of another refinement, "),
        "{message}"
    );
    write_splat(&folder.path().join("a.ply"), &unbroken.splat).unwrap();
    let error = RefineState::read(&folder.path().join("a.ply")).unwrap_err();
    assert!(error.is_invalid_request(), "{error}");
}

/// The program continues a refinement and logs it for TensorBoard.
#[test]
fn a_refinement_is_continued_and_logged() {
    let (folder, room) = room();
    let (out, log) = (folder.path().join("a.ply"), folder.path().join("log"));
    let refine = |steps: &str| {
        let arguments =
            ["refine", "--scene", arg(&room), "--out", arg(&out), "--gaussians", "200", "--size", "48"];
        let more = ["--holdout", "every:4", "--steps", steps, "--resume", "--log", arg(&log), "--json"];
        command(&[&arguments[..], &more].concat()).output().unwrap()
    };
    let lines = || -> Vec<Value> {
        let text = std::fs::read_to_string(log.join("metrics.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    };
    let steps_with = |key: &str| -> Vec<u64> {
        lines()
            .iter()
            .filter(|line| line.get(key).is_some())
            .map(|line| line["step"].as_u64().unwrap())
            .collect()
    };
    let first = refine("120");
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(steps_with("loss"), [49, 99]);
    let state = RefineState::read(&folder.path().join("a.state.safetensors")).unwrap();
    assert_eq!((state.steps(), state.count()), (120, 200));

    let second = refine("200");
    assert_eq!(serde_json::from_slice::<Value>(&second.stdout).unwrap()["steps"], 200);
    let message = String::from_utf8_lossy(&second.stderr);
    assert!(message.contains("a.state.safetensors: continues after 120 steps"), "{message}");
    assert_eq!(steps_with("loss"), [49, 99, 149, 199]);
    assert!(!steps_with("validation").is_empty());
    let third = refine("200");
    let message = String::from_utf8_lossy(&third.stderr);
    assert!(
        third.status.code() == Some(2) && message.contains("the refinement is one of 200 steps already"),
        "{message}"
    );
}

/// A splat that is optimized for antialiased rendering is marked, and keeps the mark when it is continued or refined.
#[test]
fn antialiased_splats_keep_their_mark() {
    let (folder, room) = room();
    let scene = arg(&room).to_string();
    let refine = |out: &Path, options: &[&str]| {
        run_json(&[&["refine", "--scene", &scene, "--out", arg(out), "--json"][..], options].concat());
        read_splat(out).unwrap().antialiased
    };
    let [plain, marked, again] =
        ["plain.ply", "marked.ply", "again.spz"].map(|name| folder.path().join(name));
    let initial = ["--gaussians", "500", "--steps", "20"];
    assert!(!refine(&plain, &initial));
    assert!(refine(&marked, &[&initial[..], &["--antialiased", "--resume"]].concat()));
    assert!(refine(&marked, &["--gaussians", "500", "--steps", "25", "--resume"]));
    assert!(refine(&again, &["--splat", arg(&marked), "--steps", "5"]));
    assert_eq!(run_json(&["inspect", arg(&again), "--json"])["antialiased"], true);
}

/// A capture scaled by a power of two gives bit-identical results up to the scale; one in any other unit, or far from the
/// origin, is reconstructed as well.
#[test]
fn units_and_origin_change_nothing() {
    let refined = |factor: f64, offset: DVec3| {
        let (folder, room) = room();
        rewrite_views(&room, |mut views| {
            let places = centres(&views);
            for (view, place) in views.iter_mut().zip(places) {
                put_centre(view, (DVec3::from(place) * factor + offset).to_array());
            }
            views
        });
        let out = folder.path().join("a.ply");
        let options = ["--gaussians", "500", "--steps", "40", "--json", "--holdout", "every:3+1"];
        let done = run_json(&[&["refine", "--scene", arg(&room), "--out", arg(&out)][..], &options].concat());
        (number(&done, "/held_out/after/psnr"), Gaussians::from_splat(&read_splat(&out).unwrap()))
    };
    let (plain, gaussians) = refined(1., DVec3::ZERO);
    for exponent in [-20, -3, 10] {
        let factor = f64::from(exponent).exp2();
        let (psnr, scaled) = refined(factor, DVec3::ZERO);
        assert_eq!(psnr, plain, "2^{exponent}");
        assert!((&scaled.means / factor).equal(&gaussians.means), "2^{exponent}");
        assert!(
            scaled.opacities.equal(&gaussians.opacities) && scaled.sh.equal(&gaussians.sh),
            "2^{exponent}"
        );
    }
    for (factor, offset) in [(1e-3, DVec3::ZERO), (1e5, DVec3::ZERO), (1., DVec3::new(4.5e5, 5.4e6, 135.))] {
        let (psnr, _) = refined(factor, offset);
        assert!((psnr - plain).abs() < 1.5, "{factor} {offset}: {psnr}, plainly {plain}");
    }
}

/// A splat is improved, or kept unchanged if it can't be.
#[test]
fn a_splat_becomes_better_or_stays() {
    let (folder, room) = room();
    let (ground_truth, dull, out) =
        (room.join("truth.ply"), folder.path().join("dull.ply"), folder.path().join("a.ply"));
    let mut splat = read_splat(&ground_truth).unwrap();
    splat.sh.as_flattened_mut().iter_mut().for_each(|coefficient| *coefficient *= 0.5);
    write_splat(&dull, &splat).unwrap();
    let refined = |from: &Path| {
        let steps = ["--steps", "150", "--json"];
        run_json(
            &[&["refine", "--splat", arg(from), "--scene", arg(&room), "--out", arg(&out)][..], &steps]
                .concat(),
        )
    };
    let done = refined(&dull);
    let (before, after) = (number(&done, "/shown/before/psnr"), number(&done, "/shown/after/psnr"));
    assert!(after > before + 5., "{before} → {after}");
    assert_eq!(done["held_out"], Value::Null);
    assert_eq!(read_splat(&out).unwrap().len(), splat.len());
    // Its photos are its own renders: no splat is better.
    let done = refined(&ground_truth);
    assert_eq!(done["shown"]["before"], done["shown"]["after"]);
    assert!(number(&done, "/shown/after/psnr") > 55.);
}

/// On real photos, held-out views score far above the baseline that uses the input photos.
#[test]
fn real_photos_become_a_splat() {
    for capture in captures().unwrap_or_default() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a.ply");
        let done = run_json(&[
            "refine",
            "--scene",
            arg(&capture),
            "--out",
            arg(&out),
            "--holdout",
            "every:3+1",
            "--size",
            "128x128",
            "--gaussians",
            "8192",
            "--steps",
            "250",
            "--json",
        ]);
        let after = number(&done, "/held_out/after/psnr");
        assert!(after > 24., "{}: {after}", capture.display());
    }
}

/// Photos of several sizes, with lens distortion, and more of them than are used, are accepted.
#[test]
fn many_photos_are_used_as_they_are() {
    let Some(fox) = fox() else { return };
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a.ply");
    let done = run_json(&[
        "refine",
        "--scene",
        arg(&fox),
        "--out",
        arg(&out),
        "--views",
        "12",
        "--steps",
        "10",
        "--gaussians",
        "3000",
        "--json",
    ]);
    assert_eq!(done["photos"], 12);
}

/// Points of a COLMAP model, text or binary, initialize Gaussians.
#[test]
fn colmap_points_initialize_gaussians() {
    for format in [Format::ColmapText, Format::ColmapBinary] {
        let (_folder, room) = room();
        assert!(read_points(&open_capture(&room).unwrap()).unwrap().is_empty());
        let ground_truth = read_splat(&room.join("truth.ply")).unwrap();
        let means: Vec<f64> = ground_truth.means.as_flattened().iter().map(|&x| f64::from(x)).collect();
        rewrite(&room, format);
        let capture = open_capture(&room).unwrap();
        assert!(read_points(&capture).unwrap().is_empty());
        write_points(&room.join("sparse/0"), format, &means);
        let points = read_points(&capture).unwrap();
        assert_eq!(points.len() * 3, means.len());
        for (point, expected) in points.iter().zip(means.chunks(3)) {
            assert_eq!(point.position.to_array(), expected);
            assert_eq!(point.color, [1., 0., 0.2]);
        }
        // Nine tenths of the Gaussians are at points, the others on pixels.
        let views = load_all_views(&capture, None).unwrap();
        let off = ExposureCorrection::Off;
        let scene = gaussians_from_photos(&views, &points, 1000, 0, off, |_| true).expect("depths");
        let begun: Vec<f64> = Vec::try_from(scene.gaussians.means.to_kind(Kind::Double).view([-1])).unwrap();
        let at_points = begun
            .chunks(3)
            .filter(|mean| points.iter().any(|p| p.position.distance(DVec3::from_slice(mean)) < 1e-5));
        assert_eq!((begun.len(), at_points.count()), (3000, 900));
    }
}

/// Exposures of photos that differ from their neighbours are measured and corrected, unless this is turned off.
#[test]
fn uneven_exposures_are_corrected_from_photos() {
    let (folder, room) = room();
    let cameras: Value = serde_json::from_slice(&std::fs::read(room.join("cameras.json")).unwrap()).unwrap();
    let gain = |index: usize| [0.8f32, 1.1, 0.95][index % 3];
    let views = cameras["views"].as_array().unwrap();
    for (index, view) in views.iter().enumerate() {
        let photo = room.join(view["image"].as_str().unwrap());
        let picture = image::open(&photo).unwrap().to_rgb8();
        image::RgbImage::from_fn(picture.width(), picture.height(), |x, y| {
            image::Rgb(picture.get_pixel(x, y).0.map(|v| (f32::from(v) * gain(index)).round() as u8))
        })
        .save(&photo)
        .unwrap();
    }
    let out = folder.path().join("a.ply");
    let refined = |more: &[&str]| {
        let base = ["refine", "--scene", arg(&room), "--out", arg(&out), "--json", "--steps", "20"];
        run_json(&[&base[..], more].concat())
    };
    let corrected = refined(&[]);
    let photos = corrected["corrections"].as_array().unwrap();
    assert_eq!(photos.len(), views.len());
    for index in 1..photos.len() {
        let exposure = |index: usize| number(&corrected, &format!("/corrections/{index}/exposure/1"));
        let (found, expected) = (exposure(index) / exposure(0), f64::from(gain(index) / gain(0)));
        assert!((found / expected - 1.).abs() < 0.05, "photo {index}: {found} is not {expected}");
    }
    assert_eq!(refined(&["--correct-exposures=off"])["corrections"], serde_json::json!([]));
}

/// Small pose errors and exposure differences are estimated, for a room whose splat is known.
#[test]
fn pose_and_exposure_errors_are_corrected() {
    let (folder, room) = room();
    let out = folder.path().join("a.ply");
    let file = room.join("cameras.json");
    let mut cameras: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let views = cameras["views"].as_array_mut().unwrap();
    // Alternating shifts, so that the mean doesn't change.
    let shift = 0.03;
    let last = views.len() - views.len() % 2;
    for (index, view) in views[..last].iter_mut().enumerate() {
        let x = &mut view["c2w"][0][3];
        *x = (x.as_f64().unwrap() + if index % 2 == 0 { shift } else { -shift }).into();
    }
    std::fs::write(&file, cameras.to_string()).unwrap();
    let photo = room.join(cameras["views"][0]["image"].as_str().unwrap());
    let picture = image::open(&photo).unwrap().to_rgb8();
    image::RgbImage::from_fn(picture.width(), picture.height(), |x, y| {
        image::Rgb(picture.get_pixel(x, y).0.map(|v| (f32::from(v) * 0.8).round() as u8))
    })
    .save(&photo)
    .unwrap();
    let refined = |more: &[&str]| {
        let ground_truth = room.join("truth.ply");
        let base =
            ["refine", "--splat", arg(&ground_truth), "--scene", arg(&room), "--out", arg(&out), "--json"];
        let steps = ["--steps", "300", "--set", "lr_means=1e-4", "--set", "lr_poses=2e-3"];
        run_json(&[&base[..], &steps, more].concat())
    };
    let (uncorrected, corrected) = (refined(&[]), refined(&["--correct-poses", "--correct-exposures"]));
    assert_eq!(uncorrected["corrections"], serde_json::json!([]));
    let [before, after] = [&uncorrected, &corrected].map(|done| number(done, "/shown/after/psnr"));
    assert!(after > before + 3., "{before} → {after}");
    let of = &corrected["corrections"];
    assert_eq!(of.as_array().unwrap().len(), cameras["views"].as_array().unwrap().len());
    let exposure = number(of, "/0/exposure/1") / number(of, "/1/exposure/1");
    assert!((exposure - 0.8).abs() < 0.03, "{exposure}");
}

#[test]
fn invalid_refinements_are_refused_with_one_sentence() {
    let (folder, room) = room();
    let out = folder.path().join("a.ply");
    let base = ["refine", "--scene", arg(&room), "--out", arg(&out)];
    let with = |more: &[&str]| refuse(&[&base[..], more].concat());
    assert!(with(&["--set", "view=3"]).contains("--set view=3: unknown field"));
    assert!(with(&["--set", "views=\"a\""]).contains("--set views"));
    assert!(with(&["--set", "views"]).contains("expected KEY=VALUE"));
    for value in
        ["views=0", "sh_every=0", "resolution_schedule=[0.1,0.1]", "lr_means=nan", "prune_opacity=-1"]
    {
        assert!(with(&["--set", value]).contains(&format!("--set {value}: expected ")));
    }
    assert!(with(&["--seconds", "0"]).contains("seconds is 0, expected more than 0"));
    assert!(with(&["--seconds", "1e300"]).contains("seconds is 1000"));
    for size in ["64x8", "10x10", "2000x1", "8", "64x", "-3"] {
        let expected =
            "expected the longer side, as in 1600, or WxH, as in 640x480, with sides of 11 to 16384";
        let output = command(&[&base[..], &[&format!("--size={size}")]].concat()).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains(expected), "{size}: {message}");
    }
    assert!(with(&["--init", "photos", "--weights", "a.safetensors"]).contains("uses no weights"));
    assert!(with(&["--views", "1"]).contains("--views is 1, expected 2 or more"));
    // A splat elsewhere.
    let away = folder.path().join("away.ply");
    let mut splat = read_splat(&room.join("truth.ply")).unwrap();
    splat.means.as_flattened_mut().iter_mut().for_each(|coordinate| *coordinate -= 1000.);
    write_splat(&away, &splat).unwrap();
    assert!(with(&["--splat", arg(&away)]).contains("no camera sees"));
    assert!(!out.exists());
}

/// Images as narrow as SSIM allows are accepted; narrower ones are refused before they are read.
#[test]
fn narrow_photos_are_taken_or_refused() {
    let (folder, room) = room();
    let out = folder.path().join("a.ply");
    let options = ["--gaussians", "300", "--steps", "0", "--size", "400x11"];
    succeed(&[&["refine", "--scene", arg(&room), "--out", arg(&out)][..], &options].concat());
    let options = ["--gaussians", "300", "--steps", "3", "--size", "400x11"];
    succeed(&[&["refine", "--scene", arg(&room), "--out", arg(&out)][..], &options].concat());
    for entry in std::fs::read_dir(room.join("images")).unwrap() {
        let path = entry.unwrap().path();
        image::open(&path).unwrap().crop_imm(0, 0, 40, 10).save(&path).unwrap();
    }
    rewrite_views(&room, |mut views| {
        views.iter_mut().for_each(|view| view["intrinsic"][1][2] = 5.into());
        views
    });
    let file = room.join("cameras.json");
    let mut cameras: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    cameras["image_shape"] = vec![10, 40].into();
    std::fs::write(&file, cameras.to_string()).unwrap();
    let why = crate::common::program::fail(&["refine", "--scene", arg(&room), "--out", arg(&out)], 2);
    assert!(why.contains("40×10, expected 11 pixels or more along each side"), "{why}");
}
