//! Distributed processes: they compute what one process computes, and they survive failures.
#![cfg(target_os = "linux")]

use crate::common::program::{arg, command, rooms, succeed, text, tiny_config, tiny_weights, train};
use crate::common::skip;
use crate::{assert_same_bits, checkpoints, metrics, steps};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Timeout for everything that normally takes seconds.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Serializes the tests: each uses all cores of a small machine.
fn turn() -> Option<MutexGuard<'static, ()>> {
    static TURN: Mutex<()> = Mutex::new(());
    if !globalsplat_csrc::distributed::has_gloo() {
        skip(
            "Gloo",
            "the program was built without Gloo; install libgloo-dev, touch csrc/build.rs and build again",
        );
        return None;
    }
    Some(TURN.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Returns the `torchrun` of the virtual environment that `make venv` creates, or the one that `TORCHRUN` names.
fn torchrun() -> Option<PathBuf> {
    let named = std::env::var_os("TORCHRUN").map(PathBuf::from);
    let path = named.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/torchrun"));
    if path.is_file() {
        return Some(path);
    }
    skip("torchrun", &format!("{} is missing; run make venv, or set TORCHRUN", path.display()));
    None
}

/// Started processes, and the folder with their output. Dropping this ends them and their children.
struct Started {
    processes: Vec<Child>,
    folder: TempDir,
}

/// Result of a process.
struct Ended {
    code: Option<i32>,
    out: String,
    err: String,
}

impl Started {
    fn start(commands: Vec<Command>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, i: usize| File::create(folder.path().join(format!("{name}{i}"))).unwrap();
        let start = |(i, mut command): (usize, Command)| {
            let (out, err) = (file("out", i), file("err", i));
            command.stdin(Stdio::null()).stdout(out).stderr(err).spawn().unwrap()
        };
        Started { processes: commands.into_iter().enumerate().map(start).collect(), folder }
    }

    /// Starts `count` ranks by torchrun with `options`.
    fn by_torchrun(torchrun: &Path, count: usize, options: &[&str], arguments: &[&str]) -> Self {
        let mut command = Command::new(torchrun);
        command.args(["--standalone", "--no-python", &format!("--nproc-per-node={count}")]).args(options);
        command.arg(env!("CARGO_BIN_EXE_globalsplat")).args(arguments).env("OMP_NUM_THREADS", "1");
        Started::start(vec![command])
    }

    /// Starts `count` ranks with only the environment variables that every launcher sets.
    fn by_environment(count: usize, arguments: &[&str]) -> Self {
        Started::by_environment_of(&vec![arguments.to_vec(); count])
    }

    /// Starts one rank per list of arguments.
    fn by_environment_of(arguments: &[Vec<&str>]) -> Self {
        let (port, count) = (free_port(), arguments.len());
        let rank = |rank: usize| {
            let mut command = command(&arguments[rank]);
            for (name, value) in [("WORLD_SIZE", count), ("RANK", rank), ("MASTER_PORT", port.into())] {
                command.env(name, value.to_string());
            }
            command.env("LOCAL_RANK", rank.to_string()).env("LOCAL_WORLD_SIZE", count.to_string());
            command.env("MASTER_ADDR", "127.0.0.1");
            command
        };
        Started::start((0..count).map(rank).collect())
    }

    /// Returns the contents of an output file of a rank, such as `err0`.
    fn read_output(&self, file: &str) -> String {
        String::from_utf8_lossy(&fs::read(self.folder.path().join(file)).unwrap()).into_owned()
    }

    /// Polls `find` until it returns a value, while all processes are still running.
    fn wait_for<T>(&mut self, what: &str, mut find: impl FnMut() -> Option<T>) -> T {
        let begun = Instant::now();
        loop {
            if let Some(found) = find() {
                return found;
            }
            let ended = self.processes.iter_mut().any(|process| process.try_wait().unwrap().is_some());
            assert!(!ended && begun.elapsed() < TIMEOUT, "{what} never came: {}", self.read_output("err0"));
            sleep(Duration::from_micros(200));
        }
    }

    /// Waits until all processes have ended.
    fn end(mut self) -> Vec<Ended> {
        let begun = Instant::now();
        let ended = |i: usize, process: &mut Child| loop {
            if let Some(status) = process.try_wait().unwrap() {
                break status.code();
            }
            let err = || fs::read_to_string(self.folder.path().join(format!("err{i}"))).unwrap();
            assert!(begun.elapsed() < TIMEOUT, "process {i} doesn't end: {}", err());
            sleep(Duration::from_millis(5));
        };
        let codes: Vec<_> =
            self.processes.iter_mut().enumerate().map(|(i, process)| ended(i, process)).collect();
        let ended = |(i, code)| Ended {
            code,
            out: self.read_output(&format!("out{i}")),
            err: self.read_output(&format!("err{i}")),
        };
        codes.into_iter().enumerate().map(ended).collect()
    }

    /// Waits for the child of a torchrun that has rank `rank` after the given number of `restarts`.
    fn rank(&mut self, rank: usize, restarts: usize) -> u32 {
        let torchruns: Vec<u32> = self.processes.iter().map(Child::id).collect();
        let variables = [format!("RANK={rank}"), format!("TORCHELASTIC_RESTART_COUNT={restarts}")];
        let is_it = |child: &u32| {
            let environment = fs::read(format!("/proc/{child}/environ")).unwrap_or_default();
            let set: BTreeSet<&[u8]> = environment.split(|byte| *byte == 0).collect();
            variables.iter().all(|variable| set.contains(variable.as_bytes()))
        };
        self.wait_for("a rank", || torchruns.iter().flat_map(|&of| children(of)).find(is_it))
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        for process in &mut self.processes {
            if let Ok(None) = process.try_wait() {
                let children = children(process.id());
                let _ = process.kill();
                let _ = process.wait();
                children.into_iter().for_each(|child| signal(child, libc::SIGKILL));
            }
        }
    }
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// Returns the state and the parent of a process.
fn state(process: u32) -> Option<(char, u32)> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The process name, in brackets, may contain anything.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
    Some((fields.next()?.parse().ok()?, fields.next()?.parse().ok()?))
}

fn children(process: u32) -> Vec<u32> {
    let all =
        fs::read_dir("/proc").unwrap().filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    all.filter(|&other| state(other).is_some_and(|(_, parent)| parent == process)).collect()
}

fn signal(process: u32, signal: libc::c_int) {
    // SAFETY: sends a signal to a process that this test started and nobody has waited for, or to none.
    unsafe { libc::kill(process as i32, signal) };
}

/// Suspends a process, so that its state can be examined.
fn hold(process: u32) {
    signal(process, libc::SIGSTOP);
    while state(process).is_some_and(|(state, _)| state != 'T') {
        sleep(Duration::from_micros(100));
    }
}

/// Returns the output of `count` ranks that succeed; all but the first print nothing.
#[track_caller]
fn succeed_together(count: usize, arguments: &[&str]) -> String {
    let mut ended = Started::by_environment(count, arguments).end();
    let err: Vec<&str> = ended.iter().map(|of| of.err.as_str()).collect();
    for (rank, of) in ended.iter().enumerate() {
        assert_eq!(of.code, Some(0), "rank {rank}: {err:?}");
        assert!(rank == 0 || (of.out.is_empty() && of.err.is_empty()), "rank {rank}: {}{}", of.out, of.err);
    }
    ended.swap_remove(0).out
}

/// Returns the program's own error messages among all lines that torchrun prints.
fn sentences(err: &str) -> Vec<&str> {
    let messages = err.lines().filter_map(|line| line.strip_prefix("globalsplat: "));
    // Exclude the progress line that is printed every half minute.
    messages
        .filter(|line| !(line.starts_with(|c: char| c.is_ascii_digit()) && line.contains(" steps")))
        .collect()
}

/// Returns a folder of rooms, and a configuration that trains on them.
fn data(scenes: u32) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let captures = folder.path().join("captures");
    rooms(&captures, scenes, 9, 40);
    let config = tiny_config(folder.path(), &captures);
    (folder, config)
}

#[track_caller]
fn assert_close(a: &Value, b: &Value, tolerance: f64) {
    let (x, y) = (a.as_f64().unwrap(), b.as_f64().unwrap());
    assert!((x - y).abs() <= tolerance * y.abs(), "{x} {y}");
}

/// Asserts that the steps of both runs agree up to the order of summation.
#[track_caller]
fn assert_same_steps(a: &Path, b: &Path) {
    assert_eq!(steps(a).0, steps(b).0);
    let (a, b) = (metrics(a).0, metrics(b).0);
    for (a, b) in a.iter().zip(&b) {
        for field in ["loss", "psnr", "gradient_norm", "learning_rate"] {
            assert_close(&a[field], &b[field], 1e-5);
        }
    }
}

/// Two ranks make the steps of one process with twice the batch size. The script for Slurm starts them, with a fake Slurm of one node, this
/// machine.
#[test]
fn ranks_of_slurm_s_script_train_like_one() {
    let (Some(_turn), Some(torchrun)) = (turn(), torchrun()) else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/slurm_train.sh");
    let (folder, config) = data(5);
    let [one, two, tools, checkout] = ["one", "two", "bin", "checkout"].map(|name| folder.path().join(name));
    // At a higher learning rate, AdamW amplifies gradients that are little more than rounding errors.
    let settings = |batch| ["train.steps=12", "train.validate_every=5", "train.learning_rate=2e-4", batch];
    succeed(&text(&train(&config, &one, &settings("train.batch_size=2"))));

    fs::create_dir(&tools).unwrap();
    for (name, does) in
        [("scontrol", "[ \"$*\" = 'show hostnames here' ] && echo 127.0.0.1"), ("srun", "exec \"$@\"")]
    {
        let tool = tools.join(name);
        fs::write(&tool, format!("#!/bin/sh\n{does}\n")).unwrap();
        fs::set_permissions(&tool, fs::Permissions::from_mode(0o755)).unwrap();
    }
    // The folder from which the job is submitted contains the program.
    fs::create_dir_all(checkout.join("target/release")).unwrap();
    symlink(env!("CARGO_BIN_EXE_globalsplat"), checkout.join("target/release/globalsplat")).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap());
    let mut job = Command::new(&script);
    job.args([&config, &two]).args(settings("train.batch_size=1").iter().flat_map(|set| ["--set", set]));
    job.env("PATH", path).env("OMP_NUM_THREADS", "1");
    for (name, value) in
        [("JOB_ID", "4321"), ("JOB_NODELIST", "here"), ("NNODES", "1"), ("SUBMIT_DIR", arg(&checkout))]
    {
        job.env(format!("SLURM_{name}"), value);
    }
    job.env("PROCESSES", "2").env("DEVICE", "cpu").env("TORCHRUN", torchrun);
    let ended = Started::start(vec![job]).end().remove(0);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert!(ended.err.contains("2 processes train together"), "{}", ended.err);
    assert_eq!(ended.out.matches("trained in ").count(), 1, "{}", ended.out);

    assert_same_steps(&two, &one);
    assert_eq!(steps(&two).1, [4, 9, 11]);
    let [of_one, of_two] = [&one, &two].map(|run| metrics(run).1);
    for (a, b) in of_one.iter().zip(&of_two) {
        let [a, b] = [a, b].map(|line| &line["validation"]);
        assert_eq!((a["scenes"].as_u64(), b["scenes"].as_u64()), (Some(5), Some(5)));
        assert_close(&a["psnr"], &b["psnr"], 1e-4);
        assert_close(&a["ssim"], &b["ssim"], 1e-4);
    }
}

#[test]
fn a_run_goes_on_with_another_number_of_ranks() {
    let Some(_turn) = turn() else { return };
    let (folder, config) = data(5);
    let [one, many] = ["one", "many"].map(|name| folder.path().join(name));
    let settings = |batch| ["train.steps=12", "train.checkpoint_every=100", batch];
    succeed(&text(&train(&config, &one, &settings("train.batch_size=6"))));

    let arguments = train(&config, &many, &settings("train.batch_size=3"));
    let mut started = Started::by_environment(2, &text(&arguments));
    started.wait_for("a step", || (metrics(&many).0.len() >= 4).then_some(()));
    // A stop request to any rank stops all.
    signal(started.processes[1].id(), libc::SIGTERM);
    let ended = started.end();
    assert_eq!((ended[0].code, ended[1].code), (Some(1), Some(0)), "{}", ended[1].err);
    let [sentence] = sentences(&ended[0].err)[..] else { panic!("one sentence: {}", ended[0].err) };
    assert!(sentence.starts_with("stopped; ") && sentence.contains("the same command resumes"), "{sentence}");
    let done = metrics(&many).0.len();
    assert!((4..12).contains(&done) && checkpoints(&many) == [done as u64], "{done} steps");

    succeed_together(3, &text(&train(&config, &many, &settings("train.batch_size=2"))));
    assert_same_steps(&many, &one);
}

#[test]
fn ranks_that_die_are_survived_to_the_same_bits() {
    let Some(_turn) = turn() else { return };
    let Some(torchrun) = torchrun() else { return };
    let (folder, config) = data(8);
    let [whole, run] = ["whole", "run"].map(|name| folder.path().join(name));
    let settings = ["train.steps=12", "train.checkpoint_every=2", "train.validate_every=6"];
    succeed_together(2, &text(&train(&config, &whole, &settings)));

    let arguments = train(&config, &run, &settings);
    let mut started = Started::by_torchrun(&torchrun, 2, &["--max-restarts=2"], &text(&arguments));
    // Kill a rank within a step.
    started.wait_for("a step", || (metrics(&run).0.len() >= 3).then_some(()));
    let second = started.rank(1, 0);
    signal(second, libc::SIGKILL);
    // Kill a rank within a save. A suspended process doesn't finish the save before it is killed.
    let first = started.rank(0, 1);
    loop {
        started.wait_for("a save", || unfinished_save(&run));
        hold(first);
        if unfinished_save(&run).is_some() {
            break signal(first, libc::SIGKILL);
        }
        signal(first, libc::SIGCONT);
    }
    let ended = started.end().remove(0);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let messages = sentences(&ended.err);
    let is_lost = |message: &&str| {
        message.contains("distributed communication failed") && message.contains("restart the processes")
    };
    assert!(messages.len() == 2 && messages.iter().all(is_lost), "one sentence for each: {messages:?}");

    assert_same_bits(&run, &whole);
    assert_same_steps(&run, &whole);
    assert_eq!(steps(&run), ((0..12).collect(), vec![5, 11]), "every step once");
    let [a, b] = [&run, &whole].map(|run| fs::read(run.join("best/state.json")).unwrap());
    assert!(a == b, "the best checkpoint, by the same score");
    assert_eq!(
        fs::read_dir(run.join("checkpoints")).unwrap().count(),
        2,
        "what the kills left is cleared away"
    );
}

/// Returns `Some` while a checkpoint is being written that is newer than all complete ones.
fn unfinished_save(run: &Path) -> Option<()> {
    let entries = fs::read_dir(run.join("checkpoints")).ok()?;
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name().to_str()?.to_string()));
    let partial = names.filter_map(|name| {
        name.strip_prefix(".step-")?.strip_suffix(".globalsplat-partial")?.parse::<u64>().ok()
    });
    (partial.max()? > checkpoints(run).pop().unwrap_or(0)).then_some(())
}

#[test]
fn commands_for_one_process_are_refused_once() {
    let (Some(_turn), Some(torchrun)) = (turn(), torchrun()) else { return };
    let ended = Started::by_torchrun(&torchrun, 2, &[], &["inspect", "x"]).end().remove(0);
    let [sentence] = sentences(&ended.err)[..] else { panic!("one sentence: {}", ended.err) };
    let expected = "this is work for one process, and torchrun started 2: expected train,";
    assert!(ended.code != Some(0) && sentence.starts_with(expected), "{sentence}");
}

/// An error of one rank or of all is one sentence, whichever rank finds it.
#[test]
fn an_error_is_printed_once() {
    let Some(_turn) = turn() else { return };
    let (folder, config) = data(2);
    let (_more, more) = data(3);
    let run = folder.path().join("run");
    let settings = |setting: &str| train(&config, &run, &[setting]);
    let first = train(&config, &run, &[]);
    let other_run = |other: Vec<String>| [first.clone(), other];
    let both = |arguments: Vec<String>| [arguments.clone(), arguments];
    fs::create_dir(&run).unwrap();
    let foreign = run.join("config.toml");
    fs::write(&foreign, "").unwrap();
    let mistakes = [
        (both(settings("train.stepz=3")), 2, "unknown field `stepz`"),
        (both(settings("data.captures=[\"nowhere\"]")), 2, "nowhere"),
        // Only the first rank detects this one. The other rank's communication fails, which doesn't change the exit code of the first.
        (both(settings("train.keep_checkpoints=3")), 2, "config.toml that no run wrote"),
        (
            other_run(settings("train.seed=5")),
            1,
            "rank 1 of 2: this rank's configuration differs from the first rank's: train.seed 0 → 5",
        ),
        (
            other_run(train(&more, &run, &[])),
            1,
            "rank 1 of 2: this rank's training scenes differ from the first rank's: 3 of 3",
        ),
    ];
    for (arguments, code, expected) in mistakes {
        if code == 1 {
            let _ = fs::remove_file(&foreign);
        }
        let ended = Started::by_environment_of(&arguments.each_ref().map(|rank| text(rank))).end();
        assert!(ended.iter().all(|of| of.code != Some(0) && of.out.is_empty()), "{expected}");
        let err: String = ended.iter().map(|of| of.err.as_str()).collect();
        let [sentence] = sentences(&err)[..] else { panic!("{expected}: one sentence: {err}") };
        assert!(sentence.contains(expected) && !sentence.contains("communication failed"), "{sentence}");
        assert_eq!(ended[0].code, Some(code), "{expected}: {err}");
    }
}

/// Returns the result of an evaluation, without times and memory.
fn evaluation(out: &Path) -> (Value, Vec<String>) {
    let mut scores: Value = serde_json::from_slice(&fs::read(out.join("scores.json")).unwrap()).unwrap();
    for scene in scores["scenes"].as_array_mut().unwrap() {
        for measured in ["forward_seconds", "warm_up", "peak_memory_bytes"] {
            scene.as_object_mut().unwrap().remove(measured);
        }
    }
    for measured in ["forward_seconds", "timed_scenes", "peak_memory_bytes"] {
        scores["efficiency"].as_object_mut().unwrap().remove(measured).expect(measured);
    }
    let csv = fs::read_to_string(out.join("scores.csv")).unwrap();
    // The last column contains times.
    (scores, csv.lines().map(|line| line.rsplit_once(',').unwrap().0.to_string()).collect())
}

#[test]
fn ranks_evaluate_like_one() {
    let Some(_turn) = turn() else { return };
    let folder = tempfile::tempdir().unwrap();
    let of = |name: &str| folder.path().join(name);
    let (captures, index) = (of("captures"), of("re10k_3v.json"));
    rooms(&captures, 5, 5, 40);
    let names: Vec<String> = (0..5).map(|room| format!("room_{room:03}")).collect();
    let frames = names.iter().map(|name| (name.clone(), json!({"context": [0, 2, 4], "target": [1, 3]})));
    fs::write(&index, Value::Object(frames.collect()).to_string()).unwrap();
    let weights = tiny_weights(folder.path(), &captures);
    let arguments = |out: &Path| {
        let all =
            ["eval", "--weights", arg(&weights), "--data", arg(&captures), "--index", arg(&index), "--out"];
        all.into_iter().chain([arg(out)]).map(String::from).collect::<Vec<_>>()
    };
    let (one, many) = (of("one"), of("many"));
    succeed(&text(&arguments(&one)));
    let out = succeed_together(3, &text(&arguments(&many)));
    assert!(out.contains("5 of 5 scenes") && out.matches("report.html").count() == 1, "{out}");
    assert!(many.join("report.html").is_file());
    let (scores, csv) = evaluation(&many);
    assert_eq!((&scores, &csv), (&evaluation(&one).0, &evaluation(&one).1));
    let scored: Vec<&str> =
        scores["scenes"].as_array().unwrap().iter().map(|s| s["scene"].as_str().unwrap()).collect();
    assert!(scored == names && csv.len() == 1 + 5 * 2, "{scored:?}");

    // Stopped evaluations resume, and a scene that fails is reported once.
    let photo = captures.join("room_003/images/003.png");
    fs::write(&photo, "no photo").unwrap();
    for out in [&one, &many] {
        fs::remove_file(out.join("scenes/room_003.json")).unwrap();
        fs::remove_file(out.join("scenes/room_004.json")).unwrap();
    }
    assert_eq!(command(&text(&arguments(&one))).output().unwrap().status.code(), Some(1));
    let ended = Started::by_environment(2, &text(&arguments(&many))).end();
    let err: String = ended.iter().map(|of| of.err.as_str()).collect();
    assert!(ended[0].code == Some(1) && err.matches("room_003: ").count() == 1, "{err}");
    assert_eq!(sentences(&err), ["1 scenes could not be scored, the means are of the others"]);
    let (scores, csv) = evaluation(&many);
    assert_eq!((&scores, &csv), (&evaluation(&one).0, &evaluation(&one).1));
    assert_eq!(scores["failures"][0]["scene"], "room_003");
}

#[test]
fn bad_data_is_reported_by_any_rank() {
    let Some(_turn) = turn() else { return };
    let (folder, config) = data(6);
    // Truncate the photos of the scene of sample 1, the second rank's first.
    for entry in fs::read_dir(folder.path().join("captures/room_003/images")).unwrap() {
        let photo = entry.unwrap().path();
        let bytes = fs::read(&photo).unwrap();
        fs::write(&photo, &bytes[..bytes.len() / 2]).unwrap();
    }
    // One step in which every rank loads one sample, at most two ahead: no rank finds an error in another's sample.
    let settings = |share, batch| ["train.steps=1", "data.prefetch=1", "data.threads=1", share, batch];
    let arguments = |run: &str, share, batch| {
        let mut arguments = train(&config, &folder.path().join(run), &settings(share, batch));
        arguments.push("--json".into());
        arguments
    };
    let refused = arguments("refused", "data.max_bad_share=0", "train.batch_size=1");
    let ended = Started::by_environment(2, &text(&refused)).end();
    let err: String = ended.iter().map(|of| of.err.as_str()).collect();
    let [sentence] = sentences(&err)[..] else { panic!("one sentence: {err}") };
    assert!(
        sentence.starts_with("rank 1 of 2: 1 of 6 scenes were skipped: 1 with broken images"),
        "{sentence}"
    );

    let parse = |output: &str| -> Value { serde_json::from_str(output).unwrap() };
    let one = parse(&succeed(&text(&arguments("one", "data.max_bad_share=0.5", "train.batch_size=2"))));
    let two =
        parse(&succeed_together(2, &text(&arguments("two", "data.max_bad_share=0.5", "train.batch_size=1"))));
    assert_eq!(two["skipped_scenes"], one["skipped_scenes"]);
    assert_eq!(two["skipped_scenes"]["with_broken_images"], 1);
    // Its held-out views are not scored, either.
    let judged = |report: &Value| -> Vec<Value> {
        report["held_out"]["scenes"]
            .as_array()
            .unwrap()
            .iter()
            .map(|scene| scene["ours"]["scene"].clone())
            .collect()
    };
    assert_eq!((judged(&two), judged(&two).len()), (judged(&one), 5));
}
