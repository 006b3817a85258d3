//! Training runs survive being killed, damaged checkpoints, a full disk, and a second run in the same folder.
#![cfg(unix)]

use crate::common::program::{Sandbox, assert_says, limit_file_size, wait_for};
use crate::{assert_same_bits, checkpoints, metrics, steps, train};
use globalsplat::config::Config;
use globalsplat::data::TrainingScenes;
use globalsplat::error::Error;
use globalsplat::io::{read_weights, write_weights};
use globalsplat::train::{Resume, Score, Trainer, Validator, latest_checkpoint};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::time::Duration;
use tch::{Device, Tensor};

/// Returns the last checkpoint's tensors, by file and name.
fn tensors(run: &Path) -> Vec<(String, Tensor)> {
    let checkpoint = latest_checkpoint(run).unwrap();
    let mut all = vec![];
    for file in ["model.safetensors", "optimizer.safetensors"] {
        let weights = read_weights(&checkpoint.join(file)).unwrap();
        all.extend(weights.tensors.into_iter().map(|(name, tensor)| (format!("{file} {name}"), tensor)));
    }
    all
}

/// Returns the number of lines of metrics.jsonl.
fn count_metrics_lines(run: &Path) -> usize {
    std::fs::read_to_string(run.join("metrics.jsonl")).map_or(0, |text| text.lines().count())
}

fn wait_for_lines(child: &mut Child, run: &Path, count: usize) {
    wait_for(std::slice::from_mut(child), || (count_metrics_lines(run) >= count).then_some(()));
}

#[test]
fn a_run_that_is_killed_ends_with_the_same_bits() {
    const STEPS: u64 = 15;
    let sandbox = Sandbox::new();
    let (whole, killed) = (sandbox.path("whole"), sandbox.path("killed"));
    // Muon updates some weights, and AdamW the others.
    let settings = "train.checkpoint_every=1 train.validate_every=5 train.optimizer=muon train.steps=15";
    let begun = std::time::Instant::now();
    sandbox.succeed(&train("whole", settings));
    let step_time = begun.elapsed().as_secs_f64() / STEPS as f64;
    // A checkpoint after every step: saves take about as much time as steps.
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for _ in 0..3 {
        let lines = count_metrics_lines(&killed) + random.random_range(0..=2);
        let mut child = sandbox.command(&train("killed", settings));
        let mut child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        wait_for_lines(&mut child, &killed, lines);
        std::thread::sleep(Duration::from_secs_f64(random.random_range(0.0..2. * step_time)));
        child.kill().unwrap();
        assert!(!child.wait().unwrap().success(), "it was still going on");
    }
    sandbox.succeed(&train("killed", settings));
    assert_same_bits(&whole, &killed);
    let validated = (1..=STEPS / 5).map(|i| 5 * i - 1).collect();
    assert_eq!(steps(&killed), ((0..STEPS).collect(), validated), "every record is written once");
    let [a, b] = ["whole", "killed"].map(|run| sandbox.read(&format!("{run}/best/state.json")));
    assert_eq!(a, b, "the best checkpoint, by the same score");
    let [a, b] = ["whole", "killed"].map(|run| sandbox.names(&format!("{run}/checkpoints")));
    assert_eq!(a, b, "what the kills left is cleared away");
}

#[test]
fn a_broken_checkpoint_is_skipped_and_not_exported() {
    let sandbox = Sandbox::new();
    sandbox.succeed(&train("whole", ""));
    sandbox.succeed(&train("run", ""));
    // Flip one bit of a weight, which leaves the file format valid.
    for (byte, checkpoint, best) in [(5, "best", "--best"), (6, "checkpoints/step-00000006", "")] {
        let file = format!("run/{checkpoint}/model.safetensors");
        let mut bytes = sandbox.read(&file);
        let index = bytes.len() - byte;
        bytes[index] ^= 1;
        sandbox.write(&file, &bytes);
        let error = sandbox.refuse(&format!("export --run @run --out @weights.safetensors {best}"));
        assert_says(&error, &["model.safetensors: the file is damaged"]);
    }
    assert!(!sandbox.path("weights.safetensors").exists());
    let (_, err) = sandbox.succeed_with_messages(&train("run", ""));
    let damaged = "step-00000006/model.safetensors: the file is damaged";
    assert_says(&err, &[damaged, "the previous checkpoint is used"]);
    assert_same_bits(&sandbox.path("whole"), &sandbox.path("run"));

    let all = sandbox.names("run/checkpoints");
    all.iter().for_each(|step| sandbox.write(&format!("run/checkpoints/{step}/state.json"), "{"));
    assert_says(&sandbox.refuse(&train("run", "")), &[&format!("broken, all {} of them", all.len())]);
}

#[test]
fn a_second_run_in_the_same_folder_is_refused() {
    let sandbox = Sandbox::new();
    let mut child = sandbox.command(&train("run", "train.steps=1000000"));
    let mut child = child.stderr(Stdio::null()).spawn().unwrap();
    wait_for_lines(&mut child, &sandbox.path("run"), 1);
    let expected = format!("the run is in use by process {}", child.id());
    assert_says(&sandbox.refuse(&train("run", "")), &[&expected]);
    child.kill().unwrap();
    child.wait().unwrap();
    // The lock is released when the process ends.
    sandbox.succeed(&train("run", ""));
}

#[test]
fn a_full_disk_ends_a_run_which_resumes_from_its_last_checkpoint() {
    let (sandbox, settings) = (Sandbox::new(), "train.keep_checkpoints=3 data.holdout=none");
    let [whole, run] = ["whole", "run"].map(|name| sandbox.path(name));
    for name in ["whole", "run"] {
        sandbox.succeed(&train(name, settings));
    }
    for step in [4, 6] {
        std::fs::remove_dir_all(run.join(format!("checkpoints/step-{step:08}"))).unwrap();
    }
    let output = limit_file_size(&sandbox.command(&train("run", settings))).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert_says(&String::from_utf8(output.stderr).unwrap(), &["can't be written: File too large"]);
    assert_eq!(checkpoints(&run), [2]);
    sandbox.succeed(&train("run", settings));
    assert_same_bits(&whole, &run);
    assert_eq!(steps(&run).0, (0..6).collect::<Vec<_>>(), "every step once");
}

#[test]
fn numbers_that_are_not_finite_end_a_run_and_leave_the_checkpoint_before_them() {
    let (sandbox, settings) = (Sandbox::new(), "train.steps=40 train.learning_rate=1e30");
    let run = sandbox.path("run");
    sandbox.succeed(&train("run", "train.steps=4"));
    let good = tensors(&run);
    // One step is enough to ruin all weights. Without a check, every second step would be saved and would replace good
    // checkpoints.
    let ruin = format!("{settings} train.checkpoint_every=2 train.max_nonfinite_steps=5");
    let (code, _, error) = sandbox.output(&train("run", &ruin));
    assert_eq!(code, Some(1));
    let step = "step 9 showed room";
    assert_says(&error, &["the last 5 steps was not finite", step, "step-00000004 is from before"]);
    assert_eq!(checkpoints(&run), [2, 4]);
    assert!(tensors(&run).iter().zip(&good).all(|((_, x), (_, y))| x.equal(y)));
    let records = metrics(&run).0;
    let skipped: Vec<bool> = records.iter().filter_map(|line| line["skipped"].as_bool()).collect();
    assert_eq!(skipped, [[false; 5], [true; 5]].concat());
    assert_eq!(records.last().unwrap()["scenes"], json!(["room"]));

    // With a reasonable learning rate, the run resumes from there.
    sandbox.succeed(&train("run", "train.steps=8"));
    assert_eq!(steps(&run), ((0..8).collect(), vec![3, 7]));
}

#[test]
fn a_changed_configuration_is_reported_and_resumes_in_the_data() {
    let sandbox = Sandbox::new();
    let stderr = |settings: &str| sandbox.succeed_with_messages(&train("run", settings)).1;
    assert_eq!(stderr("train.steps=3 train.batch_size=1"), "");
    assert!(!stderr("train.steps=3 train.batch_size=1").contains("configuration"));
    let message = "resuming with a changed configuration: train.batch_size 1 → 2, train.steps 3 → 5\n";
    assert_says(&stderr("train.steps=5 train.batch_size=2"), &[message]);
    let state = sandbox.read_json("run/checkpoints/step-00000005/state.json");
    assert_eq!((&state["step"], &state["samples"]), (&json!(5), &json!(3 + 2 * 2)));
    // Muon needs less state than AdamW has saved; in the other direction, some is missing.
    stderr("train.steps=6 train.optimizer=muon");
    let error = sandbox.refuse(&train("run", "train.steps=7 train.optimizer=adamw"));
    assert_says(&error, &["optimizer.safetensors: second.slot_encoder.", " is missing, expected shape ["]);
}

#[test]
fn the_best_checkpoint_is_kept_and_exported() {
    let sandbox = Sandbox::new();
    let run = sandbox.path("run");
    // Training that improves at first and then diverges: the best checkpoint is not the last.
    let settings =
        "train.validate_every=2 train.keep_checkpoints=1 data.holdout=none 'data.validation=[\"@room\"]'";
    for more in ["train.steps=10 train.learning_rate=3e-3", "train.steps=14 train.learning_rate=1"] {
        sandbox.succeed(&train("run", &format!("{settings} {more}")));
    }
    let scored =
        |line: &Value| (line["step"].as_u64().unwrap(), line["validation"]["psnr"].as_f64().unwrap());
    let validations: Vec<(u64, f64)> = metrics(&run).1.iter().map(scored).collect();
    assert!(validations.iter().map(|v| v.0).eq((0..7).map(|i| 2 * i + 1)), "{validations:?}");
    let best = validations.iter().fold(validations[0], |a, b| if b.1 > a.1 { *b } else { a });
    assert!(best.0 < 13, "{validations:?}");
    let state = sandbox.read_json("run/best/state.json");
    assert_eq!((&state["step"], &state["validation"]["psnr"]), (&json!(best.0 + 1), &json!(best.1)));
    assert_eq!(checkpoints(&run), [best.0 + 1, 14], "the best one is kept, too");

    sandbox.succeed("export --run @run --best --out @best.safetensors");
    let is_exported = |folder: &Path| {
        let files = [sandbox.path("best.safetensors"), folder.join("model.safetensors")];
        let [a, b] = files.map(|file| read_weights(&file).unwrap().tensors);
        a.iter().zip(&b).all(|((_, x), (_, y))| x.equal(y))
    };
    assert!(is_exported(&run.join("best")) && !is_exported(&latest_checkpoint(&run).unwrap()));
}

#[test]
fn a_changed_validation_discards_the_best_checkpoint() {
    let sandbox = Sandbox::new();
    sandbox.succeed(&train("run", "train.steps=4 train.validate_every=2"));
    let state = "run/best/state.json";
    sandbox.change_json(state, |best| best["validation"]["psnr"] = json!(99.));
    let again = |settings: &str| {
        let (_, err) = sandbox.succeed_with_messages(&train("run", settings));
        (err, sandbox.read_json(state)["validation"]["psnr"] != json!(99.))
    };
    assert!(!again("train.steps=5").1, "nothing is as good");
    let (err, is_beaten) = again("train.steps=6 data.holdout=every:4");
    assert_says(&err, &["best: the validation is of", "determined again"]);
    assert!(is_beaten);
    sandbox.write(state, "{");
    let (err, is_beaten) = again("train.steps=7 data.holdout=every:4");
    assert_says(&err, &["best/state.json: the file is broken", "determined again"]);
    assert!(is_beaten);
}

#[test]
fn a_run_goes_on_from_a_checkpoint_that_is_named_unless_it_has_later_ones() {
    let sandbox = Sandbox::new();
    sandbox.succeed(&train("run", "train.checkpoint_every=2"));
    assert_eq!(checkpoints(&sandbox.path("run")), [4, 6]);
    let resume = |run: &str| format!("{} --resume @run/checkpoints/step-00000004", train(run, ""));
    assert_says(&sandbox.refuse(&resume("run")), &["step-00000006", "none after step 4"]);
    sandbox.succeed(&resume("branch"));
    assert_same_bits(&sandbox.path("run"), &sandbox.path("branch"));
    assert_eq!(steps(&sandbox.path("branch")).0, [4, 5]);
    // A complete run keeps the checkpoint that it is resumed from, with its score.
    let state = || sandbox.read("run/checkpoints/step-00000006/state.json");
    let before = state();
    sandbox.succeed(&format!("{} --resume @run/./checkpoints/step-00000006", train("run", "")));
    assert!(state() == before && sandbox.read_json("run/best/state.json")["validation"].is_object());
}

/// Validator that is always interrupted before it has a score.
struct Stopped;

impl Validator for Stopped {
    fn scenes(&self) -> usize {
        1
    }

    fn validate(&mut self, _: &Trainer, _: &mut dyn FnMut() -> bool) -> Result<Option<Score>, Error> {
        Ok(None)
    }
}

#[test]
fn a_run_is_not_complete_without_its_last_validation() {
    let sandbox = Sandbox::new();
    let config = Config::read(&sandbox.path("tiny.toml"), &["train.steps=1".into()]).unwrap();
    let run = |validator: Option<&mut dyn Validator>| {
        let scenes = Arc::new(TrainingScenes::find(&config.data.capture_paths().unwrap()).unwrap());
        let mut trainer = Trainer::new(&config, scenes, Device::Cpu).unwrap();
        let out = sandbox.path("run");
        std::fs::create_dir_all(&out).unwrap();
        globalsplat::train::run(&mut trainer, &out, &Resume::Auto, validator, |_| true).unwrap()
    };
    assert!(!run(Some(&mut Stopped)).complete);
    assert!(run(None).complete);
}

#[test]
fn held_out_scenes_are_checked_before_training() {
    let sandbox = Sandbox::new();
    let error = sandbox.refuse(&train("run", "'data.validation=[\"nowhere\"]'"));
    assert_says(&error, &["nowhere"]);
    // The held-out views of the training scene, and a scene that is held out as a whole.
    let settings = "'data.validation=[\"@room\"]' train.steps=1";
    let (out, err) = sandbox.succeed_with_messages(&train("run", settings));
    assert_eq!(out.lines().filter(|line| line.starts_with("room")).count(), 2, "{out}");
    assert_says(&err, &["room of data.validation is also a training scene"]);
    assert_eq!(metrics(&sandbox.path("run")).1.last().unwrap()["validation"]["scenes"], 2);
}

#[test]
fn weights_are_used_at_the_stage_that_they_were_trained_to() {
    let sandbox = Sandbox::new();
    // Stages 1 and 2 start at steps 2 and 4, with transitions of two steps each.
    let settings = "train.checkpoint_every=1 train.keep_checkpoints=6 train.validate_every=1";
    sandbox.succeed(&train("run", settings));
    let validations = metrics(&sandbox.path("run")).1;
    let scores = validations.iter().map(|line| &line["validation"]);
    let stages: Vec<_> = scores.map(|v| (v["stage"].as_u64().unwrap(), v["mix"].as_f64().unwrap())).collect();
    let expected = [(0, 1.), (0, 1.), (1, 0.), (1, 0.5), (2, 0.), (2, 1.)];
    assert_eq!(stages, expected, "the last one is a finished run's");
    let weights = |step: u64| format!("run/checkpoints/step-{step:08}/model.safetensors");
    let reconstruct = "reconstruct --scene @room --out @room.ply --weights";
    for (step, gaussians, warning) in
        [(1, 16, Some("stage 0 (λ 1.00) of 2")), (4, 32, Some("stage 1 (λ 0.50) of 2")), (6, 64, None)]
    {
        let (_, out, err) = sandbox.output(&format!("{reconstruct} @{} --json", weights(step)));
        let report: Value = serde_json::from_str(&out).unwrap();
        assert_eq!(report["gaussians"], gaussians);
        let of_stage = err.lines().find(|line| line.contains(" stage "));
        assert_eq!(warning.map(|warning| err.contains(warning)), of_stage.map(|_| true), "{err}");
    }
    let mut file = read_weights(&sandbox.path(&weights(1))).unwrap();
    for stage in ["3", "{\"index\": 1, \"mix\": 1.5}"] {
        file.metadata.insert("globalsplat.stage".into(), stage.into());
        let broken = sandbox.path("broken.safetensors");
        write_weights(&broken, &file.tensors, file.metadata.clone()).unwrap();
        let error = sandbox.refuse(&format!("{reconstruct} @broken.safetensors"));
        assert_says(&error, &["metadata globalsplat.stage is"]);
    }
}

#[test]
fn a_run_begins_with_the_weights_that_are_named() {
    let sandbox = Sandbox::new();
    sandbox.succeed(&train("first", "train.seed=3"));
    sandbox.succeed("export --run @first --out @model.safetensors");
    let from = |run: &str, settings: &str| format!("{} --from @model.safetensors", train(run, settings));
    // The learning rate is too small to change any weight.
    sandbox.succeed(&from("second", "train.steps=1 train.learning_rate=1e-30"));
    let of_model = |run: &str| -> Vec<_> {
        let tensors = tensors(&sandbox.path(run)).into_iter();
        tensors.filter(|(name, _)| name.starts_with("model")).collect()
    };
    for ((name, x), (_, y)) in of_model("first").iter().zip(of_model("second")) {
        assert!(x.equal(&y), "{name}");
    }
    let stage = &metrics(&sandbox.path("second")).0[0]["stage"];
    assert_eq!(stage, 2, "all Gaussians are shown from the first step on");

    // Smaller patches and more scene tokens change only the weights that depend on them.
    let still = "train.steps=1 train.learning_rate=1e-30 model.patch_size=4 model.latents=32";
    sandbox.succeed(&from("larger", still));
    for ((name, of_small), (_, of_large)) in of_model("first").iter().zip(of_model("larger")) {
        let converted = ["_patch_embeds.1.weight", "scene_tokens", "geo_param_readout.bias"];
        let is_converted = converted.iter().any(|ending| name.ends_with(ending));
        assert_eq!(of_small.equal(&of_large), !is_converted, "{name}");
    }

    for (settings, expected) in [
        ("model.patch_size=20 'data.image_size=[40,40]'", "the model is model.patch_size 8 → 20, expected"),
        (
            "model.width=64 model.latents=24",
            "model.safetensors: the model is model.latents 16 → 24, model.width 32 → 64, expected",
        ),
    ] {
        assert_says(&sandbox.refuse(&from("other", settings)), &[expected]);
    }
    assert!(!sandbox.path("other/checkpoints").exists(), "nothing was begun");

    // A run that has a checkpoint doesn't need the initial weights any more.
    std::fs::remove_file(sandbox.path("model.safetensors")).unwrap();
    sandbox.succeed(&from("second", "train.steps=2 train.learning_rate=1e-30"));
}
