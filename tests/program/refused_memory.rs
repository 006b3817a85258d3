//! Out of memory at any moment gives one sentence and exit code 1, and loses nothing.
#![cfg(target_os = "linux")]

use crate::common::program::{arg, room, succeed, text, tiny_config, train};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// Runs the program with a limit on its address space, in KiB.
fn run_with_memory_limit(kibibytes: u64, arguments: &[&str]) -> Output {
    Command::new("bash")
        .args(["-c", "ulimit -v $0; exec \"$@\"", &kibibytes.to_string(), env!("CARGO_BIN_EXE_globalsplat")])
        .args(arguments)
        .env("OMP_NUM_THREADS", "1")
        .output()
        .expect("a shell")
}

/// Stack size in KiB. If not even the stack can grow, the system ends the process without a message. The program grows the part
/// of its stack that it uses before anything else.
const STACK: u64 = 2048;

/// Returns the smallest address space in KiB with which the program starts, stack included, and the smallest with which it
/// completes `arguments`, both to a MiB or two.
fn range(arguments: &[&str]) -> (u64, u64) {
    let search = |works: &dyn Fn(u64) -> bool| {
        let (mut fails, mut enough) = (0, 1 << 25);
        while enough - fails > 2048 {
            let middle = (fails + enough) / 2;
            if works(middle) { enough = middle } else { fails = middle }
        }
        enough
    };
    static STARTS: OnceLock<u64> = OnceLock::new();
    let starts = *STARTS.get_or_init(|| {
        STACK + search(&|limit| run_with_memory_limit(limit, &["--version"]).status.success())
    });
    (starts, search(&|limit| limit >= starts && run_with_memory_limit(limit, arguments).status.success()))
}

/// Asserts that at `limits` values between starting and completing, `arguments` end with one sentence and leave `file` either
/// unchanged or complete.
fn assert_oom_is_reported(arguments: &[&str], file: &Path, limits: u64) {
    let before = b"what was there before".to_vec();
    std::fs::write(file, &before).unwrap();
    let (starts, enough) = range(arguments);
    let whole = std::fs::read(file).unwrap();
    assert_ne!(whole, before);
    let mut refusals = 0;
    for i in 0..limits {
        std::fs::write(file, &before).unwrap();
        let limit = starts + (enough - starts) * i / limits;
        let output = run_with_memory_limit(limit, arguments);
        let (code, err) = (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned());
        let left = std::fs::read(file).unwrap();
        if code == Some(0) {
            assert_eq!(left, whole);
            continue;
        }
        refusals += 1;
        assert_eq!(code, Some(1), "{:?}: {err}", output.status);
        // The earlier message about the photos may be printed, too, and nothing else.
        let lines: Vec<&str> = err.lines().filter(|line| !line.contains(" photos are shown, ")).collect();
        assert!(matches!(lines[..], [error] if error.starts_with("globalsplat: ")), "{limit} KiB: {err}");
        assert!(!err.contains("panicked"), "{err}");
        assert_eq!(left, before);
    }
    assert!(refusals > 0, "none of {limits} limits was too low");
    // Leftover temporary files don't disturb the next run.
    succeed(arguments);
    assert_eq!(std::fs::read(file).unwrap(), whole);
}

/// Writes the configuration of a model that needs some tens of megabytes.
fn config(folder: &Path, room: &Path) -> PathBuf {
    let file = tiny_config(folder, room);
    let text = std::fs::read_to_string(&file).unwrap();
    let wide = [
        ("width = 32", "width = 512"),
        ("rgb_width = 32", "rgb_width = 512"),
        ("latents = 16", "latents = 1024"),
    ];
    let text =
        wide.iter().fold(text, |text, (from, to)| text.replace(&format!("\n{from}\n"), &format!("\n{to}\n")));
    std::fs::write(&file, text).unwrap();
    file
}

#[test]
fn reconstruct_out_of_memory_leaves_no_partial_splat() {
    let (folder, room) = room();
    let (weights, out) = (folder.path().join("weights.safetensors"), folder.path().join("out.ply"));
    succeed(&["export", "--config", arg(&config(folder.path(), &room)), "--out", arg(&weights)]);
    // Some libraries fail only within a range of a few MiB.
    assert_oom_is_reported(
        &["reconstruct", "--weights", arg(&weights), "--scene", arg(&room), "--out", arg(&out)],
        &out,
        120,
    );
}

#[test]
fn export_out_of_memory_leaves_no_partial_file() {
    let (folder, room) = room();
    let (config, out) = (config(folder.path(), &room), folder.path().join("out.safetensors"));
    assert_oom_is_reported(&["export", "--config", arg(&config), "--out", arg(&out)], &out, 12);
}

#[test]
fn training_resumes_after_out_of_memory() {
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let whole = folder.path().join("whole");
    let (starts, enough) = range(&text(&train(&config, &whole, &[])));
    let enough = enough.max(starts);
    for i in 0..8 {
        let output =
            run_with_memory_limit(starts + (enough - starts) * i / 8, &text(&train(&config, &run, &[])));
        let err = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(matches!(output.status.code(), Some(0 | 1)), "{:?}: {err}", output.status);
        assert!(!err.contains("panicked"), "{err}");
    }
    assert_resumes_as(&config, &run, &whole);
}

/// Asserts that the resumed run ends as `whole` did.
fn assert_resumes_as(config: &Path, run: &Path, whole: &Path) {
    succeed(&text(&train(config, run, &[])));
    let weights = |run: &Path| {
        let checkpoint = globalsplat::train::latest_checkpoint(run).unwrap();
        globalsplat::io::read_weights(&checkpoint.join("model.safetensors")).unwrap().tensors
    };
    let (a, b) = (weights(run), weights(whole));
    assert!(!a.is_empty() && a.iter().zip(&b).all(|((_, x), (_, y))| x.equal(y)));
}

/// A memory cgroup kills the process instead of refusing memory: a run loses no more than by any other end.
#[test]
#[ignore = "needs a memory cgroup that it may write to; run it as root, by `-- --ignored`"]
fn a_run_goes_on_where_a_cgroup_killed_it() {
    let root = Path::new("/sys/fs/cgroup");
    let (parent, limit) = match root.join("memory").is_dir() {
        true => (root.join("memory"), "memory.limit_in_bytes"),
        false => (root.to_owned(), "memory.max"),
    };
    let group = parent.join(format!("globalsplat-{}", std::process::id()));
    std::fs::create_dir(&group).expect("a cgroup");
    let (folder, room) = room();
    let (config, run) = (tiny_config(folder.path(), &room), folder.path().join("run"));
    let whole = folder.path().join("whole");
    succeed(&text(&train(&config, &whole, &[])));
    let mut killed = 0;
    for mebibytes in (48..=208).step_by(8) {
        std::fs::write(group.join(limit), (mebibytes << 20_u64).to_string()).unwrap();
        let output = Command::new("bash")
            .args([
                "-c",
                "echo $$ > $0/cgroup.procs; exec \"$@\"",
                arg(&group),
                env!("CARGO_BIN_EXE_globalsplat"),
            ])
            .args(train(&config, &run, &[]))
            .env("OMP_NUM_THREADS", "1")
            .output()
            .expect("a shell");
        match output.status.code() {
            Some(0) => {}
            None => killed += 1,
            code => panic!("exit code {code:?}: {}", String::from_utf8_lossy(&output.stderr)),
        }
    }
    std::fs::remove_dir(&group).unwrap();
    assert!(killed > 0);
    assert_resumes_as(&config, &run, &whole);
}
