//! Running out of memory gives one sentence and exit code 1, and loses nothing.
#![cfg(target_os = "linux")]

use crate::common::program::{arg, room};
use std::fs::File;
use std::process::{Command, Output};

/// Runs the program with a limit on its address space, in MiB.
fn run_with_memory_limit(mebibytes: u64, arguments: &[&str]) -> Output {
    Command::new("bash")
        .args(["-c", "ulimit -v $(($0 << 10)); exec \"$@\"", &mebibytes.to_string()])
        .arg(env!("CARGO_BIN_EXE_globalsplat"))
        .args(arguments)
        .env("OMP_NUM_THREADS", "1")
        .output()
        .expect("a shell")
}

/// Each command needs more than the GiB that it gets beyond what the program takes to start: a tensor of 3 GiB, a file of 4 GiB.
#[test]
fn large_allocations_are_refused_in_a_sentence() {
    let starts = (1..)
        .map(|step| step << 8)
        .find(|&limit| run_with_memory_limit(limit, &["--version"]).status.success());
    let limit = starts.unwrap() + 1024;
    let (folder, room) = room();
    let [out, large] = ["out.png", "large.splat"].map(|name| folder.path().join(name));
    std::fs::write(&out, "what was there before").unwrap();
    File::create(&large).unwrap().set_len(4 << 30).unwrap();
    let splat = room.join("truth.ply");
    let render =
        ["render", "--orbit", "--frames", "1", "--size", "16384x16384", "--out", arg(&out), "--splat"];
    for arguments in [&[&render[..], &[arg(&splat)]].concat(), &["inspect", arg(&large)][..]] {
        let output = run_with_memory_limit(limit, arguments);
        let err = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{err}");
        assert!(err.starts_with("globalsplat: ") && err.lines().count() == 1, "{err}");
        assert!(err.contains("out of memory"), "{err}");
        assert_eq!(std::fs::read(&out).unwrap(), b"what was there before");
    }
}
