//! Helpers for the tests of all crates: they write captures in the formats of other tools, find real data if it is present, and count
//! skipped tests.

pub mod formats;
mod poses;

pub use poses::pose_errors;

use std::ffi::OsString;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

/// Reports that a test is skipped because `what` is missing, and why; its caller returns early. `GLOBALSPLAT_SKIPPED` names the
/// file in which `make test` counts skipped tests. If `GLOBALSPLAT_NO_SKIPS` is set, skipping is a failure.
pub fn skip(what: &str, why: &str) {
    assert!(variable("GLOBALSPLAT_NO_SKIPS").is_none(), "no test may be skipped, but {why}");
    skip_on_this_processor(what, why);
}

/// Reports a skipped test like [`skip`], but for a requirement that can't be installed. It doesn't fail if `GLOBALSPLAT_NO_SKIPS` is set.
pub fn skip_on_this_processor(what: &str, why: &str) {
    println!("skipped: {why}");
    if let Some(file) = variable("GLOBALSPLAT_SKIPPED") {
        let file = OpenOptions::new().create(true).append(true).open(file);
        file.and_then(|mut file| file.write_all(format!("{what}\n").as_bytes())).expect("a file to count in");
    }
}

/// Returns the value of an environment variable that isn't empty.
fn variable(name: &str) -> Option<OsString> {
    std::env::var_os(name).filter(|value| !value.is_empty())
}

/// Runs the test `name` of the current test binary again, by itself and with the environment `variables`; returns `true` if it
/// passes, and what it was skipped for.
pub fn rerun_test(name: &str, variables: &[(&str, &Path)]) -> (bool, String) {
    let skipped = tempfile::NamedTempFile::new().expect("a file");
    let status = run_alone(name, |test| {
        test.env_remove("GLOBALSPLAT_NO_SKIPS")
            .env("GLOBALSPLAT_SKIPPED", skipped.path())
            .envs(variables.iter().copied())
    });
    (status.success(), std::fs::read_to_string(skipped.path()).expect("a file"))
}

/// Runs the test `name` of the current test binary again, by itself and with the environment `variables`; returns its exit code.
pub fn exit_code_of_test(name: &str, variables: &[(&str, &Path)]) -> Option<i32> {
    run_alone(name, |test| test.envs(variables.iter().copied())).code()
}

/// Runs the test `name`, which must exist, in a process that `configure` prepares.
fn run_alone(name: &str, configure: impl FnOnce(&mut Command) -> &mut Command) -> ExitStatus {
    let mut test = Command::new(std::env::current_exe().expect("a program"));
    let output = configure(test.args([name, "--exact"])).output().expect("a program that starts");
    let stdout = String::from_utf8_lossy(&output.stdout);
    assert!(stdout.contains("running 1 test"), "{name}: {stdout}");
    output.status
}

/// Returns the folder that `variable` names, else `../shared/<name>` beside the repository; if it doesn't exist, skips the test because
/// `what` is missing.
fn find_external_folder(variable: &str, name: &str, what: &str) -> Option<PathBuf> {
    let path = match std::env::var_os(variable) {
        Some(path) => PathBuf::from(path),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared").join(name),
    };
    if path.is_dir() {
        return Some(path);
    }
    skip(what, &format!("{} is missing; set {variable}", path.display()));
    None
}

/// Returns the folder of golden tensors.
pub fn golden() -> Option<PathBuf> {
    find_external_folder("GLOBALSPLAT_GOLDEN", "golden", "golden tensors")
}

/// Returns real captures, at least one: folders with `cameras.json` and a published `reference.ply` under `re10k`.
pub fn captures() -> Option<Vec<PathBuf>> {
    let root = find_external_folder("GLOBALSPLAT_CAPTURES", "data", "captures")?;
    let root = if root.join("re10k").is_dir() { root.join("re10k") } else { root };
    let mut captures: Vec<PathBuf> = std::fs::read_dir(&root)
        .expect("a readable folder")
        .map(|entry| entry.expect("a readable entry").path())
        .filter(|path| path.join("cameras.json").is_file())
        .collect();
    captures.sort();
    if captures.is_empty() {
        skip("captures", &format!("no capture is in {}", root.display()));
        return None;
    }
    Some(captures)
}

/// Returns a real capture with a `transforms.json` and a distorting lens, under `nerfstudio`.
pub fn fox() -> Option<PathBuf> {
    let fox = find_external_folder("GLOBALSPLAT_CAPTURES", "data", "captures")?.join("nerfstudio/fox");
    if fox.is_dir() {
        return Some(fox);
    }
    skip("captures", &format!("{} is missing", fox.display()));
    None
}
