//! Errors for invalid input. The program prints one sentence that names the file, the field, what was found and what was expected. It exits
//! with code 2, or with 1 if the work itself fails, and leaves no partial output.

use crate::common::program::{arg, command, refuse, room, succeed, tiny_config, tiny_weights};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Creates the room with its `cameras.json` changed by `change`.
fn broken_room(change: impl FnOnce(&mut Value)) -> (tempfile::TempDir, PathBuf) {
    let (folder, room) = room();
    let file = room.join("cameras.json");
    let mut cameras: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    change(&mut cameras);
    std::fs::write(&file, cameras.to_string()).unwrap();
    (folder, room)
}

/// Evaluates the room's own splat and returns the error message.
fn refuse_room(room: &Path) -> String {
    let splat = room.join("truth.ply");
    let error = refuse(&["eval", "--splat", arg(&splat), "--scene", arg(room)]);
    assert!(error.contains(arg(room)), "names the file: {error}");
    error
}

fn assert_says(error: &str, parts: &[&str]) {
    for part in parts {
        assert!(error.contains(part), "{part:?} is not in: {error}");
    }
}

#[test]
fn all_images_but_one_missing() {
    let (_folder, room) = room();
    (1..9).for_each(|i| std::fs::remove_file(room.join(format!("images/00{i}.png"))).unwrap());
    let expected =
        ["the number of frames with an image is 1 of 9", "images/001.png", "is missing", "two or more"];
    assert_says(&refuse_room(&room), &expected);
}

#[test]
fn an_undecodable_image() {
    let (_folder, room) = room();
    std::fs::write(room.join("images/003.png"), b"no picture").unwrap();
    assert_says(&refuse_room(&room), &["003.png", "undecodable", "a JPEG, PNG"]);
}

#[test]
fn a_truncated_image() {
    let (_folder, room) = room();
    let file = room.join("images/003.png");
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    assert_says(&refuse_room(&room), &["003.png", "undecodable"]);
}

#[test]
fn an_image_of_another_size() {
    let (_folder, room) = room();
    image::RgbImage::new(40, 30).save(room.join("images/003.png")).unwrap();
    assert_says(&refuse_room(&room), &["003.png", "40×30 pixels", "expected 40×40"]);
}

#[test]
fn a_pose_with_nan() {
    let (_folder, room) = room();
    let file = room.join("cameras.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let at = text.rfind("1.0").unwrap(); // the last element of the last pose
    std::fs::write(&file, format!("{}NaN{}", &text[..at], &text[at + 3..])).unwrap();
    assert_says(&refuse_room(&room), &["c2w of view 8", "NaN", "finite numbers"]);
}

#[test]
fn a_pose_that_is_not_rigid() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][2]["c2w"][0][0] = json!(1.5));
    assert_says(&refuse_room(&room), &["c2w of view 2", "isn't rigid", "a rotation"]);
}

#[test]
fn a_pose_with_a_reflection() {
    let (_folder, room) = broken_room(|cameras| {
        for row in 0..3 {
            let entry = &mut cameras["views"][2]["c2w"][row][0];
            *entry = json!(-entry.as_f64().unwrap());
        }
    });
    assert_says(&refuse_room(&room), &["c2w of view 2", "mirrors"]);
}

#[test]
fn a_singular_pose() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][2]["c2w"][1] = json!([0., 0., 0., 0.]));
    assert_says(&refuse_room(&room), &["c2w of view 2", "singular"]);
}

#[test]
fn a_pose_of_another_shape() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][2]["c2w"] = json!([[1., 0.], [0., 1.]]));
    assert_says(&refuse_room(&room), &["c2w of view 2", "a 4×4 matrix"]);
}

#[test]
fn a_focal_length_of_zero() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][1]["intrinsic"][1][1] = json!(0.));
    assert_says(&refuse_room(&room), &["focal length fy of view 1", "is 0", "above 0"]);
}

#[test]
fn a_principal_point_outside() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][1]["intrinsic"][0][2] = json!(80.));
    assert_says(&refuse_room(&room), &["principal point cx of view 1", "is 80", "0 to 40"]);
}

#[test]
fn intrinsics_with_skew_or_another_last_row() {
    let (_folder, room) = broken_room(|cameras| cameras["views"][1]["intrinsic"][0][1] = json!(1e-3));
    succeed(&["inspect", arg(&room)]);
    for (row, column, value) in [(0usize, 1usize, 5.), (1, 0, 5.), (2, 0, 1e-3), (2, 2, 2.)] {
        let (_folder, room) =
            broken_room(|cameras| cameras["views"][1]["intrinsic"][row][column] = json!(value));
        assert_says(&refuse_room(&room), &["intrinsic of view 1", "no skew and [0, 0, 1] as the last row"]);
    }
}

#[test]
fn fewer_than_two_views() {
    let (_folder, room) = broken_room(|cameras| cameras["views"].as_array_mut().unwrap().truncate(1));
    assert_says(&refuse_room(&room), &["number of views is 1", "two or more"]);
}

#[test]
fn a_file_with_invalid_json() {
    let (_folder, room) = room();
    std::fs::write(room.join("cameras.json"), "{\"views\": [").unwrap();
    assert_says(&refuse_room(&room), &["cameras.json", "not a description of cameras"]);
}

#[test]
fn a_folder_without_a_capture() {
    let (folder, room) = room();
    let empty = folder.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    let error = refuse(&["eval", "--splat", arg(&room.join("truth.ply")), "--scene", arg(&empty)]);
    assert_says(&error, &[arg(&empty), "cameras.json"]);
    let error = refuse(&["inspect", arg(&folder.path().join("nowhere.ply"))]);
    assert_says(&error, &["nowhere.ply", "can't be read"]);
}

#[test]
fn an_image_size_that_the_patch_does_not_divide() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let run = folder.path().join("run");
    let error =
        refuse(&["train", "--config", arg(&config), "--out", arg(&run), "--set", "data.image_size=[36, 32]"]);
    assert_says(&error, &["height is 36", "multiple of the patch size 8"]);
    assert!(!run.exists(), "nothing was begun");
}

/// Changes the bytes of the room's splat by `change`, renders the result, and returns the error message.
fn broken_splat(change: impl FnOnce(&mut Vec<u8>)) -> String {
    let (folder, room) = room();
    let file = folder.path().join("broken.ply");
    let mut bytes = std::fs::read(room.join("truth.ply")).unwrap();
    change(&mut bytes);
    std::fs::write(&file, bytes).unwrap();
    let out = folder.path().join("views");
    let error = refuse(&["render", "--splat", arg(&file), "--scene", arg(&room), "--out", arg(&out)]);
    assert_says(&error, &["broken.ply"]);
    error
}

/// Returns the length of a PLY file's header in bytes.
fn header_length(ply: &[u8]) -> usize {
    ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11
}

fn replace_in_header(ply: &mut Vec<u8>, from: &str, to: &str) {
    let length = header_length(ply);
    let header = String::from_utf8(ply[..length].to_vec()).unwrap();
    assert!(header.contains(from));
    ply.splice(..length, header.replacen(from, to, 1).into_bytes());
}

#[test]
fn a_truncated_splat() {
    assert_says(&broken_splat(|ply| ply.truncate(ply.len() - 10)), &["the body", "cut short"]);
    assert_says(&broken_splat(|ply| ply.truncate(100)), &["the header", "end_header"]);
}

#[test]
fn a_splat_without_a_property() {
    let error = broken_splat(|ply| replace_in_header(ply, "property float opacity", "property float glow"));
    assert_says(&error, &["property opacity is missing"]);
}

#[test]
fn a_splat_with_nan() {
    let error = broken_splat(|ply| {
        let first = header_length(ply);
        ply[first..first + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    });
    assert_says(&error, &["x of vertex 0", "NaN", "finite"]);
}

#[test]
fn a_splat_that_is_no_gaussian_splat_ply() {
    assert_says(&broken_splat(|ply| *ply = b"hello".to_vec()), &["no PLY"]);
    let error =
        broken_splat(|ply| replace_in_header(ply, "property float f_dc_0", "property list uchar int f_dc_0"));
    assert_says(&error, &["a list"]);
}

/// Changes the tensors of the tiny model by `change`, reconstructs with them, and returns the error message.
fn broken_weights(change: impl FnOnce(&mut std::collections::BTreeMap<String, tch::Tensor>)) -> String {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let mut file = globalsplat::io::read_weights(&weights).unwrap();
    change(&mut file.tensors);
    globalsplat::io::write_weights(&weights, &file.tensors, file.metadata).unwrap();
    let splat = folder.path().join("out.ply");
    let error =
        refuse(&["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&splat)]);
    assert!(!splat.exists(), "nothing was written");
    assert_says(&error, &["tiny.safetensors"]);
    error
}

#[test]
fn weights_with_missing_and_unknown_tensors() {
    let error = broken_weights(|tensors| {
        tensors.remove("scene_tokens");
        tensors.remove("slot_encoder.mem_regs");
        let unknown = tensors["slot_encoder.slot_regs"].copy();
        tensors.insert("unknown".into(), unknown);
    });
    assert_says(&error, &["tensor scene_tokens is missing", "[16, 32]", "2 more"]);
}

#[test]
fn weights_with_another_shape() {
    let error = broken_weights(|tensors| {
        let wide = tensors["scene_tokens"].repeat([1, 2]);
        tensors.insert("scene_tokens".into(), wide);
    });
    assert_says(&error, &["tensor scene_tokens is [16, 64], expected [16, 32]"]);
}

#[test]
fn weights_files_without_a_model() {
    let (folder, room) = room();
    let file = folder.path().join("weights.safetensors");
    std::fs::write(&file, b"no weights at all").unwrap();
    let splat = folder.path().join("out.ply");
    let error =
        refuse(&["reconstruct", "--weights", arg(&file), "--scene", arg(&room), "--out", arg(&splat)]);
    assert_says(&error, &["weights.safetensors", "safetensors"]);
    let tensors = [("a".to_string(), tch::Tensor::from_slice(&[1f32]))].into();
    globalsplat::io::write_weights(&file, &tensors, Default::default()).unwrap();
    let error =
        refuse(&["reconstruct", "--weights", arg(&file), "--scene", arg(&room), "--out", arg(&splat)]);
    assert_says(&error, &["tensor scene_tokens is missing", "globalsplat export"]);
}

#[test]
fn options_that_do_not_apply() {
    let data = ["eval", "--weights", "w", "--data", "d", "--index", "i.json", "--out", "o"];
    let model_options = [["--views", "4"], ["--views", "3"], ["--precision", "bf16"]];
    let dataset_options = [["--index", "i.json"], ["--size", "64"], ["--name", "n"]];
    let scene_options = [["--holdout", "every:3"], ["--views", "3"], ["--contact-sheet", "s.png"]];
    let commands: [(&[&str], [[&str; 2]; 3]); 4] = [
        (&["eval", "--splat", "s.ply", "--scene", "c"], model_options),
        (&["eval", "--renders", "r", "--scene", "c"], model_options),
        (&["eval", "--weights", "w", "--scene", "c"], dataset_options),
        (&data, scene_options),
    ];
    for (command_line, options) in commands {
        for option in options {
            let output = command(&[command_line, &option].concat()).output().unwrap();
            let error = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{error}");
            assert!(error.contains("cannot be used with") && error.contains(option[0]), "{error}");
        }
    }
}

#[test]
fn unknown_precisions() {
    let (folder, room) = room();
    let (weights, splat) = (tiny_weights(folder.path(), &room), folder.path().join("out.ply"));
    let files = ["--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&splat)];
    let error = refuse(&[&["reconstruct", "--precision", "f16"], &files[..]].concat());
    assert_says(&error, &["--precision: f16", "f32 or bf16"]);
    let error = refuse(&[&["eval", "--precision", "f16"], &files[..4]].concat());
    assert_says(&error, &["--precision: f16", "f32 or bf16"]);
    let (config, run) = (folder.path().join("tiny.toml"), folder.path().join("run"));
    let config = ["--config", arg(&config), "--out", arg(&run)];
    let error = refuse(&[&["train", "--set", "train.precision=f16"], &config[..]].concat());
    assert_says(&error, &["--set train.precision=f16", "f32", "bf16"]);
}

#[test]
fn configured_numbers_out_of_range() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let train =
        |setting: &str| refuse(&["train", "--config", arg(&config), "--out", arg(&run), "--set", setting]);
    for (setting, field) in [
        ("train.weight_decay=nan", "train.weight_decay is NaN"),
        ("loss.frustum=-1", "loss.frustum is -1"),
        ("loss.consistency_depth=inf", "loss.consistency_depth is inf"),
        ("train.batch_size=0", "train.batch_size is 0"),
    ] {
        assert_says(&train(setting), &["tiny.toml", field]);
    }
    let error = refuse(&["bench", "train", "--set", "train.batch_size=4"]);
    assert_says(&error, &["--set train.batch_size=4", "--batch N"]);
}

#[test]
fn configurations_with_unknown_or_ill_typed_keys() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let text = std::fs::read_to_string(&config).unwrap();
    let out = folder.path().join("run");
    let train = || refuse(&["train", "--config", arg(&config), "--out", arg(&out)]);
    std::fs::write(&config, text.replace("latents", "latent")).unwrap();
    assert_says(&train(), &["tiny.toml", "unknown field `latent`", "line 3"]);
    std::fs::write(&config, text.replace("latents = 16", "latents = \"many\"")).unwrap();
    assert_says(&train(), &["tiny.toml", "invalid type", "line 3"]);
    std::fs::write(&config, text.replace("[model]", "[model")).unwrap();
    assert_says(&train(), &["tiny.toml", "TOML"]);
    std::fs::write(&config, text.replace("every:3+1", "every:0")).unwrap();
    assert_says(&train(), &["holdout is \"every:0\"", "every:N"]);
    std::fs::write(&config, &text).unwrap();
    let set = |assignment: &str| {
        refuse(&["train", "--config", arg(&config), "--out", arg(&out), "--set", assignment])
    };
    assert_says(&set("model.depth=3"), &["--set model.depth=3", "unknown field"]);
    assert_says(&set("train.steps=soon"), &["--set train.steps=soon", "invalid type"]);
    assert_says(&set("train.steps"), &["--set train.steps", "section.key=value"]);
    assert_says(&set("curriculum.final_stage=3"), &["curriculum.final_stage is 3", "2 at most"]);
    assert_says(&set("train.learning_rate=-1.0"), &["train.learning_rate is -1", "above 0"]);
    assert!(!out.exists(), "nothing was begun");
}

#[test]
fn unwritable_outputs_are_refused_before_the_work() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let (splat, config) = (room.join("truth.ply"), tiny_config(folder.path(), &room));
    // The parent of the output is a file, so that even root can't write it.
    let blocked = room.join("cameras.json").join("below.ply");
    let before = std::fs::read(room.join("cameras.json")).unwrap();
    for arguments in [
        &["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&blocked)][..],
        &["render", "--splat", arg(&splat), "--scene", arg(&room), "--out", arg(&blocked)],
        &["export", "--config", arg(&config), "--out", arg(&blocked)],
        &["train", "--config", arg(&config), "--out", arg(&blocked)],
    ] {
        assert_says(&refuse(arguments), &["cameras.json/below.ply can't be written"]);
    }
    let picture = blocked.with_extension("png");
    let error =
        refuse(&["eval", "--splat", arg(&splat), "--scene", arg(&room), "--contact-sheet", arg(&picture)]);
    assert_says(&error, &["cameras.json/below.png can't be written"]);
    assert_eq!(std::fs::read(room.join("cameras.json")).unwrap(), before);
    let photo = folder.path().join("sheet.jpg");
    for command in [
        &["eval", "--splat", arg(&splat), "--scene", arg(&room), "--contact-sheet", arg(&photo)][..],
        &["synth", "--out", arg(&folder.path().join("worlds")), "--contact-sheet", arg(&photo)],
    ] {
        assert_says(&refuse(command), &["sheet.jpg", "the image's file extension is another, expected .png"]);
    }
    let taken = folder.path().join("taken.ply");
    std::fs::create_dir(&taken).unwrap();
    let error =
        refuse(&["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&taken)]);
    assert_says(&error, &["a folder", "the name of a file"]);
}

/// Runs the program with a file size limit of `kilobytes`, which acts like a full disk.
#[cfg(unix)]
fn on_a_full_disk(kilobytes: u32, arguments: &[&str]) -> std::process::Output {
    // If SIGXFSZ is ignored, a write beyond the limit fails instead of ending the program.
    let script = format!("trap '' XFSZ; ulimit -f {kilobytes}; exec \"$@\"");
    Command::new("bash")
        .args(["-c", &script, "bash", env!("CARGO_BIN_EXE_globalsplat")])
        .args(arguments)
        .output()
        .expect("bash")
}

#[cfg(unix)]
#[test]
fn a_full_disk_leaves_the_existing_file_intact() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let (config, splat) = (tiny_config(folder.path(), &room), folder.path().join("out.ply"));
    succeed(&["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&splat)]);
    let before = [&weights, &splat].map(|path| std::fs::read(path).unwrap());
    for arguments in [
        &["export", "--config", arg(&config), "--out", arg(&weights)][..],
        &["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&splat)],
    ] {
        let output = on_a_full_disk(8, arguments);
        let err = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {err}");
        assert!(err.contains("can't be written"), "{err}");
    }
    for (path, bytes) in [&weights, &splat].iter().zip(before) {
        assert_eq!(std::fs::read(path).unwrap(), bytes, "{}", path.display());
    }
    let left = std::fs::read_dir(folder.path())
        .unwrap()
        .filter(|entry| entry.as_ref().unwrap().file_name().to_string_lossy().contains("partial"));
    assert_eq!(left.count(), 0, "no partial file is left");
}

#[test]
fn a_split_without_target_views() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let error = refuse(&["eval", "--weights", arg(&weights), "--scene", arg(&room), "--holdout", "none"]);
    assert_says(&error, &["0 target views", "--holdout or data.holdout, every:N"]);
}

#[test]
fn an_unavailable_device() {
    let (folder, room) = room();
    let weights = tiny_weights(folder.path(), &room);
    let eval = |device: &str| {
        refuse(&["eval", "--weights", arg(&weights), "--scene", arg(&room), "--device", device])
    };
    assert_says(&eval("tpu"), &["--device tpu", "cpu, cuda or cuda:N"]);
    assert_says(&eval("cuda:99"), &["--device cuda:99", "CUDA devices"]);
}

#[test]
fn an_unknown_simd_level() {
    let output = Command::new(env!("CARGO_BIN_EXE_globalsplat"))
        .arg("doctor")
        .env("GLOBALSPLAT_SIMD", "mmx")
        .output()
        .expect("a program that starts");
    assert_ne!(output.status.code(), Some(0));
    assert!(String::from_utf8_lossy(&output.stderr).contains("GLOBALSPLAT_SIMD is 'mmx', expected one of"));
}

#[test]
fn a_checkpoint_of_another_model() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&["train", "--config", arg(&config), "--out", arg(&run)]);
    let error = refuse(&["train", "--config", arg(&config), "--out", arg(&run), "--set", "model.width=64"]);
    assert_says(&error, &["model.safetensors", "more that don't fit"]);
}

#[test]
fn invalid_lpips_weights() {
    let (folder, room) = room();
    let file = folder.path().join("lpips_vgg.safetensors");
    let splat = room.join("truth.ply");
    let score = || {
        let output = command(&["eval", "--splat", arg(&splat), "--scene", arg(&room)])
            .env("GLOBALSPLAT_WEIGHTS", folder.path())
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(2));
        assert!(output.stdout.is_empty());
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(error.trim().lines().count(), 1, "{error}");
        error
    };
    std::fs::write(&file, "no weights").unwrap();
    assert_says(&score(), &[arg(&file), "broken", "safetensors"]);
    std::fs::rename(tiny_weights(folder.path(), &room), &file).unwrap();
    assert_says(&score(), &[arg(&file), "tensor conv1_1.bias is missing, expected [64]"]);
}

#[test]
fn perceptual_losses_without_their_weights() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let train = |kind: &str, more: &str| {
        let (kind, more) = (format!("loss.perceptual={kind}"), format!("loss.{more}"));
        let arguments =
            ["train", "--config", arg(&config), "--out", arg(&run), "--set", &kind, "--set", &more];
        let output = command(&arguments).env("GLOBALSPLAT_WEIGHTS", folder.path()).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8(output.stderr).unwrap()
    };
    let error = train("vgg19", "perceptual_factor=1");
    assert_says(
        &error,
        &["loss.perceptual_weights is", "vgg19.safetensors, which doesn't exist", "torchvision"],
    );
    assert_says(
        &train("lpips_vgg", "perceptual_factor=1"),
        &["lpips_vgg.safetensors", "`make weights` creates it"],
    );
    assert_says(
        &train("vgg19", "perceptual_weights=elsewhere/v.safetensors"),
        &["is elsewhere/v.safetensors"],
    );
    assert_says(&train("vgg16", "perceptual_factor=1"), &["unknown variant `vgg16`"]);
    // The file exists but contains the weights of another network.
    let weights = tiny_weights(folder.path(), &room);
    let named = format!("perceptual_weights={:?}", arg(&weights));
    assert_says(&train("vgg19", &named), &["tiny.safetensors", "features.0."]);
}
