//! Every command, run as a user runs it.

use crate::common::program::{
    Sandbox, TINY_CONFIG, WAIT_PASSIVELY, assert_says, number, run_process, send_signal, wait_for,
};
use crate::common::room::write_rooms;
use crate::common::{has_lpips, skip};
use serde_json::{Value, json};

/// Returns the names of a report's sections, all of which take time.
fn names(sections: &Value) -> Vec<&str> {
    let sections = sections.as_array().expect("a list");
    assert!(sections.iter().all(|section| number(section, "/milliseconds/least") > 0.));
    sections.iter().map(|section| section["name"].as_str().expect("a name")).collect()
}

#[test]
fn a_closed_stdout_ends_without_a_message() {
    let sandbox = Sandbox::new();
    let mut inspect = sandbox.command("inspect @room");
    inspect.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
    let mut program = inspect.spawn().unwrap();
    drop(program.stdout.take());
    let done = program.wait_with_output().unwrap();
    assert_eq!((done.status.code(), String::from_utf8_lossy(&done.stderr).as_ref()), (Some(1), ""));
}

/// `GLOBALSPLAT_SIMD` also limits libtorch and the choice of a precision, as on a processor without the hidden instructions.
#[test]
fn doctor_reports_the_installation() {
    let sandbox = Sandbox::empty();
    let report = sandbox.json("doctor");
    assert_eq!(report["devices"][0], "cpu");
    assert!(["avx512", "avx2", "neon", "portable"].contains(&report["simd"].as_str().unwrap()));
    assert!(report["libtorch"].as_str().unwrap().starts_with("2."));
    assert!(report["ffmpeg"].is_string() || report["ffmpeg"]["absent"].is_string());
    assert!(report["weights"]["lpips_vgg"]["absent"].is_string());
    assert_says(&report.to_string(), &["models/tiny.safetensors"]);
    for (level, libtorch) in [("avx2", "AVX2"), ("portable", "DEFAULT")] {
        if !cfg!(target_arch = "x86_64") {
            return;
        }
        let mut doctor = sandbox.command("doctor --json");
        // These tests themselves may run at a limited level.
        for limit in ["ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "MKL_ENABLE_INSTRUCTIONS"] {
            doctor.env_remove(limit);
        }
        let output = doctor.env("GLOBALSPLAT_SIMD", level).output().unwrap();
        if String::from_utf8_lossy(&output.stderr).contains("GLOBALSPLAT_SIMD is") {
            skip("AVX2", "the processor has none");
            continue;
        }
        let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(
            (&report["simd"], &report["libtorch_simd"], &report["precision"]),
            (&level.into(), &libtorch.into(), &"f32".into())
        );
    }
}

#[test]
fn threads_do_not_change_a_splat() {
    let sandbox = Sandbox::new();
    for precision in ["f32", "bf16"] {
        let splat = |threads: &str| {
            let line = format!("reconstruct --scene @room --precision {precision} --out @{threads}.ply");
            run_process(sandbox.command(&line).envs([("OMP_NUM_THREADS", threads), WAIT_PASSIVELY]));
            sandbox.read(&format!("{threads}.ply"))
        };
        assert!(splat("1") == splat("3"), "{precision}: threads change the bytes");
    }
}

#[test]
fn a_million_gaussians_fit_into_a_gigabyte() {
    let report =
        Sandbox::empty().json("bench raster --gaussians 1000000 --size 1920x1080 --cameras 1 --repeats 1");
    assert_eq!((number(&report, "/gaussians"), number(&report, "/width")), (1e6, 1920.));
    assert!(number(&report, "/stages/4/milliseconds/least") > 10., "an empty picture proves nothing");
    let bytes = number(&report, "/working_bytes");
    assert!((1e8..1e9).contains(&bytes), "{bytes} bytes of working memory");
}

#[test]
fn bench_train_reports_the_parts_of_a_step() {
    let sandbox = Sandbox::new();
    let parts = ["tokens", "encoder", "decoder", "render", "losses"];
    let backward =
        ["losses backward", "render backward", "decoder backward", "encoder backward", "tokens backward"];
    for (settings, first) in [
        ("", &["data", "zero gradients"][..]),
        (
            "--set train.micro_batch=2 --set train.checkpoint_rounds=true",
            &["data", "depth pixels", "zero gradients"],
        ),
    ] {
        let report = sandbox.json(&format!("bench train --config @tiny.toml --batch 3 --steps 2 {settings}"));
        assert_eq!(names(&report["sections"]), [first, &parts[..], &backward, &["optimizer"]].concat());
        assert_eq!((number(&report, "/scenes"), number(&report, "/gaussians")), (3., 64.));
    }
}

#[test]
fn bench_raster_reports_the_time_of_stages() {
    let report = Sandbox::empty().json("bench raster --gaussians 500 --cameras 2 --repeats 3");
    let stages = ["project", "sort", "bin", "blend", "blend backward", "project backward"];
    assert_eq!(names(&report["stages"]), stages);
    assert!(number(&report, "/forward_backward/median") > number(&report, "/forward/least"));
    assert_eq!(report["device"], "cpu");
}

#[test]
fn bench_model_reports_the_parts_of_a_pass() {
    let report = Sandbox::empty().json(
        "bench model --repeats 2 --views 2 --precision bf16 --set model.latents=16 --set model.width=32 \
         --set data.image_size=[32,32] --set model.patch_size=16",
    );
    let parts = &report["parts"];
    let expected = ["tokens", "norms", "queries and outputs", "keys and values", "cross-attention"];
    let more = ["residual sums", "MLPs", "self-attention", "mixer", "heads"];
    assert_eq!(names(parts), [&expected[..], &more].concat());
    // 8 reads, each of which projects 4 + 2·4 tokens of 768 elements to 32 + 32 elements of keys and values, and a part that
    // all have in common to 32 of values; queries come from 16 + 5 slots.
    let flop = |name: &str| {
        let index = names(parts).iter().position(|n| *n == name).unwrap();
        1e9 * number(parts, &format!("/{index}/gflop"))
    };
    assert_eq!(flop("keys and values").round(), 8. * 2. * 768. * (12. * 64. + 32.));
    assert_eq!(flop("cross-attention").round(), 8. * 4. * 21. * 12. * 32.);
    assert_eq!(flop("norms"), 0.);
    let parts = parts.as_array().unwrap();
    let (sum, whole) = (
        parts.iter().map(|part| number(part, "/milliseconds/least")).sum::<f64>(),
        number(&report, "/milliseconds/least"),
    );
    assert!(sum <= whole, "{sum} of {whole} ms");
    for part in parts {
        assert_eq!(number(part, "/backward_gflop"), 0., "{part}");
        let share = number(part, "/share_of_peak");
        assert!(number(part, "/gflop") == 0. || (0.0..=1.5).contains(&share), "{part}");
    }
    assert_eq!(
        (&report["views"], &report["precision"], &report["gaussians"]),
        (&2.into(), &"bf16".into(), &128.into())
    );
    assert!(number(&report, "/peak_bytes") > 1e7);
}

#[test]
fn a_splat_is_scored_by_its_capture() {
    let sandbox = Sandbox::new();
    let eval = "eval --splat @room/truth.ply --scene @room";
    let (code, out, err) = sandbox.output(&format!("{eval} --contact-sheet @sheet.png --json"));
    assert_eq!((code, err.lines().count()), (Some(0), 1), "{err}");
    assert_says(&err, &["lpips_vgg and lpips_alex", "make weights"]);
    assert!(!out.contains("lpips"), "{out}");
    let scores: Value = serde_json::from_str(&out).unwrap();
    // The photos were rendered from this splat: the only difference is 8-bit rounding.
    assert!(number(&scores, "/psnr") > 50. && number(&scores, "/ssim") > 0.999);
    assert!(number(&scores, "/gaussians") > 1000.);
    let views = scores["views"].as_array().unwrap();
    assert_eq!((views.len(), &views[2]["image"]), (9, &json!("images/002.png")));
    assert!(views.iter().all(|v| v["psnr"].is_f64() && v["ssim"].is_f64()));
    // Three images of 6·40 pixels and two gaps wide, nine images and eight gaps high.
    let size = image::image_dimensions(sandbox.path("sheet.png")).unwrap();
    assert_eq!(size, (3 * 240 + 2 * 4, 9 * 240 + 8 * 4));

    // The held-out views alone, with half as many pixels along each side.
    let half = sandbox.json(&format!("{eval} --holdout every:3 --size 20"));
    let images: Vec<&Value> = half["views"].as_array().unwrap().iter().map(|view| &view["image"]).collect();
    assert_eq!(images, ["images/000.png", "images/003.png", "images/006.png"]);
    assert!((20. ..50.).contains(&number(&half, "/psnr")), "{half}");
}

#[test]
fn lpips_is_reported_where_its_weights_are() {
    if !has_lpips() {
        return;
    }
    let sandbox = Sandbox::new();
    let eval = |line: &str| run_process(sandbox.command(line).env_remove("GLOBALSPLAT_WEIGHTS"));
    let (table, _) = eval("eval --splat @room/truth.ply --scene @room");
    let lines: Vec<&str> = table.lines().skip(1).collect();
    assert!(lines[0].ends_with(" LPIPS-VGG LPIPS-Alex"), "{table}");
    assert!(lines.iter().all(|line| line.len() == lines[0].len()), "{table}");
    for column in [4, 5] {
        let values = lines[1..].iter().map(|line| line.split_whitespace().nth(column).unwrap());
        let values: Vec<f64> = values.map(|value| value.parse().unwrap()).collect();
        // The only difference is 8-bit rounding. The last row is the mean.
        let mean = values[..9].iter().sum::<f64>() / 9.;
        assert!(mean < 0.01 && (mean - values[9]).abs() < 1e-4, "{table}");
    }
    // Without values for views that are too small.
    write_rooms(&sandbox.path("small"), 1, 3, 24);
    let (out, err) = eval("eval --splat @small/room_000/truth.ply --scene @small/room_000 --json");
    let scores: Value = serde_json::from_str(&out).unwrap();
    assert!(scores["lpips_vgg"].is_f64() && scores.get("lpips_alex").is_none());
    assert_says(&err, &["lpips_alex", "31×31"]);
}

#[test]
fn render_writes_the_requested_files() {
    let sandbox = Sandbox::new();
    let report = sandbox.json("render --splat @room/truth.ply --scene @room --out @views --depth --alpha");
    assert_eq!(report["files"].as_array().unwrap().len(), 27);
    for name in ["000.png", "000_depth.png", "008_alpha.png"] {
        assert_eq!(image::image_dimensions(sandbox.path("views").join(name)).unwrap(), (40, 40), "{name}");
    }
    sandbox.run("render --splat @room/truth.ply --orbit --frames 2 --size 32x16 --out @orbit.png");
    assert_eq!(image::image_dimensions(sandbox.path("orbit.png")).unwrap(), (2 * 32 + 4, 16));
}

#[test]
fn inspect_describes_splats_captures_and_weights() {
    let sandbox = Sandbox::with_weights();
    let splat = sandbox.json("inspect @room/truth.ply --preview @preview.png");
    assert_eq!((&splat["kind"], &splat["sh_degree"]), (&json!("splat"), &json!(0)));
    for part in ["scale_quantiles", "opacity_quantiles"] {
        let [low, median, high] = ["p01", "p50", "p99"].map(|name| number(&splat[part], &format!("/{name}")));
        assert!(low <= median && median <= high && high > 0., "{splat}");
    }
    // A color of degree 0 is the same in all directions.
    assert_eq!(splat["sh_energy"].as_array().unwrap().len(), 1);
    let image = image::open(sandbox.path("preview.png")).unwrap().into_rgb8();
    assert_eq!(image.dimensions(), (512, 512));
    assert!(image.pixels().filter(|pixel| pixel.0 != [0; 3]).count() > 10_000, "something is seen");
    assert_says(&sandbox.refuse("inspect @room --preview @preview.png"), &["isn't a splat"]);
    let capture = sandbox.json("inspect @room");
    assert_eq!((&capture["kind"], &capture["views"]), (&json!("capture"), &json!(9)));
    let weights = sandbox.json("inspect @tiny.safetensors");
    assert_eq!(weights["kind"], "weights");
    assert_says(weights["configuration"].as_str().unwrap(), &["latents = 16"]);
}

/// Weights of any file are exported: rounded, for torch, and back.
#[test]
fn any_weights_are_exported() {
    let sandbox = Sandbox::with_weights();
    let rounded = sandbox.json("export --weights @tiny.safetensors --out @bf16.safetensors --dtype bf16");
    assert!(number(&rounded, "/bytes") < (sandbox.read("tiny.safetensors").len() * 2 / 3) as f64);
    sandbox.run("export --weights @tiny.safetensors --out @model.ckpt --format torch");
    sandbox.run("export --weights @model.ckpt --out @back.safetensors");
    sandbox.run("export --weights @tiny.safetensors --out @again.safetensors");
    assert!(sandbox.read("back.safetensors") == sandbox.read("again.safetensors"));
    let error = sandbox.refuse("export --weights @tiny.safetensors --out @tiny.safetensors");
    assert_says(&error, &["tiny.safetensors"]);
}

#[test]
fn a_run_goes_from_photos_to_a_splat() {
    let sandbox = Sandbox::new();
    let report = sandbox.json("train --config @tiny.toml --out @run");
    assert!(report["held_out"]["psnr"].is_f64() && report["held_out"]["nearest_photo_psnr"].is_f64());
    assert_eq!(report["held_out"]["scenes"][0]["ours"]["views"].as_array().unwrap().len(), 3);
    assert!(sandbox.path("run/config.toml").is_file());
    // One line for each of six steps, and one for the validation at the end.
    assert_eq!(sandbox.text("run/metrics.jsonl").lines().count(), 7);
    // A run is not begun anew over another.
    let error = sandbox.refuse("train --config @tiny.toml --out @run --resume never");
    assert_says(&error, &["--resume never"]);

    sandbox.run("export --run @run --out @model.safetensors");
    let weights = "--weights @model.safetensors";
    let report =
        sandbox.json(&format!("reconstruct --precision bf16 {weights} --scene @room --out @room.ply"));
    assert_eq!(
        (&report["gaussians"], &report["photos"]),
        (&json!(16 * 4), &json!(3)),
        "as many photos as in training"
    );
    assert!(number(&report, "/seconds") > 0. && number(&report, "/peak_memory_bytes") > 1e6);
    let scores = sandbox.json(&format!("eval {weights} --scene @room"));
    assert_eq!(scores["views"].as_array().unwrap().len(), 3);
    assert!(scores["baselines"]["nearest_photo"]["psnr"].is_f64());
    assert!(scores["baselines"]["mean_photo"]["ssim"].is_f64());

    // Without --weights, the embedded weights are used. One line reports how the photos were selected and resized.
    let (_, out, err) = sandbox.output("reconstruct --scene @room --views 5 --out @room.ply --json");
    let report: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!((&report["weights"], &report["photos"]), (&json!("models/tiny.safetensors"), &json!(5)));
    assert_eq!(report["precision"], "f32", "they are narrow");
    let expected =
        "room: 5 of 9 photos are shown, spread over the camera's path; 40×40 pixels are cut and resized to ";
    assert!(err.starts_with(expected) && err.lines().count() == 1, "{err}");
}

#[test]
fn interrupted_training_saves_a_checkpoint() {
    // Signals sent by kill and schedulers; and, all together, by Ctrl-C and a closed terminal, too.
    for signals in [&[libc::SIGTERM][..], &[libc::SIGINT, libc::SIGTERM, libc::SIGHUP]] {
        let sandbox = Sandbox::new();
        let mut train = sandbox.command("train --config @tiny.toml --out @run --set train.steps=1000000");
        let mut child = train.stderr(std::process::Stdio::piped()).spawn().expect("a program that starts");
        let metrics = sandbox.path("run/metrics.jsonl");
        let steps = || std::fs::read_to_string(&metrics).map_or(0, |text| text.lines().count());
        wait_for(std::slice::from_mut(&mut child), || (steps() >= 3).then_some(()));
        // Signals arrive far more often than in practice: a handler must not write to memory in which a matrix product is being
        // computed.
        while child.try_wait().expect("a child").is_none() {
            signals.iter().for_each(|&signal| send_signal(child.id(), signal));
            std::thread::sleep(std::time::Duration::from_micros(50));
        }
        let output = child.wait_with_output().expect("a child");
        let err = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{err}");
        assert_says(&err, &["stopped", "checkpoints/step-"]);
        assert!(sandbox.path(&format!("run/checkpoints/step-{:08}/state.json", steps())).is_file());
    }
}

#[test]
fn doctor_estimates_memory_and_bench_train_fits_the_batch() {
    let sandbox = Sandbox::new();
    let text = sandbox.succeed("doctor --config @tiny.toml --set train.batch_size=3");
    assert_says(&text, &["3 scenes, 3 at a time", "GB: it fits"]);
    let report = sandbox.json("doctor --config @tiny.toml");
    assert_eq!((&report["cpu"]["scenes_at_once"], &report["devices"][0]["fits"]), (&json!(1), &json!(true)));
    // No machine has enough memory for that many Gaussians.
    let text =
        sandbox.succeed("doctor --config @tiny.toml --set model.latents=1000000 --set model.candidates=1024");
    assert_says(&text, &["it does not fit; to save memory: train.checkpoint_rounds=true"]);
    let report = sandbox.json("bench train --config @tiny.toml --set train.steps=1 --steps 1 --batch auto");
    assert_eq!(report["scenes"], 1);
}

#[test]
fn training_on_chunks_reports_skipped_scenes() {
    let sandbox = Sandbox::empty();
    write_rooms(&sandbox.path("captures"), 3, 6, 40);
    // The smallest possible chunks: two of the rooms share one.
    sandbox.run("pack @captures/room_000 @captures/room_001 --out @set/train");
    sandbox.run("pack @captures/room_002 --out @more");
    sandbox.copy("more/000000.torch", "set/train/000001.torch");
    let index = json!({"room_000": "000000.torch", "room_001": "000000.torch", "room_002": "000001.torch"});
    sandbox.write("set/train/index.json", index.to_string());
    let data = format!("[data]\ncaptures = [{:?}]", sandbox.path("set"));
    sandbox.write("tiny.toml", TINY_CONFIG.replace("[data]", &data).replace("holdout = \"every:3+1\"", ""));
    let report = sandbox.json("train --config @tiny.toml --out @whole --set data.max_bad_share=0");
    assert_eq!((&report["skipped_scenes"]["scenes"], report.get("held_out")), (&json!(3), None));

    let mut bytes = sandbox.read("set/train/000001.torch");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    sandbox.write("set/train/000001.torch", bytes);
    // Held-out views of scenes in chunks are validated as well, for the scenes that can be read.
    let settings = "--set data.max_bad_share=0.5 --set 'data.holdout=\"every:3+1\"'";
    let (_, out, err) = sandbox.output(&format!("train --config @tiny.toml --out @part --json {settings}"));
    let report: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(report["skipped_scenes"]["in_broken_files"], 1);
    assert_says(report["skipped_scenes"]["first"].as_str().unwrap(), &["000001.torch"]);
    let held_out = report["held_out"]["scenes"].as_array().unwrap().iter().map(|scene| &scene["ours"]);
    let held_out: Vec<_> = held_out
        .map(|ours| (ours["scene"].as_str().unwrap(), ours["views"].as_array().unwrap().len()))
        .collect();
    assert_eq!(held_out, [("room_000", 2), ("room_001", 2)]);
    assert_eq!(err.matches("a held-out scene is left out: ").count(), 1, "{err}");
    assert_says(&err, &["000001.torch"]);

    let error = sandbox.fail("train --config @tiny.toml --out @none --set data.max_bad_share=0.1", 1);
    assert_says(&error, &["1 of 3 scenes were skipped", "data.max_bad_share"]);
}
