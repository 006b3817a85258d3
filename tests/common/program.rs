//! Running the program as a user does, on a small capture that it generates itself.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use tempfile::TempDir;

/// Configuration of a small model that trains quickly.
pub const TINY_CONFIG: &str = r#"
[model]
latents = 16
width = 32
rgb_width = 32
ray_width = 16
rounds = 1
self_attention_blocks = 1
heads = 4
candidates = 4

[data]
image_size = [32, 32]
context_views = 3
target_views = 2
window = [3, 220]
holdout = "every:3+1"

[curriculum]
final_stage = 2
boundaries = [2, 4]
transition = 2

[loss]
perceptual = "none"

[train]
steps = 6
batch_size = 1
checkpoint_every = 2
"#;

/// Runs `globalsplat` with `arguments` and returns its output.
pub fn globalsplat(arguments: &[&str]) -> Output {
    command(arguments).output().expect("a program that starts")
}

/// Returns the command `globalsplat` with `arguments`, limited to one thread because tests run concurrently.
pub fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_globalsplat"));
    command.args(arguments).env("OMP_NUM_THREADS", "1");
    command
}

/// Returns the standard output of a run that must succeed.
pub fn succeed(arguments: &[&str]) -> String {
    let output = globalsplat(arguments);
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{arguments:?}: {err}");
    out.into_owned()
}

/// Returns the one-sentence error of a run that must be refused with exit code 2.
pub fn refuse(arguments: &[&str]) -> String {
    fail(arguments, 2)
}

/// Returns the one-sentence error of a run that must end with `code`.
pub fn fail(arguments: &[&str], code: i32) -> String {
    let output = globalsplat(arguments);
    let err = String::from_utf8_lossy(&output.stderr).trim().to_string();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {err}");
    assert!(output.stdout.is_empty(), "a refusal prints no result");
    assert_eq!(err.lines().count(), 1, "one sentence: {err}");
    assert!(!err.contains("panicked"), "{err}");
    err
}

/// Returns the path as an argument.
pub fn arg(path: &Path) -> &str {
    path.to_str().expect("an UTF-8 path")
}

/// Writes the rooms `room_000`, … to `folder`, each with `frames` photos of `size` × `size`.
pub fn rooms(folder: &Path, scenes: u32, frames: u32, size: u32) {
    super::room::write_rooms(folder, scenes, frames, size).expect("rooms");
}

/// Returns a capture of nine 40×40 photos of a procedural room, with `ground_truth.ply` beside them; every caller gets its own copy.
pub fn room() -> (TempDir, PathBuf) {
    static ORIGINAL: OnceLock<TempDir> = OnceLock::new();
    let original = ORIGINAL.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder");
        rooms(folder.path(), 1, 9, 40);
        folder
    });
    let folder = tempfile::tempdir().expect("a folder");
    let room = folder.path().join("room_000");
    copy_dir(&original.path().join("room_000"), &room);
    (folder, room)
}

fn copy_dir(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy_dir(&entry.path(), &target),
            false => drop(std::fs::copy(entry.path(), target).expect("a copy")),
        }
    }
}

/// Writes [`TINY_CONFIG`] to `folder`, with `capture` as its data.
pub fn tiny_config(folder: &Path, capture: &Path) -> PathBuf {
    let file = folder.join("tiny.toml");
    let data = format!("[data]\ncaptures = [{:?}]", arg(capture));
    std::fs::write(&file, TINY_CONFIG.replace("[data]", &data)).expect("a configuration");
    file
}

/// Exports untrained weights of [`TINY_CONFIG`].
pub fn tiny_weights(folder: &Path, capture: &Path) -> PathBuf {
    let (config, weights) = (tiny_config(folder, capture), folder.join("tiny.safetensors"));
    succeed(&["export", "--config", arg(&config), "--out", arg(&weights)]);
    weights
}

/// Returns the arguments that train the model of `config` in `run`, with `settings`.
pub fn train(config: &Path, run: &Path, settings: &[&str]) -> Vec<String> {
    let mut arguments = vec!["train", "--config", arg(config), "--out", arg(run)];
    arguments.extend(settings.iter().flat_map(|setting| ["--set", setting]));
    arguments.into_iter().map(String::from).collect()
}

/// Returns the arguments as string slices.
pub fn text(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}
