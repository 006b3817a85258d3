//! Refinement of splats on photos improves held-out views, is bit-identical with any number of threads, and reports impossible
//! requests in one sentence.

use crate::common::formats::{Format, rewrite, write_colmap_binary, write_points};
use crate::common::program::{Sandbox, WAIT_PASSIVELY, arg, assert_says, number, run_process};
use crate::common::{captures, fox, write_script};
use glam::{DVec3, DVec4};
use globalsplat::data::{
    Capture, Holdout, PhotoSize, load_all_views, open_capture, read_points, write_cameras_json,
};
use globalsplat::io::{read_splat, read_weights, write_splat, write_weights};
use globalsplat::refine::{
    ExposureCorrection, RefineEvent, RefineOptions, RefineResult, RefineSession, RefineState, SceneInit,
    gaussians_from_photos,
};
use globalsplat::scene::{Camera, Gaussians};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};
use tch::{Kind, Tensor};

/// Returns a folder with a video of a synthetic scene, `@world/000000.torch#7_000000`.
fn world(size: u32) -> Sandbox {
    let sandbox = Sandbox::empty();
    sandbox.run(&format!("synth --out @world --seed 7 --frames 12 --size {size}"));
    sandbox
}

/// Asserts that the PSNR of `scores` grows by more than `gain` dB, and returns the new one.
#[track_caller]
fn assert_improved(scores: &Value, gain: f64) -> f64 {
    let [before, after] = ["/before/psnr", "/after/psnr"].map(|path| number(scores, path));
    assert!(after > before + gain, "{before} → {after}");
    after
}

/// Returns the mean PSNR of these views of the room.
fn psnr_of(sandbox: &Sandbox, eval: &str, views: &[usize]) -> f64 {
    let scores = sandbox.json(eval);
    views.iter().map(|view| number(&scores, &format!("/views/{view}/psnr"))).sum::<f64>() / views.len() as f64
}

/// Refinement from photos alone shows held-out views better than the initial Gaussians do, and writes the splat.
#[test]
fn photos_alone_become_a_splat() {
    let sandbox = world(64);
    let done = sandbox.json(
        "refine --scene @world/000000.torch#7_000000 --out @a.ply --holdout every:4+1 --gaussians 2000 --steps 120 \
         --contact-sheet @a.png",
    );
    let after = assert_improved(&done["held_out"], 3.);
    assert_eq!((&done["gaussians"], &done["steps"]), (&json!(2000), &json!(120)));
    let curve = done["held_out"]["curve"].as_array().unwrap();
    assert!(curve.last().unwrap()["psnr"] == done["held_out"]["after"]["psnr"]);
    // The reported scores are those of the written splat.
    let scored = psnr_of(&sandbox, "eval --splat @a.ply --scene @world/000000.torch#7_000000", &[1, 5, 9]);
    assert!((scored - after).abs() < 0.01, "{scored}, told {after}");
    assert!(sandbox.path("a.png").is_file());
}

/// A refinement from a model's reconstruction improves it and has the requested number of Gaussians, even if these are fewer than the model's.
#[test]
fn a_reconstruction_becomes_a_splat_of_the_requested_size() {
    let done = world(64).json(
        "refine --scene @world/000000.torch#7_000000 --out @a.ply --init model --gaussians 4000 --steps 300 \
         --holdout every:4+1",
    );
    assert_improved(&done["held_out"], 1.);
    assert_eq!(done["gaussians"], 4000);
}

/// A view off the path is scored over the pixels that the photos cover, and its depth by the exact depth.
#[test]
fn views_off_the_path_are_scored_where_photos_cover_them() {
    let sandbox = Sandbox::empty();
    sandbox.run("synth --scenes 1 --frames 8 --off-path 3 --size 64 --depth --out @off");
    sandbox.run("refine --scene @off/0_000000 --gaussians 400 --steps 40 --out @a.ply");
    let eval = "eval --splat @a.ply --scene @off/0_000000 --holdout none --depth @off/depth/0_000000.npy";
    let [all, covered] = [eval.into(), format!("{eval} --covered")].map(|line: String| sandbox.json(&line));
    assert_eq!((all["views"].as_array().unwrap().len(), all.get("pixel_fraction")), (3, None));
    let fraction = number(&covered, "/pixel_fraction");
    assert!(0.05 < fraction && fraction < 0.95, "{fraction}");
    assert!(number(&covered, "/depth_error") < number(&all, "/depth_error"), "{covered} {all}");
    assert!(number(&all, "/cc_psnr") > number(&all, "/psnr"));
    sandbox.run("synth --scenes 1 --frames 8 --size 64 --depth --out @path");
    let other = eval.replace("@off/depth", "@path/depth");
    let expected = "the shape is [8, 64, 64], expected [11, 64, 64], that of the photos";
    assert_says(&sandbox.refuse(&other), &[expected]);
    let whole = sandbox.read("off/depth/0_000000.npy");
    let end = 10 + usize::from(whole[8]) + 256 * usize::from(whole[9]);
    let (header, numbers) = whole.split_at(end);
    let header = std::str::from_utf8(&header[10..]).unwrap();
    let changed = |from: &str, to: &str, numbers: &[u8]| {
        let header = header.replace(from, to);
        assert_eq!(header.len() + 10, end);
        sandbox.write("changed.npy", [&whole[..10], header.as_bytes(), numbers].concat());
        eval.replace("@off/depth/0_000000.npy", "@changed.npy")
    };
    let negative = [&numbers[..numbers.len() - 4], &(-1f32).to_le_bytes()].concat();
    for (from, to, numbers, expected) in [
        ("False, ", "True,  ", numbers, "the order is Fortran's, expected C's"),
        ("", "", &negative, "a depth is -1, expected 0 or more"),
    ] {
        assert_says(&sandbox.refuse(&changed(from, to, numbers)), &[expected]);
    }
    let doubles = numbers.as_chunks().0.iter().flat_map(|&z| f64::from(f32::from_le_bytes(z)).to_le_bytes());
    let wide = sandbox.json(&changed("<f4", "<f8", &doubles.collect::<Vec<_>>()));
    assert_eq!(number(&wide, "/depth_error"), number(&all, "/depth_error"));
}

/// Commands leave out what the masks in a folder cover.
#[test]
fn masks_in_a_folder_are_left_out() {
    let sandbox = Sandbox::new();
    // The left half of each photo is painted over.
    let paint = image::RgbImage::from_pixel(20, 40, image::Rgb([255, 0, 255]));
    let mask = image::GrayImage::from_fn(40, 40, |x, _| image::Luma([if x < 20 { 0 } else { 255 }]));
    std::fs::create_dir_all(sandbox.path("masks/images")).unwrap();
    for name in sandbox.names("room/images") {
        let file = sandbox.path("room/images").join(&name);
        let mut photo = image::open(&file).unwrap().to_rgb8();
        image::imageops::replace(&mut photo, &paint, 0, 0);
        photo.save(file).unwrap();
        mask.save(sandbox.path("masks/images").join(name)).unwrap();
    }
    let eval = "eval --splat @room/truth.ply --scene @room";
    let masked = sandbox.json(&format!("{eval} --masks @masks"));
    let unmasked = sandbox.json(eval);
    assert!(number(&masked, "/psnr") > number(&unmasked, "/psnr") + 10., "{masked}");
    assert_eq!((number(&masked, "/pixel_fraction"), unmasked.get("pixel_fraction")), (0.5, None));
    let table = sandbox.succeed(&format!("{eval} --masks @masks"));
    assert!(
        table.ends_with("scored over 50.0 % of the pixels: the others are masked out or not covered\n"),
        "{table}"
    );

    // Over a background all pixels count: the splat is opaque where the photos show black or white.
    let [black, white] = ["black", "white"]
        .map(|color| sandbox.json(&format!("{eval} --masks @masks --mask-background {color}")));
    assert!([&black, &white].iter().all(|scores| scores.get("pixel_fraction").is_none()));
    assert!(number(&masked, "/psnr") > number(&black, "/psnr") + 3., "{black}");
    assert!((number(&black, "/psnr") - number(&white, "/psnr")).abs() > 1., "{black} {white}");

    let bytes = |line: &str| {
        sandbox.run(&format!("{line} --scene @room --out @out.ply"));
        sandbox.read("out.ply")
    };
    assert!(bytes("reconstruct --views 2 --masks @masks") != bytes("reconstruct --views 2"));
    let refine = "refine --steps 3 --gaussians 200 --masks @masks";
    let ignored = bytes(refine);
    for color in ["black", "white", "random"] {
        assert!(bytes(&format!("{refine} --mask-background {color}")) != ignored, "{color}");
    }
}

/// Photos may have other names in the capture that is made of them, which has their masks.
#[test]
fn masks_of_photos_without_poses_are_those_of_their_capture() {
    let sandbox = Sandbox::new();
    let names = sandbox.names("room/images");
    for folder in ["photos", "masks"] {
        std::fs::create_dir(sandbox.path(folder)).unwrap();
    }
    for name in &names {
        let [photo, mask] = ["photos", "masks"].map(|folder| sandbox.path(folder).join(format!("a {name}")));
        std::fs::copy(sandbox.path("room/images").join(name), photo).unwrap();
        image::GrayImage::from_fn(40, 40, |x, _| image::Luma([if x < 20 { 0 } else { 255 }]))
            .save(mask)
            .unwrap();
    }
    // A COLMAP that knows the poses.
    let model = sandbox.path("model");
    let renamed: Vec<String> = names.iter().map(|name| format!("a_{name}")).collect();
    write_colmap_binary(&model, &renamed, &open_capture(&sandbox.path("room")).unwrap().cameras());
    write_points(&model, Format::ColmapBinary, &[0., 0., 1.]);
    let mapper = format!(
        "for word; do [ \"$last\" = --output_path ] && cp -r '{}' \"$word/0\"; last=$word; done",
        arg(&model)
    );
    let colmap = sandbox.path("colmap");
    write_script(&colmap, &format!("case $1 in help) echo COLMAP 3.9;; mapper) {mapper};; esac; exit 0"));
    for command in ["refine --steps 3 --gaussians 200", "reconstruct --views 2"] {
        let splat = |source: &str| {
            let mut command = sandbox.command(&format!("{command} {source} --out @a.ply"));
            run_process(command.env("GLOBALSPLAT_COLMAP", &colmap));
            sandbox.read("a.ply")
        };
        let masked = splat("--photos @photos --masks @masks");
        assert!(masked == splat("--scene @a_capture --masks @a_capture/masks"), "{command}");
        std::fs::rename(sandbox.path("a_capture/masks"), sandbox.path("hidden")).unwrap();
        assert!(masked != splat("--scene @a_capture"), "{command}");
        std::fs::rename(sandbox.path("hidden"), sandbox.path("a_capture/masks")).unwrap();
    }
}

/// The number of threads does not change the bytes with the same steps and seed; another seed gives others.
#[test]
fn threads_do_not_change_the_bytes() {
    let sandbox = world(48);
    // Enough steps to improve on the initial splat, which would be kept otherwise.
    for options in ["--gaussians 500", "--init model --gaussians 6000"] {
        let bytes = |threads: &str, seed: &str| {
            let line = format!(
                "refine --scene @world/000000.torch#7_000000 --out @a.ply --steps 120 --seed {seed} \
                 --set relocate_every=7 {options}"
            );
            let done =
                sandbox.command(&line).envs([("OMP_NUM_THREADS", threads), WAIT_PASSIVELY]).output().unwrap();
            assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
            sandbox.read("a.ply")
        };
        let one = bytes("1", "3");
        assert!(one == bytes("3", "3"), "{options}: threads change the bytes");
        assert!(one != bytes("1", "4"), "{options}: another seed changes nothing");
    }
}

/// A photo's name, and its camera.
type View = (String, Camera);

/// Changes the room's cameras.json.
fn change_views(sandbox: &Sandbox, change: impl FnOnce(Vec<View>) -> Vec<View>) {
    let capture = open_capture(&sandbox.path("room")).unwrap();
    let views = capture.names().map(String::from).zip(capture.cameras()).collect();
    let (names, cameras): (Vec<String>, Vec<Camera>) = change(views).into_iter().unzip();
    write_cameras_json(&sandbox.path("room/cameras.json"), &names, &cameras).unwrap();
}

fn center((_, camera): &View) -> DVec3 {
    camera.c2w.w_axis.truncate()
}

/// Multiplies the pixels of a photo of the room by `gain`.
fn dim(sandbox: &Sandbox, photo: &str, gain: f32) {
    let file = sandbox.path("room").join(photo);
    let mut picture = image::open(&file).unwrap().to_rgb8();
    picture.iter_mut().for_each(|v| *v = (f32::from(*v) * gain).round() as u8);
    picture.save(&file).unwrap();
}

/// Repeated photos, from exactly the same position or from nearby positions, as of a camera at rest, change the result only by
/// chance.
#[test]
fn photos_of_one_place_count_once() {
    let reached = |copies: usize, jitter: f64| {
        let sandbox = Sandbox::new();
        let whole = sandbox.read("room/cameras.json");
        change_views(&sandbox, |views| {
            let shown: Vec<View> =
                views.into_iter().enumerate().filter(|(i, _)| i % 3 != 1).map(|(_, view)| view).collect();
            let extent = shown.iter().map(|view| center(view).distance(center(&shown[0]))).fold(0., f64::max);
            let copy = |(index, view): (usize, &View), copy: usize| {
                let mut view = view.clone();
                // Offsets are within a ball; the first copy is at the original position.
                let phase = (7 * index + 13 * copy) as f64;
                let off = DVec3::new(phase.sin(), (1.7 * phase).cos(), (2.3 * phase).sin()) * jitter * extent;
                view.1.c2w.w_axis += if copy == 0 { DVec4::ZERO } else { off.extend(0.) };
                view
            };
            (0..copies).flat_map(|k| shown.iter().enumerate().map(move |of| copy(of, k))).collect()
        });
        sandbox.run("refine --scene @room --out @a.ply --gaussians 2000 --steps 200");
        sandbox.write("room/cameras.json", whole);
        psnr_of(&sandbox, "eval --splat @a.ply --scene @room", &[1, 4, 7])
    };
    let plain = reached(1, 0.);
    for (copies, jitter) in [(2, 0.), (5, 1e-4), (3, 1e-2)] {
        let copied = reached(copies, jitter);
        assert!((copied - plain).abs() < 1.5, "{copies} copies, {jitter}: {copied}, without them {plain}");
    }
}

/// Cameras that don't move give no depth: the verdict says so, and on request the photos are placed at one distance.
#[test]
fn photos_from_one_place_are_shown_at_one_distance() {
    let sandbox = Sandbox::new();
    change_views(&sandbox, |mut views| {
        let first = views[0].1.c2w;
        views.iter_mut().for_each(|(_, camera)| camera.c2w.w_axis = first.w_axis);
        // Otherwise all of them would be near duplicates, which is fine.
        views[1].1.c2w = first;
        views
    });
    let refine = "refine --scene @room --out @a.ply --gaussians 500 --steps 20";
    let refused = sandbox.fail(refine, 1);
    assert_says(&refused, &["will fail: the photos were taken from one place", "--ignore-verdict"]);
    assert!(!sandbox.path("a.ply").exists());
    sandbox.run(&format!("{refine} --ignore-verdict"));
    let means = read_splat(&sandbox.path("a.ply")).unwrap().means;
    assert!(means.as_flattened().iter().all(|coordinate| coordinate.is_finite()));
    let refused = sandbox.refuse("eval --splat @a.ply --scene @room --covered");
    assert_says(&refused, &["every view to score is masked out or not covered as a whole"]);
}

/// Runs a session until an event for which `is_end` returns `true`.
fn run_until(
    capture: &Capture,
    options: &RefineOptions,
    init: SceneInit,
    is_end: impl Fn(&RefineEvent) -> bool,
) -> globalsplat::Result<RefineResult> {
    let mut session = RefineSession::load(capture, options, init, |event| !is_end(&event))?;
    session.start()?;
    session.run()
}

/// An interrupted refinement returns a splat at any time, once there is one.
#[test]
fn an_interrupted_refinement_returns_its_gaussians() {
    let sandbox = Sandbox::new();
    let capture = open_capture(&sandbox.path("room")).unwrap();
    let options = RefineOptions { steps: Some(1_000_000), gaussians: Some(300), ..RefineOptions::default() };
    type IsEnd = fn(&RefineEvent) -> bool;
    // The events that end the session, and the number of steps of its result, if it has one.
    let cases: [(IsEnd, Option<u64>); 4] = [
        (|event| matches!(event, RefineEvent::Loading { .. }), None),
        (|event| *event == RefineEvent::Starting(0), None),
        (|event| *event == RefineEvent::Starting(2), Some(0)),
        (|event| matches!(event, RefineEvent::Optimizing { steps: 10, .. }), Some(10)),
    ];
    for (is_end, steps) in cases {
        let result = run_until(&capture, &options, SceneInit::Photos, is_end);
        let Some(steps) = steps else {
            let why = result.unwrap_err().to_string();
            assert!(why.starts_with("stopped before") && why.ends_with("nothing is written"), "{why}");
            continue;
        };
        let result = result.unwrap();
        // Their number has hardly begun to grow from a fifth.
        assert_eq!((result.steps, result.gaussians.count()), (steps, 60));
        assert_eq!(result.gaussians.means.isfinite().all().int64_value(&[]), 1);
    }
}

/// A refinement that continues from the state of a stopped one ends with the bytes of one without a break.
#[test]
fn a_continued_refinement_equals_one_without_a_break() {
    let sandbox = Sandbox::new();
    let capture = open_capture(&sandbox.path("room")).unwrap();
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
    let run = |options: &RefineOptions, init: SceneInit, last: u64| {
        run_until(
            &capture,
            options,
            init,
            |event| matches!(event, RefineEvent::Optimizing { steps, .. } if *steps == last),
        )
    };
    let whole = options(500);
    let unbroken = run(&whole, SceneInit::Photos, 500).unwrap();
    let file = sandbox.path("room.state.safetensors");
    // The second break is among the last steps, over which the parameters are averaged.
    for (last, counts) in [(170, 61..300), (430, 300..301)] {
        let stopped = run(&whole, SceneInit::Photos, last).unwrap();
        stopped.state.unwrap().write(&file).unwrap();
        let state = RefineState::read(&file).unwrap();
        assert_eq!((state.steps(), state.count()), (last, stopped.gaussians.count() as usize));
        assert!(counts.contains(&state.count()), "{}", state.count());
        let continued = run(&whole, SceneInit::State(&state), 500).unwrap();
        assert_eq!((continued.steps, continued.corrections.len()), (500, unbroken.corrections.len()));
        assert!(continued.splat == unbroken.splat);
    }
    let state = RefineState::read(&file).unwrap();

    // What doesn't fit is refused in a sentence.
    let others = RefineOptions { holdout: Holdout::Every { every: 4, first: 0 }, ..whole.clone() };
    for (options, expected) in [
        (options(430), "the refinement is one of 430 steps already, expected more steps in all"),
        (others, "the list of photos is that of another refinement, "),
    ] {
        let error = run(&options, SceneInit::State(&state), 0).unwrap_err();
        assert!(error.is_invalid_request(), "{error}");
        assert_says(&error.to_string(), &["room.state.safetensors: ", expected]);
    }
    write_splat(&sandbox.path("a.ply"), &unbroken.splat).unwrap();
    assert!(RefineState::read(&sandbox.path("a.ply")).unwrap_err().is_invalid_request());
}

/// The program continues a refinement and logs it for TensorBoard.
#[test]
fn a_refinement_is_continued_and_logged() {
    let sandbox = Sandbox::new();
    let refine = "refine --scene @room --out @a.ply --gaussians 200 --size 48 --holdout every:4 --resume --log @log --json";
    let steps_with = |key: &str| -> Vec<u64> {
        let text = sandbox.text("log/metrics.jsonl");
        let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.filter(|line| line.get(key).is_some()).map(|line| line["step"].as_u64().unwrap()).collect()
    };
    sandbox.run(&format!("{refine} --steps 120"));
    assert_eq!(steps_with("loss"), [49, 99]);
    let state = RefineState::read(&sandbox.path("a.state.safetensors")).unwrap();
    assert_eq!((state.steps(), state.count()), (120, 200));

    let (_, out, message) = sandbox.output(&format!("{refine} --steps 200"));
    assert_eq!(serde_json::from_str::<Value>(&out).unwrap()["steps"], 200);
    assert_says(&message, &["a.state.safetensors: continues after 120 steps"]);
    assert_eq!(steps_with("loss"), [49, 99, 149, 199]);
    assert!(!steps_with("validation").is_empty());
    // Another refinement is appended, after a line that a kill cut short; one without its photos touches no file.
    let log = sandbox.text("log/metrics.jsonl");
    sandbox.write("log/metrics.jsonl", format!("{log}{{\"gaussians\":20"));
    sandbox.run("refine --scene @room --out @b.ply --gaussians 200 --size 48 --steps 60 --log @log");
    assert_eq!(steps_with("loss"), [49, 99, 149, 199, 49]);
    let before = sandbox.contents();
    let message = sandbox.refuse(&format!("{refine} --steps 200"));
    assert_says(&message, &["the refinement is one of 200 steps already"]);
    sandbox.write("room/images/003.png", "no image");
    sandbox.refuse("refine --scene @room --out @b.ply --steps 60 --log @log");
    sandbox.write("room/images/003.png", &before[&sandbox.path("room/images/003.png")]);
    assert!(sandbox.contents() == before);
}

/// A state names what it came from, and continues nothing else.
#[test]
fn a_state_continues_only_its_own_refinement() {
    let sandbox = Sandbox::new();
    sandbox.copy("room/truth.ply", "splat.ply");
    let from_photos = "refine --scene @room --out @a.ply --gaussians 60 --size 36 --resume --steps";
    let from_splat = "refine --scene @room --out @b.ply --splat @splat.ply --resume --steps";
    let in_place = "refine --scene @room --out @room/truth.ply --splat @room/truth.ply --resume --steps";
    // The splats are dim, so that they are improved.
    (0..9).for_each(|index| dim(&sandbox, &format!("images/{index:03}.png"), 0.7));
    for line in [from_photos, from_splat, in_place] {
        sandbox.run(&format!("{line} 9"));
        sandbox.run(&format!("{line} 12"));
    }
    // The splat of a refinement in place that was killed after it wrote its state.
    let splat = sandbox.read("room/truth.ply");
    sandbox.run(&format!("{in_place} 14"));
    sandbox.write("room/truth.ply", splat);
    sandbox.run(&format!("{in_place} 16"));
    let refuse = |line: String, expected: &str| {
        let before = sandbox.contents();
        assert_says(&sandbox.refuse(&line), &[".state.safetensors: ", expected]);
        assert!(sandbox.contents() == before, "{line}");
    };
    for (options, expected) in [
        ("--antialiased", "antialiased is false, expected true, as requested"),
        ("--seed 1", "seed is 0, expected 1, as requested"),
        ("--correct-poses", "correct_poses is false, expected true, as requested"),
        ("--correct-exposures", "correct_exposures is \"auto\", expected \"on\", as requested"),
        ("--mask-background black", "mask_background is null, expected \"black\", as requested"),
        ("--set sh_degree=2", "sh_degree is null, expected 2, as requested"),
        ("--set lr_means=1e-3", "lr_means is 0.002, expected 0.001, as requested"),
        ("--init model", "the source of the Gaussians is the photos, expected the bundled model"),
        ("--holdout every:4", "the list of photos is that of another refinement, "),
    ] {
        refuse(format!("{from_photos} 15 {options}"), expected);
    }
    refuse(
        format!("{from_photos} 15 --splat @splat.ply").replace("--gaussians 60", ""),
        "the source of the Gaussians is the photos, expected the splat",
    );
    refuse(
        format!("{from_photos} 15").replace("36", "32"),
        "the size of the photos is 36 pixels, expected at most 32",
    );
    sandbox.run("convert @splat.ply @splat.ply --scale 1.01");
    refuse(format!("{from_splat} 15"), "the source of the Gaussians is the splat with the checksum ");
    dim(&sandbox, "images/004.png", 0.9);
    refuse(format!("{from_photos} 15"), "the checksum of images/004.png with its camera and mask is ");
}

/// Every field of a damaged state is refused.
#[test]
fn damaged_states_are_refused() {
    let sandbox = Sandbox::new();
    let file = sandbox.path("a.state.safetensors");
    let refine =
        "refine --scene @room --out @a.ply --gaussians 60 --size 24 --steps 9 --set relocate_until=0.5";
    sandbox.run(&format!("{refine} --resume --correct-poses"));
    let good = read_weights(&file).unwrap();
    let refuse = |tensors: &BTreeMap<String, Tensor>, metadata: HashMap<String, String>, expected: &str| {
        write_weights(&file, tensors, metadata).unwrap();
        let error = RefineState::read(&file).expect_err(expected);
        assert!(error.is_invalid_request(), "{error}");
        assert_says(&error.to_string(), &[&format!("a.state.safetensors: {expected}")]);
    };
    for (field, value, expected) in [
        ("/depth", json!(0), "depth is 0.0, expected a finite number above 0"),
        ("/depth", json!(-1.5), "depth is -1.5, expected"),
        ("/frame", json!([0, 0, 0, 0]), "frame is [0.0, 0.0, 0.0, 0.0], expected"),
        ("/growth/degrees", json!([0, 9]), "degrees is [0, 9], expected"),
        ("/growth/degrees", json!([1, 0]), "degrees is [1, 0], expected"),
        ("/growth/degree", json!(3), "degree is 3, expected"),
        ("/growth/first_count", json!(0), "first_count is 0, expected 1 up to the number of Gaussians"),
        ("/growth/first_count", json!(61), "first_count is 61, expected"),
        ("/growth/averaged_steps", json!(10), "averaged_steps is 10, expected at most the number of steps"),
        ("/progress/steps", json!(1u64 << 60), "steps is 1152921504606846976, expected"),
        ("/progress/time/secs", json!(u64::MAX), "time is 18446744073709551615."),
        ("/total/secs", json!(u64::MAX), "total is 18446744073709551615."),
        ("/photos", json!([]), "photos is [], expected one or more"),
        ("/photos/0", json!(7), "the metadata refinement is invalid (invalid type: integer `7`"),
    ] {
        let mut metadata = good.metadata.clone();
        let mut record: Value = serde_json::from_str(&metadata["refinement"]).unwrap();
        *record.pointer_mut(field).expect(field) = value;
        metadata.insert("refinement".into(), record.to_string());
        refuse(&good.tensors, metadata, expected);
    }
    type Damage = fn(&Tensor) -> Tensor;
    let missing: Damage = |_| Tensor::new();
    for (name, damage, expected) in [
        (
            "gaussians.value.means",
            (|t| t.flatten(0, -1)) as Damage,
            "Float of shape [180], expected Float of",
        ),
        ("gaussians.value.means", missing, "missing, expected Float of"),
        ("gaussians.value.means", |t| t / 0., "not finite, expected finite numbers"),
        (
            "gaussians.value.log_scales",
            |t| t.to_kind(Kind::Double),
            "Double of shape [1, 60, 3], expected Float",
        ),
        ("gaussians.value.quaternions", |t| t.narrow(2, 0, 3), "Float of shape [1, 60, 3], expected"),
        ("gaussians.value.shN", |t| t.narrow(2, 0, 2), "Float of shape [1, 60, 2, 3], expected"),
        ("gaussians.average.sh0", |t| t.narrow(1, 0, 59), "Float of shape [1, 59, 1, 3], expected"),
        ("gaussians.first.means", missing, "missing, expected Float of shape [1, 60, 3]"),
        ("gaussians.second.opacity_logits", |t| t - 1., "below 0, expected 0 or more"),
        ("gaussians.steps", |t| t + 1, "10, expected 9, the number of steps"),
        ("corrections.value.poses", |t| t.narrow(1, 0, 5), "Float of shape [9, 5], expected"),
        ("corrections.first.poses", missing, "missing, expected Float of shape [9, 6]"),
    ] {
        let damaged = damage(&good.tensors[name]);
        let tensor = |(key, t): (&String, &Tensor)| {
            (key.clone(), if key == name { &damaged } else { t }.shallow_clone())
        };
        let tensors = good.tensors.iter().map(tensor).filter(|(_, t)| t.defined());
        refuse(&tensors.collect(), good.metadata.clone(), &format!("tensor {name} is {expected}"));
    }
    refuse(
        &good.tensors,
        HashMap::new(),
        "the metadata refinement is missing, expected that of a refinement",
    );
}

/// A splat that is optimized for antialiased rendering is marked, and keeps the mark when it is continued or refined.
#[test]
fn antialiased_splats_keep_their_mark() {
    let sandbox = Sandbox::new();
    for (options, out, is_marked) in [
        ("--gaussians 500 --steps 20", "plain.ply", false),
        ("--gaussians 500 --steps 20 --antialiased --resume", "marked.ply", true),
        ("--gaussians 500 --steps 25 --resume", "marked.ply", true),
        ("--splat @marked.ply --steps 5", "again.spz", true),
    ] {
        sandbox.run(&format!("refine --scene @room {options} --out @{out}"));
        assert_eq!(read_splat(&sandbox.path(out)).unwrap().antialiased, is_marked, "{options}");
    }
    assert_eq!(sandbox.json("inspect @again.spz")["antialiased"], true);
}

/// A capture scaled by a power of two gives bit-identical results up to the scale; one in any other unit, or far from the
/// origin, is reconstructed as well.
#[test]
fn units_and_origin_change_nothing() {
    let refined = |factor: f64, offset: DVec3| {
        let sandbox = Sandbox::new();
        change_views(&sandbox, |mut views| {
            for view in &mut views {
                view.1.c2w.w_axis = (center(view) * factor + offset).extend(1.);
            }
            views
        });
        let done =
            sandbox.json("refine --scene @room --out @a.ply --gaussians 500 --steps 40 --holdout every:3+1");
        let splat = read_splat(&sandbox.path("a.ply")).unwrap();
        (number(&done, "/held_out/after/psnr"), Gaussians::from_splat(&splat))
    };
    let (plain, gaussians) = refined(1., DVec3::ZERO);
    for exponent in [-20, 10] {
        let factor = f64::from(exponent).exp2();
        let (psnr, scaled) = refined(factor, DVec3::ZERO);
        assert_eq!(psnr, plain, "2^{exponent}");
        assert!((&scaled.means / factor).equal(&gaussians.means), "2^{exponent}");
        assert!(
            scaled.opacities.equal(&gaussians.opacities) && scaled.sh.equal(&gaussians.sh),
            "2^{exponent}"
        );
    }
    for (factor, offset) in [(1e5, DVec3::ZERO), (1., DVec3::new(4.5e5, 5.4e6, 135.))] {
        let (psnr, _) = refined(factor, offset);
        assert!((psnr - plain).abs() < 1.5, "{factor} {offset}: {psnr}, plainly {plain}");
    }
}

/// A splat is improved, or kept unchanged if it can't be.
#[test]
fn a_splat_becomes_better_or_stays() {
    let sandbox = Sandbox::new();
    let mut splat = read_splat(&sandbox.path("room/truth.ply")).unwrap();
    splat.sh.as_flattened_mut().iter_mut().for_each(|coefficient| *coefficient *= 0.5);
    write_splat(&sandbox.path("dull.ply"), &splat).unwrap();
    let done = sandbox.json("refine --splat @dull.ply --scene @room --out @a.ply --steps 150");
    assert_improved(&done["train"], 5.);
    assert_eq!(done["held_out"], Value::Null);
    assert_eq!(read_splat(&sandbox.path("a.ply")).unwrap().len(), splat.len());
    // Its photos are its own renders: no splat is better.
    let done = sandbox.json("refine --splat @room/truth.ply --scene @room --out @a.ply --steps 50");
    assert_eq!(done["train"]["before"], done["train"]["after"]);
    assert!(number(&done, "/train/after/psnr") > 55.);
}

/// On real photos, held-out views score far above the baseline that uses the input photos. Photos of several sizes, with lens distortion, and
/// more of them than are used, are accepted.
#[test]
fn real_photos_become_a_splat() {
    let sandbox = Sandbox::empty();
    for capture in captures().unwrap_or_default().iter().take(2) {
        let done = sandbox.json(&format!(
            "refine --scene {} --out @a.ply --holdout every:3+1 --size 128x128 --gaussians 8192 --steps 250",
            arg(capture)
        ));
        let after = number(&done, "/held_out/after/psnr");
        assert!(after > 24., "{}: {after}", capture.display());
    }
    if let Some(fox) = fox() {
        let done = sandbox.json(&format!(
            "refine --scene {} --out @a.ply --views 12 --steps 10 --gaussians 3000",
            arg(&fox)
        ));
        assert_eq!(done["photos"], 12);
    }
}

/// Points of a COLMAP model, text or binary, initialize Gaussians.
#[test]
fn colmap_points_initialize_gaussians() {
    for format in [Format::ColmapText, Format::ColmapBinary] {
        let sandbox = Sandbox::new();
        let room = sandbox.path("room");
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
            assert_eq!((&point.position.to_array()[..], point.color), (expected, [1., 0., 0.2]));
        }
        // Nine tenths of the Gaussians are at points, the others on pixels.
        let views = load_all_views(&capture, None).unwrap();
        let off = ExposureCorrection::Off;
        let scene = gaussians_from_photos(&views, &points, 1000, 128., 0, off, |_| true).expect("depths");
        let begun: Vec<f64> = Vec::try_from(scene.gaussians.means.to_kind(Kind::Double).view([-1])).unwrap();
        let at_points = begun
            .chunks(3)
            .filter(|mean| points.iter().any(|p| p.position.distance(DVec3::from_slice(mean)) < 1e-5));
        assert_eq!((begun.len(), at_points.count()), (3000, 900));
    }
}

/// Exposures of photos that differ from their neighbours are corrected, unless this is turned off.
#[test]
fn uneven_exposures_are_corrected_from_photos() {
    let sandbox = Sandbox::new();
    (0..9).for_each(|index| dim(&sandbox, &format!("images/{index:03}.png"), [0.8, 1.1, 0.95][index % 3]));
    for (option, count) in [("", 9), ("--correct-exposures=off", 0)] {
        let done = sandbox.json(&format!("refine --scene @room --out @a.ply --steps 20 {option}"));
        assert_eq!(done["corrections"].as_array().unwrap().len(), count, "{option}");
    }
}

/// Small pose errors and exposure differences are estimated, for a room whose splat is known.
#[test]
fn pose_and_exposure_errors_are_corrected() {
    let sandbox = Sandbox::new();
    change_views(&sandbox, |mut views| {
        // Alternating shifts, so that the mean doesn't change.
        for (index, (_, camera)) in views[..8].iter_mut().enumerate() {
            camera.c2w.w_axis.x += if index % 2 == 0 { 0.03 } else { -0.03 };
        }
        views
    });
    dim(&sandbox, "images/000.png", 0.8);
    let refined = |more: &str| {
        sandbox.json(&format!(
            "refine --splat @room/truth.ply --scene @room --out @a.ply --steps 300 --set lr_means=1e-4 \
             --set lr_poses=2e-3 {more}"
        ))
    };
    let (uncorrected, corrected) = (refined(""), refined("--correct-poses --correct-exposures"));
    assert_eq!(uncorrected["corrections"], json!([]));
    let [before, after] = [&uncorrected, &corrected].map(|done| number(done, "/train/after/psnr"));
    assert!(after > before + 3., "{before} → {after}");
    let corrections = &corrected["corrections"];
    assert_eq!(corrections.as_array().unwrap().len(), 9);
    let exposure = number(corrections, "/0/exposure/1") / number(corrections, "/1/exposure/1");
    assert!((exposure - 0.8).abs() < 0.03, "{exposure}");
}

#[test]
fn invalid_refinements_are_refused_with_one_sentence() {
    let sandbox = Sandbox::new();
    let mut splat = read_splat(&sandbox.path("room/truth.ply")).unwrap();
    splat.means.as_flattened_mut().iter_mut().for_each(|coordinate| *coordinate -= 1000.);
    write_splat(&sandbox.path("elsewhere.ply"), &splat).unwrap();
    for (options, expected) in [
        ("--set view=3", "--set view=3: unknown field"),
        ("--seconds 1e300", "seconds is 1000"),
        ("--init photos --weights a.safetensors", "uses no weights"),
        ("--splat @elsewhere.ply", "no camera sees"),
    ] {
        assert_says(&sandbox.refuse(&format!("refine --scene @room --out @a.ply {options}")), &[expected]);
    }
    for size in ["64x8", "10x10", "2000x1", "8", "64x", "-3"] {
        let size = format!("--size={size}");
        let (code, message) =
            globalsplat::run(&["refine", "--scene", "room", "--out", "a.ply", &size]).unwrap_err();
        assert_eq!(code, 2, "{size}: {message}");
        let expected =
            "expected the longer side, as in 1600, or WxH, as in 640x480, with sides of 11 to 16384";
        assert_says(&message, &[expected]);
    }
    assert!(!sandbox.path("a.ply").exists());
}

/// Images as narrow as SSIM allows are accepted; narrower ones are refused before they are read.
#[test]
fn narrow_photos_are_taken_or_refused() {
    let sandbox = Sandbox::new();
    for steps in [0, 3] {
        sandbox
            .run(&format!("refine --scene @room --out @a.ply --gaussians 300 --steps {steps} --size 400x11"));
    }
    change_views(&sandbox, |mut views| {
        views.iter_mut().for_each(|(_, camera)| (camera.height, camera.intrinsics.cy) = (10, 5.));
        views
    });
    for index in 0..9 {
        let file = sandbox.path(&format!("room/images/{index:03}.png"));
        image::open(&file).unwrap().crop_imm(0, 0, 40, 10).save(&file).unwrap();
    }
    let error = sandbox.refuse("refine --scene @room --out @a.ply");
    assert_says(&error, &["40×10, expected 11 pixels or more along each side"]);
}
