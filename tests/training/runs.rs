//! Training runs survive being killed, damaged checkpoints, a full disk, and a second run in the same folder.
#![cfg(unix)]

use crate::common::program::{arg, command, fail, refuse, room, succeed, text, tiny_config, train};
use crate::{assert_same_bits, checkpoints, metrics, steps};
use globalsplat::config::Config;
use globalsplat::data::TrainingScenes;
use globalsplat::error::Error;
use globalsplat::train::{Resume, Score, Trainer, Validator};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;
use tch::Device;

/// Returns the last checkpoint's tensors, by file and name.
fn tensors(run: &Path) -> Vec<(String, tch::Tensor)> {
    let checkpoint = globalsplat::train::latest_checkpoint(run).unwrap();
    let mut all = vec![];
    for file in ["model.safetensors", "optimizer.safetensors"] {
        let weights = globalsplat::io::read_weights(&checkpoint.join(file)).unwrap();
        all.extend(weights.tensors.into_iter().map(|(name, tensor)| (format!("{file} {name}"), tensor)));
    }
    all.sort_by(|a, b| a.0.cmp(&b.0));
    all
}

#[test]
fn a_run_that_is_killed_ends_with_the_same_bits() {
    const STEPS: u64 = 15;
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    // Muon updates some weights, and AdamW the others.
    let settings = ["train.checkpoint_every=1", "train.validate_every=5", "train.optimizer=muon"];
    let steps_key = format!("train.steps={STEPS}");
    let settings = [&settings[..], &[&steps_key]].concat();
    let run = |out: &Path| command(&text(&train(&config, out, &settings)));
    let begun = std::time::Instant::now();
    assert!(run(&whole).output().unwrap().status.success());
    let step_time = begun.elapsed().as_secs_f64() / STEPS as f64;
    // A checkpoint after every step: saves take about as much time as steps.
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for _ in 0..3 {
        let lines = count_metrics_lines(&killed) + random.random_range(0..=2);
        let mut child = run(&killed).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        wait_for_lines(&mut child, &killed, lines);
        std::thread::sleep(Duration::from_secs_f64(random.random_range(0.0..2. * step_time)));
        child.kill().unwrap();
        assert!(!child.wait().unwrap().success(), "it was still going on");
    }
    let output = run(&killed).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_same_bits(&whole, &killed);
    let validated = (1..=STEPS / 5).map(|i| 5 * i - 1).collect();
    assert_eq!(steps(&killed), ((0..STEPS).collect(), validated), "every record is written once");
    let of = |run: &Path| std::fs::read(run.join("best/state.json")).unwrap();
    assert_eq!(of(&whole), of(&killed), "the best checkpoint, by the same score");
    let left: Vec<_> = std::fs::read_dir(killed.join("checkpoints")).unwrap().collect();
    assert_eq!(left.len(), 2, "what the kills left is cleared away: {left:?}");
}

#[test]
fn a_broken_checkpoint_is_skipped_and_not_exported() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let (whole, run) = (folder.path().join("whole"), folder.path().join("run"));
    let train =
        |out: &Path| command(&["train", "--config", arg(&config), "--out", arg(out)]).output().unwrap();
    assert!(train(&whole).status.success() && train(&run).status.success());
    // Flip one bit of a weight, which leaves the file format valid. The file and that of the best checkpoint may be hard links to one.
    let weights = folder.path().join("weights.safetensors");
    for (checkpoint, best) in [("best", Some("--best")), ("checkpoints/step-00000006", None)] {
        let file = run.join(checkpoint).join("model.safetensors");
        let mut bytes = std::fs::read(&file).unwrap();
        let last = bytes.len() - 5;
        bytes[last] ^= 1;
        std::fs::remove_file(&file).unwrap();
        std::fs::write(&file, &bytes).unwrap();
        let export = ["export", "--run", arg(&run), "--out", arg(&weights)];
        let error = fail(&[&export[..], best.as_slice()].concat(), 2);
        assert!(error.contains("model.safetensors: the file is damaged"), "{error}");
    }
    assert!(!weights.exists());
    let output = train(&run);
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{err}");
    assert!(err.contains("step-00000006/model.safetensors: the file is damaged"), "{err}");
    assert!(err.contains("the previous checkpoint is used"), "{err}");
    assert_same_bits(&whole, &run);

    for step in ["step-00000004", "step-00000006"] {
        std::fs::write(run.join("checkpoints").join(step).join("state.json"), "{").unwrap();
    }
    let arguments = ["train", "--config", arg(&config), "--out", arg(&run)];
    let output = command(&arguments).output().unwrap();
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && err.contains("broken, all 2 of them"), "{err}");
}

/// Returns the command of a training with so many steps that it doesn't end.
fn endless(config: &Path, run: &Path) -> Command {
    command(&["train", "--config", arg(config), "--out", arg(run), "--set", "train.steps=1000000"])
}

/// Returns the number of lines of metrics.jsonl.
fn count_metrics_lines(run: &Path) -> usize {
    std::fs::read(run.join("metrics.jsonl")).map_or(0, |text| text.lines().count())
}

fn wait_for_lines(child: &mut Child, run: &Path, count: usize) {
    while count_metrics_lines(run) < count {
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_second_run_in_the_same_folder_is_refused() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let mut child = endless(&config, &run).stderr(Stdio::null()).spawn().unwrap();
    wait_for_lines(&mut child, &run, 1);
    let error = fail(&["train", "--config", arg(&config), "--out", arg(&run)], 2);
    assert!(error.contains(&format!("the run is in use by process {}", child.id())), "{error}");
    child.kill().unwrap();
    child.wait().unwrap();
    // The lock is released when the process ends.
    succeed(&["train", "--config", arg(&config), "--out", arg(&run)]);
}

fn set_file_size_limit(child: &Child, bytes: libc::rlim_t) {
    let limit = libc::rlimit { rlim_cur: bytes, rlim_max: libc::RLIM_INFINITY };
    // SAFETY: sets a limit of a child process that has not been waited for; the old limit is not returned.
    let result =
        unsafe { libc::prlimit(child.id() as i32, libc::RLIMIT_FSIZE, &limit, std::ptr::null_mut()) };
    assert_eq!(result, 0);
}

/// Starts training with a file size limit of 8 kB, which acts like a full disk.
fn on_a_full_disk(config: &Path, run: &Path) -> (Child, BufReader<std::process::ChildStderr>, PathBuf) {
    // If SIGXFSZ is ignored, the system refuses the write instead of ending the program.
    let mut child = Command::new("bash")
        .args(["-c", "trap '' XFSZ; ulimit -S -f 8; exec \"$@\"", "bash", env!("CARGO_BIN_EXE_globalsplat")])
        .args(["train", "--config", arg(config), "--out", arg(run)])
        .env("OMP_NUM_THREADS", "1")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    said.read_line(&mut line).unwrap();
    assert!(line.starts_with("training paused: ") && line.contains("can't be written"), "{line}");
    (child, said, run.join("checkpoints"))
}

#[test]
fn a_full_disk_pauses_training_until_there_is_room() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let whole = folder.path().join("whole");
    succeed(&["train", "--config", arg(&config), "--out", arg(&whole)]);
    let (mut child, mut said, checkpoints) = on_a_full_disk(&config, &run);
    assert_eq!(std::fs::read_dir(&checkpoints).map_or(0, Iterator::count), 0, "no half checkpoint");
    set_file_size_limit(&child, libc::RLIM_INFINITY);
    let mut line = String::new();
    said.read_line(&mut line).unwrap();
    assert_eq!(line, "disk space is available again: training resumes\n");
    assert!(child.wait().unwrap().success());
    assert_same_bits(&whole, &run);
}

#[test]
fn a_run_that_waits_for_room_can_be_stopped() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let (mut child, mut said, _) = on_a_full_disk(&config, &run);
    // SAFETY: sends a signal to a child process that has not been waited for.
    unsafe { libc::kill(child.id() as i32, libc::SIGTERM) };
    assert_eq!(child.wait().unwrap().code(), Some(1));
    let mut line = String::new();
    said.read_line(&mut line).unwrap();
    assert!(line.contains("can't be written"), "{line}");
}

#[test]
fn numbers_that_are_not_finite_end_a_run_and_leave_the_checkpoint_before_them() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&text(&train(&config, &run, &["train.steps=4"])));
    let good = tensors(&run);
    // One step is enough to ruin all weights. Without a check, every second step would be saved and would replace good
    // checkpoints.
    let ruin = [
        "train.steps=40",
        "train.learning_rate=1e30",
        "train.checkpoint_every=2",
        "train.max_nonfinite_steps=5",
    ];
    let output = command(&text(&train(&config, &run, &ruin))).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let error = String::from_utf8_lossy(&output.stderr);
    for part in ["the last 5 steps was not finite", "step 9 showed room_000", "step-00000004 is from before"]
    {
        assert!(error.contains(part), "{part}: {error}");
    }
    assert_eq!(checkpoints(&run), [2, 4]);
    assert!(tensors(&run).iter().zip(&good).all(|((_, x), (_, y))| x.equal(y)));
    let records = metrics(&run).0;
    let skipped: Vec<bool> = records.iter().filter_map(|line| line["skipped"].as_bool()).collect();
    assert_eq!(skipped, [[false; 5], [true; 5]].concat());
    assert_eq!(records.last().unwrap()["scenes"], serde_json::json!(["room_000"]));

    // With a reasonable learning rate, the run resumes from there.
    succeed(&text(&train(&config, &run, &["train.steps=8"])));
    assert_eq!(steps(&run), ((0..8).collect(), vec![3, 7]));
}

#[test]
fn a_changed_configuration_is_reported_and_resumes_in_the_data() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let stderr = |settings: &[&str]| {
        let output = command(&text(&train(&config, &run, settings))).output().unwrap();
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(stderr(&["train.steps=3", "train.batch_size=1"]), "");
    let same = stderr(&["train.steps=3", "train.batch_size=1"]);
    assert!(!same.contains("configuration"), "{same}");
    let other = stderr(&["train.steps=5", "train.batch_size=2"]);
    let message = "resuming with a changed configuration: train.batch_size 1 → 2, train.steps 3 → 5\n";
    assert!(other.contains(message), "{other}");
    let state = std::fs::read(run.join("checkpoints/step-00000005/state.json")).unwrap();
    let state: Value = serde_json::from_slice(&state).unwrap();
    assert_eq!((state["step"].as_u64(), state["samples"].as_u64()), (Some(5), Some(3 + 2 * 2)));
    // Muon needs less state than AdamW has saved; in the other direction, some is missing.
    stderr(&["train.steps=6", "train.optimizer=muon"]);
    let refused = refuse(&text(&train(&config, &run, &["train.steps=7", "train.optimizer=adamw"])));
    assert!(refused.contains("optimizer.safetensors: second.slot_encoder."), "{refused}");
    assert!(refused.contains(" is missing, expected shape ["), "{refused}");
}

#[test]
fn the_best_checkpoint_is_kept_and_exported() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    // Training that improves at first and then diverges: the best checkpoint is not the last.
    let all = ["train.validate_every=2", "train.keep_checkpoints=1", "data.holdout=none"];
    let scenes = format!("data.validation=[{:?}]", arg(&room));
    let settings = [&all[..], &[&scenes]].concat();
    succeed(&text(&train(
        &config,
        &run,
        &[&settings[..], &["train.steps=10", "train.learning_rate=3e-3"]].concat(),
    )));
    succeed(&text(&train(
        &config,
        &run,
        &[&settings[..], &["train.steps=14", "train.learning_rate=1"]].concat(),
    )));
    let validations: Vec<(u64, f64)> = metrics(&run)
        .1
        .iter()
        .map(|line| (line["step"].as_u64().unwrap(), line["validation"]["psnr"].as_f64().unwrap()))
        .collect();
    assert_eq!(
        validations.iter().map(|v| v.0).collect::<Vec<_>>(),
        (0..7).map(|i| 2 * i + 1).collect::<Vec<_>>()
    );
    let best = validations.iter().fold(validations[0], |a, b| if b.1 > a.1 { *b } else { a });
    assert!(best.0 < 13, "{validations:?}");
    let state: Value = serde_json::from_slice(&std::fs::read(run.join("best/state.json")).unwrap()).unwrap();
    let reported = (state["step"].as_u64(), state["validation"]["psnr"].as_f64());
    assert_eq!(reported, (Some(best.0 + 1), Some(best.1)));
    assert_eq!(checkpoints(&run), [14], "the best one is kept beside them");

    let weights = folder.path().join("best.safetensors");
    succeed(&["export", "--run", arg(&run), "--best", "--out", arg(&weights)]);
    let read = |path: &Path| globalsplat::io::read_weights(path).unwrap().tensors;
    let (exported, kept) = (read(&weights), read(&run.join("best/model.safetensors")));
    assert!(exported.iter().zip(&kept).all(|((_, x), (_, y))| x.equal(y)));
    let last = read(&globalsplat::train::latest_checkpoint(&run).unwrap().join("model.safetensors"));
    assert!(!exported.iter().zip(&last).all(|((_, x), (_, y))| x.equal(y)));
}

#[test]
fn a_changed_validation_discards_the_best_checkpoint() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&text(&train(&config, &run, &["train.steps=4", "train.validate_every=2"])));
    let state = run.join("best/state.json");
    let mut best: Value = serde_json::from_slice(&std::fs::read(&state).unwrap()).unwrap();
    let beaten = |best: &Value| best["validation"]["psnr"].as_f64() != Some(99.);
    best["validation"]["psnr"] = 99.into();
    std::fs::write(&state, best.to_string()).unwrap();
    let again = |settings: &[&str]| {
        let output = command(&text(&train(&config, &run, settings))).output().unwrap();
        assert!(output.status.success());
        let best: Value = serde_json::from_slice(&std::fs::read(&state).unwrap()).unwrap();
        (String::from_utf8(output.stderr).unwrap(), beaten(&best))
    };
    assert!(!again(&["train.steps=5"]).1, "nothing is as good");
    let (said, is_beaten) = again(&["train.steps=6", "data.holdout=every:4"]);
    assert!(said.contains("best: the validation is of") && said.contains("determined again"), "{said}");
    assert!(is_beaten);
    std::fs::write(&state, "{").unwrap();
    let (said, is_beaten) = again(&["train.steps=7", "data.holdout=every:4"]);
    assert!(said.contains("state.json: the file is broken") && is_beaten, "{said}");
}

#[test]
fn a_run_goes_on_from_a_checkpoint_that_is_named_unless_it_has_later_ones() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    succeed(&text(&train(&config, &run, &["train.checkpoint_every=2"])));
    assert_eq!(checkpoints(&run), [4, 6]);
    let from = run.join("checkpoints/step-00000004");
    let resume = |out: &Path| [train(&config, out, &[]), vec!["--resume".into(), arg(&from).into()]].concat();
    let error = fail(&text(&resume(&run)), 2);
    assert!(error.contains("step-00000006") && error.contains("none after step 4"), "{error}");
    let branch = folder.path().join("branch");
    succeed(&text(&resume(&branch)));
    assert_same_bits(&run, &branch);
    assert_eq!(steps(&branch).0, [4, 5]);
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
    let (folder, room) = room();
    let config = Config::read(&tiny_config(folder.path(), &room), &["train.steps=1".into()]).unwrap();
    let run = |validator: Option<&mut dyn Validator>| {
        let scenes = Arc::new(TrainingScenes::find(&config.data.capture_paths().unwrap()).unwrap());
        let mut trainer = Trainer::new(&config, scenes, Device::Cpu).unwrap();
        globalsplat::train::run(&mut trainer, folder.path(), &Resume::Auto, validator, |_| true).unwrap()
    };
    assert!(!run(Some(&mut Stopped)).complete);
    assert!(run(None).complete);
}

#[test]
fn held_out_scenes_are_checked_before_training() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let error = fail(&text(&train(&config, &run, &["data.validation=[\"nowhere\"]"])), 2);
    assert!(error.contains("nowhere"), "{error}");
    // The held-out views of the training scene, and a scene that is held out as a whole.
    let scenes = format!("data.validation=[{:?}]", arg(folder.path()));
    let output = command(&text(&train(&config, &run, &[&scenes, "train.steps=1"]))).output().unwrap();
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
    assert_eq!(out.lines().filter(|line| line.starts_with("room_000")).count(), 2, "{out}");
    assert!(err.contains("room_000 of data.validation is also a training scene"), "{err}");
    assert_eq!(metrics(&run).1.last().unwrap()["validation"]["scenes"], 2);
}

#[test]
fn weights_are_used_at_the_stage_that_they_were_trained_to() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    // Stages 1 and 2 start at steps 2 and 4, with transitions of two steps each.
    let settings = ["train.checkpoint_every=1", "train.keep_checkpoints=6", "train.validate_every=1"];
    let out = command(&text(&train(&config, &run, &settings))).output().unwrap();
    assert!(out.status.success());
    let validations = metrics(&run).1;
    let scores = validations.iter().map(|line| &line["validation"]);
    let stages: Vec<_> = scores.map(|v| (v["stage"].as_u64().unwrap(), v["mix"].as_f64().unwrap())).collect();
    assert_eq!(
        stages,
        [(0, 1.), (0, 1.), (1, 0.), (1, 0.5), (2, 0.), (2, 1.)],
        "the last one is a finished run's"
    );
    let splat = folder.path().join("room.ply");
    for (step, gaussians, said) in
        [(1, 16, Some("stage 0 (λ 1.00) of 2")), (4, 32, Some("stage 1 (λ 0.50) of 2")), (6, 64, None)]
    {
        let weights = run.join(format!("checkpoints/step-{step:08}/model.safetensors"));
        let arguments = [
            "reconstruct",
            "--weights",
            arg(&weights),
            "--scene",
            arg(&room),
            "--out",
            arg(&splat),
            "--json",
        ];
        let output = command(&arguments).output().unwrap();
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(report["gaussians"], gaussians);
        let err = String::from_utf8(output.stderr).unwrap();
        let of_stage = err.lines().find(|line| line.contains(" stage "));
        assert_eq!(said.map(|said| err.contains(said)), of_stage.map(|_| true), "{err}");
    }
    let broken = folder.path().join("broken.safetensors");
    let mut file =
        globalsplat::io::read_weights(&run.join("checkpoints/step-00000001/model.safetensors")).unwrap();
    for stage in ["3", "{\"index\": 1, \"mix\": 1.5}"] {
        file.metadata.insert("globalsplat.stage".into(), stage.into());
        globalsplat::io::write_weights(&broken, &file.tensors, file.metadata.clone()).unwrap();
        let error =
            fail(&["reconstruct", "--weights", arg(&broken), "--scene", arg(&room), "--out", arg(&splat)], 2);
        assert!(error.contains("metadata globalsplat.stage is"), "{error}");
    }
}

#[test]
fn a_run_begins_with_the_weights_that_are_named() {
    let (folder, room) = room();
    let config = tiny_config(folder.path(), &room);
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let weights = folder.path().join("model.safetensors");
    succeed(&text(&train(&config, &first, &["train.seed=3"])));
    succeed(&["export", "--run", arg(&first), "--out", arg(&weights)]);
    let from = |run: &Path, settings: &[&str]| {
        let mut arguments = train(&config, run, settings);
        arguments.extend(["--from".into(), arg(&weights).into()]);
        arguments
    };
    // The learning rate is too small to change any weight.
    succeed(&text(&from(&second, &["train.steps=1", "train.learning_rate=1e-30"])));
    let of_model = |run: &Path| -> Vec<_> {
        tensors(run).into_iter().filter(|(name, _)| name.starts_with("model")).collect()
    };
    for ((name, x), (_, y)) in of_model(&first).iter().zip(of_model(&second)) {
        assert!(x.equal(&y), "{name}");
    }
    let stage = metrics(&second).0[0]["stage"].as_u64();
    assert_eq!(stage, Some(2), "all Gaussians are shown from the first step on");

    // Weights for patches with half the edge sum up to those they come from. Each scene token is split into several, which together cover
    // what one did.
    let larger = folder.path().join("larger");
    let still = ["train.steps=1", "train.learning_rate=1e-30", "model.patch_size=4", "model.latents=32"];
    succeed(&text(&from(&larger, &still)));
    for ((name, of_small), (_, of_large)) in of_model(&first).iter().zip(of_model(&larger)) {
        if name.contains("_patch_embeds") {
            assert_eq!(of_small.size()[1], 4 * of_large.size()[1], "{name}");
            let sums = [of_small, &of_large].map(|t| t.sum_dim_intlist(1i64, false, None::<tch::Kind>));
            assert!(sums[0].allclose(&sums[1], 1e-5, 1e-5, false), "{name}");
        } else if name.ends_with("scene_tokens") {
            assert_eq!(of_large.size()[0], 2 * of_small.size()[0]);
        } else if name.ends_with("geo_param_readout.bias") {
            assert!((of_small - of_large).max().double_value(&[]) > 0.8, "opacities are lower");
        } else {
            assert!(of_small.equal(&of_large), "{name}");
        }
    }

    let other = folder.path().join("other");
    let err = fail(&text(&from(&other, &["model.patch_size=20", "data.image_size=[40, 40]"])), 2);
    assert!(err.contains("the model is model.patch_size 8 → 20, expected"), "{err}");
    let err = fail(&text(&from(&other, &["model.width=64", "model.latents=24"])), 2);
    assert!(
        err.contains("model.safetensors: the model is model.latents 16 → 24, model.width 32 → 64, expected"),
        "{err}"
    );
    assert!(!other.join("checkpoints").exists(), "nothing was begun");

    // A run that has a checkpoint doesn't need the initial weights any more.
    std::fs::remove_file(&weights).unwrap();
    succeed(&text(&from(&second, &["train.steps=2", "train.learning_rate=1e-30"])));
}
