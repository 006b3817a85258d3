//! Distributed processes: they compute what one process computes, and they survive failures.
#![cfg(target_os = "linux")]

use crate::common::program::{Sandbox, arg, assert_says, send_signal, tiny_config, tiny_weights, wait_for};
use crate::common::room::write_rooms;
use crate::common::{skip, write_script};
use crate::{assert_same_bits, checkpoints, metrics, steps, train};
use serde_json::{Value, json};
use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::Duration;

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

/// Result of a process.
struct Ended {
    code: Option<i32>,
    out: String,
    err: String,
}

/// Starts a process that is ended after a minute, by coreutils' `timeout`, which passes signals on to it.
fn start(command: &Command) -> Child {
    let mut limited = Command::new("timeout");
    limited.arg("60").arg(command.get_program()).args(command.get_args());
    limited.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    limited.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Starts a rank for each of `lines`, with only the environment variables that every launcher sets.
fn start_ranks(sandbox: &Sandbox, lines: &[String]) -> Vec<Child> {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let rank = |(rank, line): (usize, &String)| {
        let mut command = sandbox.command(line);
        let count = lines.len();
        for (name, value) in [
            ("WORLD_SIZE", count),
            ("RANK", rank),
            ("LOCAL_WORLD_SIZE", count),
            ("LOCAL_RANK", rank),
            ("MASTER_PORT", port.into()),
        ] {
            command.env(name, value.to_string());
        }
        start(command.env("MASTER_ADDR", "127.0.0.1"))
    };
    lines.iter().enumerate().map(rank).collect()
}

/// Starts two ranks by torchrun with `options`.
fn start_by_torchrun(torchrun: &Path, sandbox: &Sandbox, options: &[&str], line: &str) -> Child {
    let program = sandbox.command(line);
    let mut command = Command::new(torchrun);
    command.args(["--standalone", "--no-python", "--nproc-per-node=2"]).args(options);
    start(command.arg(program.get_program()).args(program.get_args()).env("OMP_NUM_THREADS", "1"))
}

/// Waits until all `processes` have ended.
fn end(processes: Vec<Child>) -> Vec<Ended> {
    let end = |process: Child| {
        let output = process.wait_with_output().unwrap();
        let [out, err] =
            [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        Ended { code: output.status.code(), out, err }
    };
    processes.into_iter().map(end).collect()
}

fn children(process: u32) -> Vec<u32> {
    let children = fs::read_to_string(format!("/proc/{process}/task/{process}/children"));
    children.unwrap_or_default().split_whitespace().map(|child| child.parse().unwrap()).collect()
}

/// Returns the output of `count` ranks that succeed; all but the first print nothing.
#[track_caller]
fn succeed_together(sandbox: &Sandbox, count: usize, line: &str) -> String {
    let mut ended = end(start_ranks(sandbox, &vec![line.to_string(); count]));
    let err: Vec<&str> = ended.iter().map(|of| of.err.as_str()).collect();
    for (rank, of) in ended.iter().enumerate() {
        assert_eq!(of.code, Some(0), "rank {rank}: {err:?}");
        assert!(rank == 0 || (of.out.is_empty() && of.err.is_empty()), "rank {rank}: {}{}", of.out, of.err);
    }
    ended.swap_remove(0).out
}

/// Returns the program's own error messages among all lines that ranks or torchrun print.
fn sentences(err: &str) -> Vec<&str> {
    let messages = err.lines().filter_map(|line| line.strip_prefix("globalsplat: "));
    // Exclude the progress line that is printed every half minute.
    messages
        .filter(|line| !(line.starts_with(|c: char| c.is_ascii_digit()) && line.contains(" steps")))
        .collect()
}

#[track_caller]
fn sentence(err: &str) -> &str {
    let [sentence] = sentences(err)[..] else { panic!("one sentence: {err}") };
    sentence
}

/// Returns a folder of rooms, `captures`, and a configuration that trains on them.
fn data(scenes: u32) -> Sandbox {
    let sandbox = Sandbox::empty();
    write_rooms(&sandbox.path("captures"), scenes, 9, 40);
    tiny_config(sandbox.folder(), &sandbox.path("captures"));
    sandbox
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
    let sandbox = data(5);
    let [one, two, tools, checkout] = ["one", "two", "bin", "checkout"].map(|name| sandbox.path(name));
    // At a higher learning rate, AdamW amplifies gradients that are little more than rounding errors.
    let settings = "train.steps=12 train.validate_every=5 train.learning_rate=2e-4 train.batch_size=";
    sandbox.succeed(&train("one", &format!("{settings}2")));

    fs::create_dir(&tools).unwrap();
    write_script(&tools.join("scontrol"), "[ \"$*\" = 'show hostnames here' ] && echo 127.0.0.1");
    write_script(&tools.join("srun"), "exec \"$@\"");
    // The folder from which the job is submitted contains the program.
    fs::create_dir_all(checkout.join("target/release")).unwrap();
    symlink(env!("CARGO_BIN_EXE_globalsplat"), checkout.join("target/release/globalsplat")).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap());
    let mut job = Command::new(&script);
    let settings = format!("{settings}1");
    job.args([&sandbox.path("tiny.toml"), &two]).args(settings.split(' ').flat_map(|set| ["--set", set]));
    job.env("PATH", path).env("OMP_NUM_THREADS", "1");
    for (name, value) in
        [("JOB_ID", "4321"), ("JOB_NODELIST", "here"), ("NNODES", "1"), ("SUBMIT_DIR", arg(&checkout))]
    {
        job.env(format!("SLURM_{name}"), value);
    }
    job.env("PROCESSES", "2").env("DEVICE", "cpu").env("TORCHRUN", torchrun);
    let ended = end(vec![start(&job)]).remove(0);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_says(&ended.err, &["2 processes train together"]);
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
    let sandbox = data(5);
    let [one, many] = ["one", "many"].map(|name| sandbox.path(name));
    let settings = "train.steps=12 train.checkpoint_every=100 train.batch_size=";
    sandbox.succeed(&train("one", &format!("{settings}6")));

    let mut ranks = start_ranks(&sandbox, &vec![train("many", &format!("{settings}3")); 2]);
    wait_for(&mut ranks, || (metrics(&many).0.len() >= 4).then_some(()));
    // A stop request to any rank stops all.
    send_signal(ranks[1].id(), libc::SIGTERM);
    let ended = end(ranks);
    assert_eq!((ended[0].code, ended[1].code), (Some(1), Some(0)), "{}", ended[1].err);
    let sentence = sentence(&ended[0].err);
    assert!(sentence.starts_with("stopped; ") && sentence.contains("the same command resumes"), "{sentence}");
    let done = metrics(&many).0.len();
    assert!((4..12).contains(&done) && checkpoints(&many) == [done as u64], "{done} steps");

    succeed_together(&sandbox, 3, &train("many", &format!("{settings}2")));
    assert_same_steps(&many, &one);
}

#[test]
fn ranks_that_die_are_survived_to_the_same_bits() {
    let (Some(_turn), Some(torchrun)) = (turn(), torchrun()) else { return };
    let sandbox = data(8);
    let [whole, run] = ["whole", "run"].map(|name| sandbox.path(name));
    let settings = "train.steps=12 train.checkpoint_every=2 train.validate_every=6";
    succeed_together(&sandbox, 2, &train("whole", settings));

    let line = train("run", settings);
    let mut started = [start_by_torchrun(&torchrun, &sandbox, &["--max-restarts=2"], &line)];
    // Kill a rank within a step.
    wait_for(&mut started, || (metrics(&run).0.len() >= 3).then_some(()));
    let second = find_rank(&mut started, 1, 0);
    send_signal(second, libc::SIGKILL);
    // Kill a rank within a save. A suspended process doesn't finish the save before it is killed.
    let first = find_rank(&mut started, 0, 1);
    loop {
        wait_for(&mut started, || unfinished_save(&run));
        hold(first);
        if unfinished_save(&run).is_some() {
            break send_signal(first, libc::SIGKILL);
        }
        send_signal(first, libc::SIGCONT);
    }
    let ended = end(started.into()).remove(0);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let messages = sentences(&ended.err);
    assert_eq!(messages.len(), 2, "one sentence for each: {messages:?}");
    for message in messages {
        assert_says(message, &["distributed communication failed", "restart the processes"]);
    }

    assert_same_bits(&run, &whole);
    assert_same_steps(&run, &whole);
    assert_eq!(steps(&run), ((0..12).collect(), vec![5, 11]), "every step once");
    let [a, b] = ["run", "whole"].map(|run| sandbox.read(&format!("{run}/best/state.json")));
    assert!(a == b, "the best checkpoint, by the same score");
    let [a, b] = ["run", "whole"].map(|run| sandbox.names(&format!("{run}/checkpoints")));
    assert_eq!(a, b, "what the kills left is cleared away");
}

/// Returns the process with rank `rank` after the given number of `restarts` by torchrun.
fn find_rank(started: &mut [Child; 1], rank: usize, restarts: usize) -> u32 {
    let variables = [format!("RANK={rank}"), format!("TORCHELASTIC_RESTART_COUNT={restarts}")];
    let is_it = |process: &u32| {
        let environment = fs::read(format!("/proc/{process}/environ")).unwrap_or_default();
        let is_set = |variable: &String| environment.split(|b| *b == 0).any(|set| set == variable.as_bytes());
        variables.iter().all(is_set)
    };
    let limit = started[0].id();
    wait_for(started, || children(limit).into_iter().flat_map(children).find(is_it))
}

/// Suspends a process, so that its state can be examined.
fn hold(process: u32) {
    send_signal(process, libc::SIGSTOP);
    // The process name, in brackets, may contain anything.
    let is_running = |stat: String| stat.rsplit_once(')').is_some_and(|(_, state)| !state.starts_with(" T"));
    while fs::read_to_string(format!("/proc/{process}/stat")).is_ok_and(is_running) {
        sleep(Duration::from_micros(100));
    }
}

/// Returns `Some` while a checkpoint is being written that is newer than all complete ones.
fn unfinished_save(run: &Path) -> Option<()> {
    let entries = fs::read_dir(run.join("checkpoints")).ok()?;
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name().to_str()?.to_string()));
    let steps = names.filter_map(|name| name.strip_prefix("step-")?.parse::<u64>().ok());
    (steps.max()? > checkpoints(run).pop().unwrap_or(0)).then_some(())
}

#[test]
fn commands_for_one_process_are_refused_once() {
    let (Some(_turn), Some(torchrun)) = (turn(), torchrun()) else { return };
    let ended = end(vec![start_by_torchrun(&torchrun, &Sandbox::empty(), &[], "inspect x")]).remove(0);
    let expected = "this is work for one process, and torchrun started 2: expected train,";
    assert!(ended.code != Some(0) && sentence(&ended.err).starts_with(expected), "{}", ended.err);
}

/// An error of one rank or of all is one sentence, whichever rank finds it.
#[test]
fn an_error_is_printed_once() {
    let Some(_turn) = turn() else { return };
    let sandbox = data(2);
    sandbox.write("run/config.toml", "");
    write_rooms(&sandbox.path("more"), 3, 9, 40);
    let line = |setting: &str| train("run", setting);
    let both = |setting: &str| [line(setting), line(setting)];
    let mistakes = [
        (both("train.stepz=3"), 2, "unknown field `stepz`"),
        (both("'data.captures=[\"nowhere\"]'"), 2, "nowhere"),
        // Only the first rank detects this one. The other rank's communication fails, which doesn't change the exit code of the first.
        (both("train.keep_checkpoints=3"), 2, "config.toml that no run wrote"),
        (
            [line(""), line("train.seed=5")],
            1,
            "rank 1 of 2: this rank's configuration differs from the first rank's: train.seed 0 → 5",
        ),
        (
            [line(""), line("'data.captures=[\"@more\"]'")],
            1,
            "rank 1 of 2: this rank's training scenes differ from the first rank's: 3 of 3",
        ),
    ];
    for (lines, code, expected) in mistakes {
        if code == 1 {
            let _ = fs::remove_file(sandbox.path("run/config.toml"));
        }
        let ended = end(start_ranks(&sandbox, &lines));
        assert!(ended.iter().all(|of| of.code != Some(0) && of.out.is_empty()), "{expected}");
        let err: String = ended.iter().map(|of| of.err.as_str()).collect();
        assert_says(sentence(&err), &[expected]);
        assert!(!err.contains("communication failed"), "{err}");
        assert_eq!(ended[0].code, Some(code), "{expected}: {err}");
    }
}

/// Returns the result of an evaluation, without times and memory.
fn evaluation(sandbox: &Sandbox, out: &str) -> (Value, Vec<String>) {
    let mut scores = sandbox.read_json(&format!("{out}/scores.json"));
    for scene in scores["scenes"].as_array_mut().unwrap() {
        for measured in ["forward_seconds", "warm_up", "peak_memory_bytes"] {
            scene.as_object_mut().unwrap().remove(measured);
        }
    }
    for measured in ["forward_seconds", "timed_scenes", "peak_memory_bytes"] {
        scores["efficiency"].as_object_mut().unwrap().remove(measured).expect(measured);
    }
    // The last column contains times.
    let csv = sandbox.text(&format!("{out}/scores.csv"));
    (scores, csv.lines().map(|line| line.rsplit_once(',').unwrap().0.to_string()).collect())
}

#[test]
fn ranks_evaluate_like_one() {
    let Some(_turn) = turn() else { return };
    let sandbox = Sandbox::empty();
    write_rooms(&sandbox.path("captures"), 5, 5, 40);
    tiny_weights(sandbox.folder(), &sandbox.path("captures"));
    let names: Vec<String> = (0..5).map(|room| format!("room_{room:03}")).collect();
    let frames = names.iter().map(|name| (name.clone(), json!({"context": [0, 2, 4], "target": [1, 3]})));
    sandbox.write("re10k_3v.json", Value::Object(frames.collect()).to_string());
    let eval = |out: &str| {
        format!("eval --weights @tiny.safetensors --data @captures --index @re10k_3v.json --out @{out}")
    };
    sandbox.succeed(&eval("one"));
    let out = succeed_together(&sandbox, 3, &eval("many"));
    assert!(out.contains("5 of 5 scenes") && out.matches("report.html").count() == 1, "{out}");
    assert!(sandbox.path("many/report.html").is_file());
    let (scores, csv) = evaluation(&sandbox, "many");
    assert_eq!((&scores, &csv), (&evaluation(&sandbox, "one").0, &evaluation(&sandbox, "one").1));
    let scored: Vec<&str> =
        scores["scenes"].as_array().unwrap().iter().map(|s| s["scene"].as_str().unwrap()).collect();
    assert!(scored == names && csv.len() == 1 + 5 * 2, "{scored:?}");

    // Stopped evaluations resume, and a scene that fails is reported once.
    sandbox.write("captures/room_003/images/003.png", "no photo");
    for out in ["one", "many"] {
        for scene in ["room_003", "room_004"] {
            fs::remove_file(sandbox.path(&format!("{out}/scenes/{scene}.json"))).unwrap();
        }
    }
    assert_eq!(sandbox.output(&eval("one")).0, Some(1));
    let ended = end(start_ranks(&sandbox, &vec![eval("many"); 2]));
    let err: String = ended.iter().map(|of| of.err.as_str()).collect();
    assert!(ended[0].code == Some(1) && err.matches("room_003: ").count() == 1, "{err}");
    assert_eq!(sentence(&err), "1 scenes could not be scored, the means are of the others");
    let (scores, csv) = evaluation(&sandbox, "many");
    assert_eq!((&scores, &csv), (&evaluation(&sandbox, "one").0, &evaluation(&sandbox, "one").1));
    assert_eq!(scores["failures"][0]["scene"], "room_003");
}

#[test]
fn bad_data_is_reported_by_any_rank() {
    let Some(_turn) = turn() else { return };
    let sandbox = data(6);
    // Truncate the photos of the scene of sample 1, the second rank's first.
    for photo in sandbox.names("captures/room_003/images") {
        let photo = format!("captures/room_003/images/{photo}");
        let bytes = sandbox.read(&photo);
        sandbox.write(&photo, &bytes[..bytes.len() / 2]);
    }
    // One step in which every rank loads one sample, at most two ahead: no rank finds an error in another's sample.
    let line = |run: &str, settings: &str| {
        let settings = format!("train.steps=1 data.prefetch=1 data.threads=1 {settings}");
        format!("{} --json", train(run, &settings))
    };
    let refused = line("refused", "data.max_bad_share=0 train.batch_size=1");
    let ended = end(start_ranks(&sandbox, &vec![refused; 2]));
    let err: String = ended.iter().map(|of| of.err.as_str()).collect();
    let expected = "rank 1 of 2: 1 of 6 scenes were skipped: 1 with broken images";
    assert!(sentence(&err).starts_with(expected), "{err}");

    let parse = |output: &str| -> Value { serde_json::from_str(output).unwrap() };
    let one = parse(&sandbox.succeed(&line("one", "data.max_bad_share=0.5 train.batch_size=2")));
    let two = line("two", "data.max_bad_share=0.5 train.batch_size=1");
    let two = parse(&succeed_together(&sandbox, 2, &two));
    assert_eq!(two["skipped_scenes"], one["skipped_scenes"]);
    assert_eq!(two["skipped_scenes"]["with_broken_images"], 1);
    // Its held-out views are not scored, either.
    let scored = |report: &Value| -> Vec<Value> {
        let scenes = report["held_out"]["scenes"].as_array().unwrap();
        scenes.iter().map(|scene| scene["ours"]["scene"].clone()).collect()
    };
    assert_eq!((scored(&two), scored(&two).len()), (scored(&one), 5));
}
