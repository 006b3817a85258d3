//! Errors for invalid input. The program prints one sentence that names the file, the field, what was found and what was expected. It exits
//! with code 2, or with 1 if the work itself fails, and leaves no partial output.

use crate::common::program::{Sandbox, TINY_CONFIG, arg, assert_says, command, limit_file_size};
use globalsplat::io::{read_weights, write_weights};
use serde_json::{Value, json};

/// Inspects a room whose cameras.json is changed, and asserts that it is refused with `parts` and the file's name.
fn refuse_cameras(change: impl FnOnce(&mut Value), parts: &[&str]) {
    let sandbox = Sandbox::new();
    sandbox.change_json("room/cameras.json", change);
    assert_says(&sandbox.refuse("inspect @room"), &[parts, &["cameras.json"]].concat());
}

#[test]
fn invalid_cameras() {
    let pose = |change: fn(&mut Value), parts: &[&str]| {
        refuse_cameras(
            |cameras| change(&mut cameras["views"][2]["c2w"]),
            &[&["c2w of view 2"], parts].concat(),
        );
    };
    pose(|c2w| c2w[0][0] = json!(1.5), &["isn't rigid", "a rotation"]);
    pose(|c2w| (0..3).for_each(|row| c2w[row][0] = json!(-c2w[row][0].as_f64().unwrap())), &["mirrors"]);
    pose(|c2w| c2w[1] = json!([0., 0., 0., 0.]), &["singular"]);
    pose(|c2w| *c2w = json!([[1., 0.], [0., 1.]]), &["a 4×4 matrix"]);
    let intrinsic = |row: usize, column: usize, value: f64, parts: &[&str]| {
        refuse_cameras(|cameras| cameras["views"][1]["intrinsic"][row][column] = json!(value), parts);
    };
    intrinsic(1, 1, 0., &["focal length fy of view 1", "is 0", "above 0"]);
    intrinsic(0, 2, 80., &["principal point cx of view 1", "is 80", "0 to 40"]);
    for (row, column, value) in [(0, 1, 5.), (1, 0, 5.), (2, 0, 1e-3), (2, 2, 2.)] {
        let expected = "no skew and [0, 0, 1] as the last row";
        intrinsic(row, column, value, &["intrinsic of view 1", expected]);
    }
    let one_view = |cameras: &mut Value| cameras["views"].as_array_mut().unwrap().truncate(1);
    refuse_cameras(one_view, &["number of views is 1", "two or more"]);

    let sandbox = Sandbox::new();
    sandbox.change_json("room/cameras.json", |cameras| cameras["views"][1]["intrinsic"][0][1] = json!(1e-3));
    sandbox.run("inspect @room"); // a skew that is only rounding

    let sandbox = Sandbox::new();
    let text = sandbox.text("room/cameras.json");
    let last = text.rfind("1.0").unwrap(); // the last element of the last pose
    sandbox.write("room/cameras.json", format!("{}NaN{}", &text[..last], &text[last + 3..]));
    assert_says(&sandbox.refuse("inspect @room"), &["c2w of view 8", "NaN", "finite numbers"]);
    sandbox.write("room/cameras.json", "{\"views\": [");
    assert_says(&sandbox.refuse("inspect @room"), &["cameras.json", "not a description of cameras"]);
    sandbox.write("empty/notes.txt", "");
    let error = sandbox.refuse("eval --splat @room/truth.ply --scene @empty");
    assert_says(&error, &["empty", "cameras.json"]);
    assert_says(&sandbox.refuse("inspect @nowhere.ply"), &["nowhere.ply", "can't be read"]);
    assert_says(&sandbox.refuse("inspect @room/nowhere"), &["no such file or folder"]);
}

#[test]
fn invalid_photos() {
    let sandbox = Sandbox::with_weights();
    let photo = sandbox.read("room/images/003.png");
    let refuse = |parts: &[&str]| {
        let error =
            sandbox.refuse("reconstruct --weights @tiny.safetensors --scene @room --views 9 --out @out.ply");
        assert_says(&error, &[&[arg(&sandbox.path("room"))], parts].concat());
    };
    for broken in [&b"no picture"[..], &photo[..photo.len() / 2]] {
        sandbox.write("room/images/003.png", broken);
        refuse(&["003.png", "undecodable", "a JPEG, PNG"]);
    }
    image::RgbImage::new(40, 30).save(sandbox.path("room/images/003.png")).unwrap();
    refuse(&["003.png", "40×30 pixels", "expected 40×40"]);
}

#[test]
fn invalid_weights() {
    let sandbox = Sandbox::with_weights();
    let refuse = |file: &str, parts: &[&str]| {
        let error = sandbox.refuse(&format!("reconstruct --weights @{file} --scene @room --out @out.ply"));
        assert_says(&error, &[parts, &[file]].concat());
        assert!(!sandbox.path("out.ply").exists(), "nothing was written");
    };
    let whole = read_weights(&sandbox.path("tiny.safetensors")).unwrap();
    let write = |name: &str, change: fn(&mut std::collections::BTreeMap<String, tch::Tensor>)| {
        let mut tensors =
            whole.tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shallow_clone())).collect();
        change(&mut tensors);
        write_weights(&sandbox.path(name), &tensors, whole.metadata.clone()).unwrap();
    };
    write("fewer.safetensors", |tensors| {
        tensors.remove("scene_tokens");
        tensors.remove("slot_encoder.mem_regs");
        let unknown = tensors["slot_encoder.slot_regs"].copy();
        tensors.insert("unknown".into(), unknown);
    });
    refuse("fewer.safetensors", &["tensor scene_tokens is missing", "[16, 32]", "2 more"]);
    write("wide.safetensors", |tensors| {
        let wide = tensors["scene_tokens"].repeat([1, 2]);
        tensors.insert("scene_tokens".into(), wide);
    });
    refuse("wide.safetensors", &["tensor scene_tokens is [16, 64], expected [16, 32]"]);
    sandbox.write("text.safetensors", "no weights at all");
    refuse("text.safetensors", &["safetensors"]);
    let other = [("a".to_string(), tch::Tensor::from_slice(&[1f32]))].into();
    write_weights(&sandbox.path("other.safetensors"), &other, Default::default()).unwrap();
    refuse("other.safetensors", &["tensor scene_tokens is missing", "globalsplat export"]);

    // A checkpoint of another model.
    sandbox.run("train --config @tiny.toml --out @run --set train.steps=1");
    let error = sandbox.refuse("train --config @tiny.toml --out @run --set model.width=64");
    assert_says(&error, &["model.safetensors", "more that don't fit"]);
}

#[test]
fn options_that_do_not_apply() {
    let of_models = ["--views 4", "--views 3", "--precision bf16"];
    let of_datasets = ["--index i.json", "--size 64", "--name n"];
    let of_scenes = ["--holdout every:3", "--views 3", "--contact-sheet s.png"];
    for (line, options) in [
        ("eval --splat s.ply --scene c", of_models),
        ("eval --renders r --scene c", of_models),
        ("eval --weights w --scene c", of_datasets),
        ("eval --weights w --data d --index i.json --out o", of_scenes),
    ] {
        for option in options {
            let line = format!("{line} {option}");
            let (code, error) = globalsplat::run(&line.split(' ').collect::<Vec<_>>()).unwrap_err();
            let name = option.split(' ').next().unwrap();
            assert!(
                code == 2 && error.contains("cannot be used with") && error.contains(name),
                "{line}: {error}"
            );
        }
    }
    for line in ["nonsense", "eval --scene x", "render --splat x --out y", "bench train --batch some"] {
        assert_eq!(globalsplat::run(&line.split(' ').collect::<Vec<_>>()).unwrap_err().0, 2, "{line}");
    }
    assert_eq!(command(&["nonsense"]).output().unwrap().status.code(), Some(2));
}

#[test]
fn invalid_options() {
    let sandbox = Sandbox::with_weights();
    let eval = "eval --weights @tiny.safetensors --scene @room";
    for (command, option, parts) in [
        ("reconstruct --scene @room --out @out.ply", "--precision f16", ["--precision: f16", "f32 or bf16"]),
        (eval, "--precision f16", ["--precision: f16", "f32 or bf16"]),
        (eval, "--device tpu", ["--device tpu", "cpu, cuda or cuda:N"]),
        (eval, "--device cuda:99", ["--device cuda:99", "CUDA devices"]),
        (eval, "--holdout none", ["0 target views", "--holdout or data.holdout, every:N"]),
        ("bench train", "--set train.batch_size=4", ["--set train.batch_size=4", "--batch N"]),
    ] {
        assert_says(&sandbox.refuse(&format!("{command} {option}")), &parts);
    }
    let doctor = sandbox.command("doctor").env("GLOBALSPLAT_SIMD", "mmx").output().unwrap();
    assert_ne!(doctor.status.code(), Some(0));
    assert_says(&String::from_utf8_lossy(&doctor.stderr), &["GLOBALSPLAT_SIMD is 'mmx', expected one of"]);
}

#[test]
fn invalid_configurations() {
    let sandbox = Sandbox::new();
    let train = |settings: &str| sandbox.refuse(&format!("train --config @tiny.toml --out @run {settings}"));
    for (setting, parts) in [
        ("data.image_size='[36, 32]'", &["height is 36", "multiple of the patch size 8"][..]),
        ("train.weight_decay=nan", &["tiny.toml", "train.weight_decay is NaN"]),
        ("train.precision=f16", &["--set train.precision=f16", "f32", "bf16"]),
        ("loss.frustum=-1", &["tiny.toml", "loss.frustum is -1"]),
        ("loss.consistency_depth=inf", &["tiny.toml", "loss.consistency_depth is inf"]),
        ("train.batch_size=0", &["tiny.toml", "train.batch_size is 0"]),
        ("model.depth=3", &["--set model.depth=3", "unknown field"]),
        ("train.steps=soon", &["--set train.steps=soon", "invalid type"]),
        ("train.steps", &["--set train.steps", "section.key=value"]),
        ("curriculum.final_stage=3", &["curriculum.final_stage is 3", "2 at most"]),
        ("train.learning_rate=-1.0", &["train.learning_rate is -1", "above 0"]),
    ] {
        assert_says(&train(&format!("--set {setting}")), parts);
    }
    let text = sandbox.text("tiny.toml");
    for (from, to, parts) in [
        ("latents", "latent", ["unknown field `latent`", "line 3"]),
        ("latents = 16", "latents = \"many\"", ["invalid type", "line 3"]),
        ("[model]", "[model", ["TOML", "tiny.toml"]),
        ("every:3+1", "every:0", ["holdout is \"every:0\"", "every:N"]),
    ] {
        sandbox.write("tiny.toml", text.replace(from, to));
        assert_says(&train(""), &[&["tiny.toml"], &parts[..]].concat());
    }
    assert!(TINY_CONFIG.contains("latents = 16") && !sandbox.path("run").exists(), "nothing was begun");
}

#[test]
fn unwritable_outputs_are_refused_before_the_work() {
    let sandbox = Sandbox::with_weights();
    // The parent of the output is a file, so that even root can't write it.
    let before = sandbox.read("room/cameras.json");
    for (line, file) in [
        ("reconstruct --weights @tiny.safetensors --scene @room --out", "below.ply"),
        ("render --splat @room/truth.ply --scene @room --out", "below.ply"),
        ("export --config @tiny.toml --out", "below.ply"),
        ("train --config @tiny.toml --out", "below.ply"),
        ("eval --splat @room/truth.ply --scene @room --contact-sheet", "below.png"),
    ] {
        let expected = format!("cameras.json/{file} can't be written");
        assert_says(&sandbox.refuse(&format!("{line} @room/cameras.json/{file}")), &[&expected]);
    }
    assert_eq!(sandbox.read("room/cameras.json"), before);
    for line in ["eval --splat @room/truth.ply --scene @room", "synth --out @worlds"] {
        let error = sandbox.refuse(&format!("{line} --contact-sheet @sheet.jpg"));
        assert_says(&error, &["sheet.jpg", "the image's file extension is another, expected .png"]);
    }
    std::fs::create_dir(sandbox.path("taken.ply")).unwrap();
    let error = sandbox.refuse("reconstruct --weights @tiny.safetensors --scene @room --out @taken.ply");
    assert_says(&error, &["a folder", "the name of a file"]);
}

#[test]
fn a_full_disk_leaves_the_existing_file_intact() {
    let sandbox = Sandbox::with_weights();
    sandbox.copy("room/truth.ply", "out.ply");
    let before = sandbox.contents();
    for line in [
        "export --config @tiny.toml --out @tiny.safetensors",
        "reconstruct --weights @tiny.safetensors --scene @room --out @out.ply",
    ] {
        let output = limit_file_size(&sandbox.command(line)).output().expect("bash");
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(1) && err.contains("can't be written"), "{line}: {err}");
    }
    assert!(sandbox.contents() == before, "a file is changed or left behind");
}

#[test]
fn invalid_weights_of_lpips() {
    let sandbox = Sandbox::with_weights();
    let file = "lpips_vgg.safetensors";
    let refuse = |parts: &[&str]| {
        let (code, out, error) = sandbox.output("eval --splat @room/truth.ply --scene @room");
        assert_eq!((code, out.as_str(), error.trim().lines().count()), (Some(2), "", 1), "{error}");
        assert_says(&error, &[parts, &[arg(&sandbox.path(file))]].concat());
    };
    sandbox.write(file, "no weights");
    refuse(&["broken", "safetensors"]);
    sandbox.copy("tiny.safetensors", file);
    refuse(&["tensor conv1_1.bias is missing, expected [64]"]);
}

#[test]
fn perceptual_losses_without_their_weights() {
    let sandbox = Sandbox::with_weights();
    let missing = ["loss.perceptual_weights is", "vgg19.safetensors, which doesn't exist", "torchvision"];
    let file = "--set loss.perceptual_weights";
    for (settings, parts) in [
        ("vgg19", &missing[..]),
        ("lpips_vgg", &["lpips_vgg.safetensors", "`make weights` creates it"]),
        (&format!("vgg19 {file}=elsewhere/v.safetensors"), &["is elsewhere/v.safetensors"]),
        // The file exists but contains the weights of another network.
        (&format!("vgg19 {file}=@tiny.safetensors"), &["tiny.safetensors", "features.0."]),
        ("vgg16", &["unknown variant `vgg16`"]),
    ] {
        let train = "train --config @tiny.toml --out @run --set loss.perceptual";
        let (code, _, error) = sandbox.output(&format!("{train}={settings}"));
        assert_eq!(code, Some(2), "{error}");
        assert_says(&error, parts);
    }
}
