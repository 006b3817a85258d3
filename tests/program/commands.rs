//! Every command, run as a user runs it.

use crate::common::program::{
    arg, command, fail, globalsplat, refuse, room, rooms, succeed, tiny_config, tiny_weights,
};
use crate::common::{has_lpips, skip};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

fn json(arguments: &[&str]) -> Value {
    let out = succeed(arguments);
    assert_eq!(out.lines().count(), 1, "one object: {out}");
    serde_json::from_str(&out).expect("JSON")
}

#[test]
fn a_closed_stdout_ends_without_a_message() {
    let (_folder, room) = room();
    let mut program = command(&["inspect", arg(&room)])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(program.stdout.take());
    let done = program.wait_with_output().unwrap();
    assert_eq!((done.status.code(), String::from_utf8_lossy(&done.stderr).as_ref()), (Some(1), ""));
}

#[test]
fn doctor_reports_the_installation() {
    let report = json(&["doctor", "--json"]);
    assert_eq!(report["devices"][0], "cpu");
    assert!(["avx512", "avx2", "neon", "portable"].contains(&report["simd"].as_str().unwrap()));
    assert!(report["libtorch"].as_str().unwrap().starts_with("2."));
    assert!(report["ffmpeg"].is_string() || report["ffmpeg"]["absent"].is_string());
}

#[test]
fn every_simd_level_renders_alike() {
    let (folder, room) = room();
    let score = |level: &str| {
        let splat = room.join("truth.ply");
        let output = command(&["eval", "--splat", arg(&splat), "--scene", arg(&room), "--json"])
            .env("GLOBALSPLAT_SIMD", level)
            // LPIPS is left out, because it doesn't depend on the rasterizer.
            .env("GLOBALSPLAT_WEIGHTS", folder.path())
            .output()
            .expect("a program that starts");
        let said = String::from_utf8(output.stderr).expect("text");
        let unknown = said.contains("GLOBALSPLAT_SIMD is");
        assert!(output.status.success() || unknown, "{level}: {said}");
        (!unknown).then(|| serde_json::from_slice::<Value>(&output.stdout).expect("JSON"))
    };
    let scores: Vec<Value> = ["avx512", "avx2", "neon", "portable"].into_iter().filter_map(score).collect();
    assert!(!scores.is_empty());
    // Other processors have only one level.
    if scores.len() < 2 && cfg!(target_arch = "x86_64") {
        skip("a second instruction set", "the processor has none but the portable one");
    }
    for other in &scores[1..] {
        let off = other["psnr"].as_f64().unwrap() - scores[0]["psnr"].as_f64().unwrap();
        assert!(off.abs() < 1e-3, "{off}");
    }
}

/// `GLOBALSPLAT_SIMD` also limits libtorch and the choice of a precision, as on a processor without the hidden instructions.
#[cfg(target_arch = "x86_64")]
#[test]
fn a_simd_level_limits_libtorch_and_precision() {
    for (level, libtorch) in [("avx2", "AVX2"), ("portable", "DEFAULT")] {
        let mut doctor = command(&["doctor", "--json"]);
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
    let (folder, room) = room();
    for precision in ["f32", "bf16"] {
        let splat = |threads: &str| {
            let out = folder.path().join(format!("{precision}_{threads}.ply"));
            let arguments =
                ["reconstruct", "--scene", arg(&room), "--precision", precision, "--out", arg(&out)];
            let output = command(&arguments).env("OMP_NUM_THREADS", threads).output().unwrap();
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            std::fs::read(out).unwrap()
        };
        assert!(splat("1") == splat("3"), "{precision}: threads change the bytes");
    }
}

#[test]
fn a_million_gaussians_fit_into_a_gigabyte() {
    let report = json(&[
        "bench",
        "raster",
        "--gaussians",
        "1000000",
        "--size",
        "1920x1080",
        "--cameras",
        "1",
        "--repeats",
        "1",
        "--json",
    ]);
    assert_eq!((&report["gaussians"], &report["width"]), (&Value::from(1_000_000), &Value::from(1920)));
    assert!(report["pairs"]["contributing"].as_f64().unwrap() > 1e7, "an empty picture proves nothing");
    let bytes = report["working_bytes"].as_u64().unwrap();
    assert!((100_000_000..1_000_000_000).contains(&bytes), "{bytes} bytes of working memory");
}

#[test]
fn bench_train_reports_the_parts_of_a_step() {
    let (folder, capture) = room();
    let config = tiny_config(folder.path(), &capture);
    let bench = |options: &[&str]| {
        json(
            &[
                &["bench", "train", "--config", arg(&config), "--batch", "3", "--steps", "2", "--json"],
                options,
            ]
            .concat(),
        )
    };
    let names = |report: &Value| -> Vec<String> {
        let sections = report["sections"].as_array().unwrap();
        let time = |section: &Value| section["milliseconds"]["least"].as_f64().unwrap();
        assert!(sections.iter().all(|section| time(section) > 0.));
        sections.iter().map(|section| section["name"].as_str().unwrap().to_string()).collect()
    };
    let parts = ["tokens", "encoder", "decoder", "render", "losses"];
    let backward: Vec<String> = parts.iter().rev().map(|part| format!("{part} backward")).collect();
    let backward: Vec<&str> = backward.iter().map(String::as_str).collect();
    let whole = bench(&[]);
    assert_eq!(names(&whole), [&["data", "zero gradients"], &parts[..], &backward, &["optimizer"]].concat());
    assert_eq!((&whole["scenes"], &whole["gaussians"]), (&Value::from(3), &Value::from(64)));
    let sliced = bench(&["--set", "train.micro_batch=2", "--set", "train.checkpoint_rounds=true"]);
    assert_eq!(
        names(&sliced),
        [&["data", "depth pixels", "zero gradients"], &parts[..], &backward, &["optimizer"]].concat()
    );
}

#[test]
fn bench_raster_reports_the_time_of_stages() {
    let report =
        json(&["bench", "raster", "--gaussians", "500", "--cameras", "2", "--repeats", "3", "--json"]);
    let stages: Vec<&str> =
        report["stages"].as_array().unwrap().iter().map(|s| s["name"].as_str().unwrap()).collect();
    assert_eq!(stages, ["project", "sort", "bin", "blend", "blend backward", "project backward"]);
    for time in report["stages"].as_array().unwrap().iter().map(|s| &s["milliseconds"]) {
        assert!(time["least"].as_f64().unwrap() > 0. && time["least"].as_f64() <= time["median"].as_f64());
    }
    let pairs = &report["pairs"];
    assert!(0. < pairs["contributing"].as_f64().unwrap());
    assert!(pairs["contributing"].as_f64() <= pairs["evaluated"].as_f64());
    assert!(report["forward_backward"]["median"].as_f64() > report["forward"]["least"].as_f64());
    assert!(report["rates"]["peak_gflops"].as_f64().unwrap() > 1.);
    assert!(report["rates"]["blend"]["share_of_peak"].as_f64().unwrap() > 0.);
    assert_eq!(report["device"], "cpu");
}

#[test]
fn bench_model_reports_the_parts_of_a_pass() {
    let bench = |options: &[&str]| {
        let shape = ["model.latents=16", "model.width=32", "data.image_size=[32,32]", "model.patch_size=16"];
        let shape: Vec<&str> = shape.iter().flat_map(|key| ["--set", key]).collect();
        json(&[&["bench", "model", "--repeats", "2", "--json"], &shape[..], options].concat())
    };
    let two = bench(&["--views", "2", "--precision", "bf16"]);
    let parts = two["parts"].as_array().unwrap();
    let number = |part: &Value, what: &str| part[what].as_f64().unwrap();
    let names: Vec<&str> = parts.iter().map(|part| part["name"].as_str().unwrap()).collect();
    let expected = ["tokens", "norms", "queries and outputs", "keys and values", "cross-attention"];
    let more = ["residual sums", "MLPs", "self-attention", "mixer", "heads"];
    assert_eq!(names, [&expected[..], &more].concat());
    // 8 reads, each of which projects 4 + 2·4 tokens of 768 elements to 32 + 32 elements of keys and values, and a part that
    // all have in common to 32 of values; queries come from 16 + 5 slots.
    let flop = |name: &str| 1e9 * number(&parts[names.iter().position(|n| *n == name).unwrap()], "gflop");
    assert_eq!(flop("keys and values").round(), 8. * 2. * 768. * (12. * 64. + 32.));
    assert_eq!(flop("cross-attention").round(), 8. * 4. * 21. * 12. * 32.);
    assert_eq!(flop("norms"), 0.);
    let least = |part: &Value| number(&part["milliseconds"], "least");
    let (sum, whole) = (parts.iter().map(least).sum::<f64>(), least(&two));
    assert!(sum <= whole, "{sum} of {whole} ms");
    assert!(parts.iter().all(|part| number(part, "backward_gflop") == 0.));
    for part in parts {
        assert!(least(part) > 0. && number(part, "gigabytes") > 0., "{part}");
        assert!(
            number(part, "gflop") == 0. || (0.0..=1.5).contains(&number(part, "share_of_peak")),
            "{part}"
        );
    }
    assert_eq!(
        (&two["views"], &two["precision"], &two["gaussians"]),
        (&2.into(), &"bf16".into(), &128.into())
    );
    assert!(two["peak_bytes"].as_u64().unwrap() > 10_000_000);
    let many = bench(&["--views", "200"]);
    assert!(many["milliseconds"]["least"].as_f64() > two["milliseconds"]["least"].as_f64());
}

#[test]
fn a_splat_is_scored_by_its_capture() {
    let (_folder, room) = room();
    let (splat, sheet) = (room.join("truth.ply"), room.join("sheet.png"));
    let scores = json(&[
        "eval",
        "--splat",
        arg(&splat),
        "--scene",
        arg(&room),
        "--contact-sheet",
        arg(&sheet),
        "--json",
    ]);
    // The photos were rendered from this splat: the only difference is 8-bit rounding.
    assert!(scores["psnr"].as_f64().unwrap() > 50.);
    assert!(scores["ssim"].as_f64().unwrap() > 0.999);
    assert!(scores["gaussians"].as_u64().unwrap() > 1000);
    let views = scores["views"].as_array().unwrap();
    assert_eq!(views.len(), 9);
    assert_eq!(views[2]["image"], "images/002.png");
    assert!(views.iter().all(|v| v["psnr"].is_f64() && v["ssim"].is_f64()));
    // Three images of 6·40 pixels and two gaps wide, nine images and eight gaps high.
    assert_eq!(image::image_dimensions(&sheet).unwrap(), (3 * 240 + 2 * 4, 9 * 240 + 8 * 4));

    // The held-out views alone, with half as many pixels along each side.
    let eval = ["eval", "--splat", arg(&splat), "--scene", arg(&room), "--holdout", "every:3", "--json"];
    let [whole, half] = ["40", "20"].map(|size| json(&[&eval[..], &["--size", size]].concat()));
    let names = |scores: &Value| {
        let views = scores["views"].as_array().unwrap();
        views.iter().map(|view| view["image"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    assert_eq!(names(&whole), ["images/000.png", "images/003.png", "images/006.png"]);
    assert_eq!(names(&half), names(&whole));
    let psnr = |scores: &Value| scores["psnr"].as_f64().unwrap();
    assert!(psnr(&whole) > 50. && (20. ..50.).contains(&psnr(&half)), "{} {}", psnr(&whole), psnr(&half));
}

#[test]
fn lpips_is_reported_where_its_weights_are() {
    if !has_lpips() {
        return;
    }
    assert_eq!(json(&["doctor", "--json"])["weights"].as_object().unwrap().len(), 2);
    let (_folder, room) = room();
    let splat = room.join("truth.ply");
    let arguments = ["eval", "--splat", arg(&splat), "--scene", arg(&room)];
    let scores = json(&[&arguments[..], &["--json"]].concat());
    for metric in ["lpips_vgg", "lpips_alex"] {
        // The only difference is 8-bit rounding.
        let mean = scores[metric].as_f64().unwrap();
        assert!(mean > 0. && mean < 0.01, "{metric} {mean}");
        let views = scores["views"].as_array().unwrap();
        let sum: f64 = views.iter().map(|view| view[metric].as_f64().unwrap()).sum();
        assert!((sum / views.len() as f64 - mean).abs() < 1e-9, "{metric}");
    }
    let table = succeed(&arguments);
    let heading = table.lines().nth(1).unwrap();
    assert!(heading.ends_with(" LPIPS-VGG LPIPS-Alex"), "{heading}");
    assert!(table.lines().skip(1).all(|line| line.len() == heading.len()), "{table}");
}

#[test]
fn lpips_is_left_out_where_its_weights_are_not() {
    let (folder, room) = room();
    let run = |arguments: &[&str]| {
        let output = command(arguments).env("GLOBALSPLAT_WEIGHTS", folder.path()).output().unwrap();
        assert!(output.status.success());
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let splat = room.join("truth.ply");
    let arguments = ["eval", "--splat", arg(&splat), "--scene", arg(&room)];
    let (table, said) = run(&arguments);
    assert!(!table.contains("LPIPS"), "{table}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(said.contains("lpips_vgg and lpips_alex") && said.contains("make weights"), "{said}");
    let (scores, _) = run(&[&arguments[..], &["--json"]].concat());
    assert!(!scores.contains("lpips"), "{scores}");
    let (doctor, _) = run(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_str(&doctor).unwrap();
    assert!(doctor["weights"].as_object().unwrap().is_empty());
    assert!(run(&["doctor"]).0.contains("make weights"));
}

#[test]
fn lpips_is_left_out_where_views_are_too_small_for_it() {
    if !has_lpips() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("captures");
    rooms(&out, 1, 3, 24);
    let room = out.join("room_000");
    let splat = room.join("truth.ply");
    let output = globalsplat(&["eval", "--splat", arg(&splat), "--scene", arg(&room), "--json"]);
    let scores: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(scores["lpips_vgg"].is_f64());
    assert!(scores.get("lpips_alex").is_none());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("lpips_alex") && said.contains("31×31"), "{said}");
}

#[test]
fn anybody_s_pictures_are_scored() {
    let (folder, room) = room();
    let renders = folder.path().join("renders");
    succeed(&[
        "render",
        "--splat",
        arg(&room.join("truth.ply")),
        "--scene",
        arg(&room),
        "--out",
        arg(&renders),
    ]);
    let scores = json(&["eval", "--renders", arg(&renders), "--scene", arg(&room), "--json"]);
    assert!(scores["psnr"].as_f64().unwrap() > 50.);
    assert!(scores.get("gaussians").is_none());
}

#[test]
fn render_writes_the_requested_files() {
    let (folder, room) = room();
    let splat = room.join("truth.ply");
    let out = folder.path().join("views");
    let args = ["render", "--splat", arg(&splat), "--scene", arg(&room), "--out", arg(&out)];
    let report = json(&[&args[..], &["--depth", "--alpha", "--json"]].concat());
    assert_eq!(report["files"].as_array().unwrap().len(), 27);
    for name in ["000.png", "000_depth.png", "008_alpha.png"] {
        assert_eq!(image::image_dimensions(out.join(name)).unwrap(), (40, 40), "{name}");
    }
    let film = folder.path().join("orbit.gif");
    succeed(&[
        "render",
        "--splat",
        arg(&splat),
        "--scene",
        arg(&room),
        "--orbit",
        "--frames",
        "3",
        "--out",
        arg(&film),
    ]);
    assert!(std::fs::read(&film).unwrap().starts_with(b"GIF89a"));
    let row = folder.path().join("orbit.png");
    succeed(&[
        "render",
        "--splat",
        arg(&splat),
        "--orbit",
        "--frames",
        "2",
        "--size",
        "32x16",
        "--out",
        arg(&row),
    ]);
    assert_eq!(image::image_dimensions(&row).unwrap(), (2 * 32 + 4, 16));
    let path = folder.path().join("path.png");
    let cameras = room.join("cameras.json");
    succeed(&["render", "--splat", arg(&splat), "--path", arg(&cameras), "--out", arg(&path)]);
    assert_eq!(image::image_dimensions(&path).unwrap(), (9 * 40 + 8 * 4, 40));
}

#[test]
fn inspect_describes_splats_captures_and_weights() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let splat = json(&["inspect", arg(&room.join("truth.ply")), "--json"]);
    assert_eq!((splat["kind"].as_str(), splat["sh_degree"].as_i64()), (Some("splat"), Some(0)));
    for part in ["scale_quantiles", "opacity_quantiles"] {
        let at = |name: &str| splat[part][name].as_f64().unwrap();
        assert!(at("p01") <= at("p50") && at("p50") <= at("p99") && at("p99") > 0., "{splat}");
    }
    // A color of degree 0 is the same in all directions.
    assert_eq!(splat["sh_energy"].as_array().unwrap().len(), 1);
    let preview = folder.path().join("preview.png");
    succeed(&["inspect", arg(&room.join("truth.ply")), "--preview", arg(&preview)]);
    let image = image::open(&preview).unwrap().into_rgb8();
    assert_eq!(image.dimensions(), (512, 512));
    assert!(image.pixels().filter(|pixel| pixel.0 != [0; 3]).count() > 10_000, "something is seen");
    let error = refuse(&["inspect", arg(&room), "--preview", arg(&preview)]);
    assert!(error.contains("isn't a splat"), "{error}");
    let capture = json(&["inspect", arg(&room), "--json"]);
    assert_eq!((capture["kind"].as_str(), capture["views"].as_i64()), (Some("capture"), Some(9)));
    let weights = json(&["inspect", arg(&weights), "--json"]);
    assert_eq!(weights["kind"], "weights");
    assert!(weights["configuration"].as_str().unwrap().contains("latents = 16"));
}

/// Weights of any file are exported: rounded, for torch, and back.
#[test]
fn any_weights_are_exported() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let at = |name: &str| folder.path().join(name);
    let export = |from: &Path, to: &Path, more: &[&str]| {
        json(&[&["export", "--weights", arg(from), "--out", arg(to), "--json"], more].concat())
    };
    let rounded = export(&weights, &at("bf16.safetensors"), &["--dtype", "bf16"]);
    assert!(rounded["bytes"].as_u64().unwrap() < std::fs::metadata(&weights).unwrap().len() * 2 / 3);
    export(&weights, &at("model.ckpt"), &["--format", "torch"]);
    export(&at("model.ckpt"), &at("back.safetensors"), &[]);
    export(&weights, &at("again.safetensors"), &[]);
    let again = std::fs::read(at("again.safetensors")).unwrap();
    assert_eq!(std::fs::read(at("back.safetensors")).unwrap(), again);
    let error = refuse(&["export", "--weights", arg(&weights), "--out", arg(&weights)]);
    assert!(error.contains("tiny.safetensors"), "{error}");
    let usage =
        globalsplat(&["export", "--weights", arg(&weights), "--best", "--out", arg(&at("none.safetensors"))]);
    assert_eq!(usage.status.code(), Some(2));
}

#[test]
fn a_run_goes_from_photos_to_a_splat() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let report = json(&["train", "--config", arg(&config), "--out", arg(&run), "--json"]);
    assert!(report["held_out"]["psnr"].is_f64() && report["held_out"]["nearest_photo_psnr"].is_f64());
    assert_eq!(report["held_out"]["scenes"][0]["ours"]["views"].as_array().unwrap().len(), 3);
    assert!(run.join("config.toml").is_file());
    // One line for each of six steps, and one for the validation at the end.
    assert_eq!(std::fs::read_to_string(run.join("metrics.jsonl")).unwrap().lines().count(), 7);

    let (weights, half) = (folder.path().join("model.safetensors"), folder.path().join("half.safetensors"));
    succeed(&["export", "--run", arg(&run), "--out", arg(&weights)]);
    succeed(&["export", "--run", arg(&run), "--out", arg(&half), "--dtype", "bf16"]);
    let bytes = |path: &Path| std::fs::metadata(path).unwrap().len();
    assert!(bytes(&half) < bytes(&weights) * 2 / 3);

    let splat = folder.path().join("room.ply");
    for (file, precision) in [(&weights, "f32"), (&half, "f32"), (&weights, "bf16")] {
        let report = json(&[
            "reconstruct",
            "--precision",
            precision,
            "--weights",
            arg(file),
            "--scene",
            arg(&room),
            "--out",
            arg(&splat),
            "--json",
        ]);
        assert_eq!(report["gaussians"], 16 * 4);
        assert_eq!(report["photos"], 3, "as many as in training");
        assert!(
            report["seconds"].as_f64().unwrap() > 0.
                && report["peak_memory_bytes"].as_u64().unwrap() > 1 << 20
        );
    }
    let curves = std::fs::read_to_string(run.join("curves.svg")).unwrap();
    assert!(
        curves.contains("in training") && curves.contains("held out") && curves.contains("nearest photo"),
        "{curves}"
    );
    // Without --weights, the embedded weights are used. One line reports how the photos were selected and resized.
    let output =
        globalsplat(&["reconstruct", "--scene", arg(&room), "--views", "5", "--out", arg(&splat), "--json"]);
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((&report["weights"], &report["photos"]), (&json!("models/tiny.safetensors"), &json!(5)));
    assert_eq!(report["precision"], "f32", "they are narrow");
    let message = String::from_utf8_lossy(&output.stderr);
    let expected = "room_000: 5 of 9 photos are shown, spread over the camera's path; 40×40 pixels are cut and resized to ";
    assert!(message.starts_with(expected) && message.lines().count() == 1, "{message}");
    let [doctor, as_json] = [succeed(&["doctor"]), succeed(&["doctor", "--json"])];
    assert!(doctor.contains("models/tiny.safetensors") && as_json.contains("models/tiny.safetensors"));

    succeed(&[
        "reconstruct",
        "--weights",
        arg(&weights),
        "--scene",
        arg(&room),
        "--views",
        "9",
        "--out",
        arg(&splat),
    ]);
    // The splat is in the capture's world coordinates, so that renders from the capture's cameras match the model's own.
    let by_model = json(&["eval", "--weights", arg(&weights), "--scene", arg(&room), "--json"]);
    assert_eq!(by_model["views"].as_array().unwrap().len(), 3);
    assert!(by_model["baselines"]["nearest_photo"]["psnr"].is_f64());
    assert!(by_model["baselines"]["mean_photo"]["ssim"].is_f64());
    let by_splat = json(&["eval", "--splat", arg(&splat), "--scene", arg(&room), "--json"]);
    assert!(by_splat["psnr"].is_f64());
}

#[test]
fn a_stopped_run_ends_with_the_same_bits() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let train = |name: &str, steps: &str| {
        let run = folder.path().join(name);
        succeed(&[
            "train",
            "--config",
            arg(&config),
            "--out",
            arg(&run),
            "--set",
            &format!("train.keep_checkpoints={steps}"),
        ]);
        run.join("checkpoints")
    };
    let whole = train("whole", "9");
    let parts = train("parts", "9");
    // Simulates a process killed after step 4: the later checkpoint is missing.
    std::fs::remove_dir_all(parts.join("step-00000006")).unwrap();
    train("parts", "9");
    for file in ["model.safetensors", "optimizer.safetensors"] {
        let read = |checkpoints: &Path| {
            globalsplat::io::read_weights(&checkpoints.join("step-00000006").join(file)).unwrap().tensors
        };
        let (a, b) = (read(&whole), read(&parts));
        assert!(!a.is_empty() && a.iter().zip(&b).all(|((n, x), (m, y))| n == m && x.equal(y)), "{file}");
    }
}

#[test]
fn interrupted_training_saves_a_checkpoint() {
    // Signals sent by Ctrl-C, by kill and schedulers, and by a closed terminal.
    for signals in [&[libc::SIGINT][..], &[libc::SIGTERM], &[libc::SIGINT, libc::SIGTERM, libc::SIGHUP]] {
        interrupt_training(signals);
    }
}

fn interrupt_training(signals: &[i32]) {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_globalsplat"))
        .args(["train", "--config", arg(&config), "--out", arg(&run), "--set", "train.steps=1000000"])
        .env("OMP_NUM_THREADS", "1")
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("a program that starts");
    // Wait until it has done a few steps.
    let metrics = run.join("metrics.jsonl");
    while std::fs::read_to_string(&metrics).map_or(0, |text| text.lines().count()) < 3 {
        assert!(child.try_wait().expect("a child").is_none(), "it ended by itself");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    // Signals arrive far more often than in practice: a handler must not write to memory in which a matrix product is being
    // computed.
    while child.try_wait().expect("a child").is_none() {
        for &signal in signals {
            // SAFETY: sends a signal to a child process that has not been waited for.
            unsafe { libc::kill(child.id() as i32, signal) };
        }
        std::thread::sleep(std::time::Duration::from_micros(50));
    }
    let output = child.wait_with_output().expect("a child");
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{err}");
    assert!(err.contains("stopped") && err.contains("checkpoints/step-"), "{err}");
    let steps = std::fs::read_to_string(&metrics).unwrap().lines().count();
    assert!(run.join(format!("checkpoints/step-{steps:08}/state.json")).is_file());
}

#[test]
fn a_run_is_not_begun_anew_over_another() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&["train", "--config", arg(&config), "--out", arg(&run)]);
    let error = fail(&["train", "--config", arg(&config), "--out", arg(&run), "--resume", "never"], 2);
    assert!(error.contains("--resume never"), "{error}");
}

#[test]
fn doctor_estimates_memory_and_bench_train_fits_the_batch() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let text = succeed(&["doctor", "--config", arg(&config), "--set", "train.batch_size=3"]);
    assert!(text.contains("3 scenes, 3 at a time") && text.contains("GB: it fits"), "{text}");
    let report: Value =
        serde_json::from_str(&succeed(&["doctor", "--config", arg(&config), "--json"])).expect("JSON");
    assert_eq!((&report["cpu"]["scenes_at_once"], &report["devices"][0]["fits"]), (&json!(1), &json!(true)));
    // No machine has enough memory for that many Gaussians.
    let large = ["--set", "model.latents=1000000", "--set", "model.candidates=1024"];
    let text = succeed(&[&["doctor", "--config", arg(&config)][..], &large].concat());
    assert!(text.contains("it does not fit; to save memory: train.checkpoint_rounds=true"), "{text}");

    let bench =
        ["bench", "train", "--config", arg(&config), "--set", "train.steps=1", "--steps", "1", "--json"];
    let report: Value =
        serde_json::from_str(&succeed(&[&bench[..], &["--batch", "auto"]].concat())).expect("JSON");
    assert_eq!(report["scenes"], 1);
    assert_eq!(globalsplat(&[&bench[..], &["--batch", "some"]].concat()).status.code(), Some(2));
}

#[test]
fn wrong_usage_is_exit_code_2() {
    for arguments in [&["nonsense"][..], &["eval", "--scene", "x"], &["render", "--splat", "x", "--out", "y"]]
    {
        assert_eq!(globalsplat(arguments).status.code(), Some(2), "{arguments:?}");
    }
}

#[test]
fn training_on_chunks_reports_skipped_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let (captures, set) = (folder.path().join("captures"), folder.path().join("set/train"));
    rooms(&captures, 3, 6, 40);
    // The smallest possible chunks: two of the rooms share one.
    let rooms: Vec<PathBuf> = (0..3).map(|room| captures.join(format!("room_{room:03}"))).collect();
    succeed(&["pack", arg(&rooms[0]), arg(&rooms[1]), "--out", arg(&set)]);
    let more = folder.path().join("more");
    succeed(&["pack", arg(&rooms[2]), "--out", arg(&more)]);
    std::fs::rename(more.join("000000.torch"), set.join("000001.torch")).unwrap();
    let index = json!({"room_000": "000000.torch", "room_001": "000000.torch", "room_002": "000001.torch"});
    std::fs::write(set.join("index.json"), index.to_string()).unwrap();

    let config = tiny_config(folder.path(), &folder.path().join("set"));
    let text = std::fs::read_to_string(&config).unwrap().replace("holdout = \"every:3+1\"", "");
    std::fs::write(&config, text).unwrap();
    let train = |run: &str, share: &str| {
        let (run, share) = (folder.path().join(run), format!("data.max_bad_share={share}"));
        globalsplat(&["train", "--config", arg(&config), "--out", arg(&run), "--json", "--set", &share])
    };
    let report: Value = serde_json::from_slice(&train("whole", "0").stdout).unwrap();
    assert_eq!(
        (report["skipped_scenes"]["scenes"].as_u64(), report["held_out"].as_object()),
        (Some(3), None)
    );

    let chunk = set.join("000001.torch");
    let mut bytes = std::fs::read(&chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&chunk, bytes).unwrap();
    let report: Value = serde_json::from_slice(&train("part", "0.5").stdout).unwrap();
    assert_eq!(report["skipped_scenes"]["in_broken_files"].as_u64(), Some(1));
    assert!(report["skipped_scenes"]["first"].as_str().unwrap().contains("000001.torch"));
    // Held-out views of scenes in chunks are validated as well, for the scenes that can be read.
    let (run, holdout) = (folder.path().join("held_out"), "data.holdout=\"every:3+1\"");
    let settings = ["--set", holdout, "--set", "data.max_bad_share=0.5"];
    let output = globalsplat(
        &[&["train", "--config", arg(&config), "--out", arg(&run), "--json"], &settings[..]].concat(),
    );
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let held_out = report["held_out"]["scenes"].as_array().unwrap();
    let of = |i: usize| {
        (held_out[i]["ours"]["scene"].as_str(), held_out[i]["ours"]["views"].as_array().map(Vec::len))
    };
    assert_eq!((held_out.len(), of(0), of(1)), (2, (Some("room_000"), Some(2)), (Some("room_001"), Some(2))));
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(err.matches("a held-out scene is left out: ").count(), 1, "{err}");
    assert!(err.contains("000001.torch"), "{err}");

    let refused = train("none", "0.1");
    let err = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{err}");
    assert!(err.contains("1 of 3 scenes were skipped") && err.contains("data.max_bad_share"), "{err}");
}
