//! Running the program as a user does, on a small capture that it generates itself.

use super::room::write_room;
use serde_json::Value;
use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::OnceLock;
use std::time::Duration;
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

/// Setting with which several threads don't slow down the other tests.
pub const WAIT_PASSIVELY: (&str, &str) = ("OMP_WAIT_POLICY", "passive");

/// Returns the command `globalsplat` with `arguments`, limited to one thread because tests run concurrently.
pub fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_globalsplat"));
    command.args(arguments).env("OMP_NUM_THREADS", "1");
    command
}

/// Runs a process that must succeed, and returns its standard output and its standard error.
#[track_caller]
pub fn run_process(command: &mut Command) -> (String, String) {
    let output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).expect("text"));
    assert_eq!(output.status.code(), Some(0), "{command:?}: {err}");
    (out, err)
}

/// Returns `program` with a limit of 8 kB for the size of its files, which acts like a full disk.
pub fn limit_file_size(program: &Command) -> Command {
    // If SIGXFSZ is ignored, the system refuses a write beyond the limit instead of ending the program.
    let mut limited = Command::new("bash");
    limited.args(["-c", "trap '' XFSZ; ulimit -S -f 8; exec \"$@\"", "bash"]);
    limited.arg(program.get_program()).args(program.get_args()).env("OMP_NUM_THREADS", "1");
    limited
}

/// Polls `find` until it returns a value, while all `processes` are running.
#[track_caller]
pub fn wait_for<T>(processes: &mut [Child], mut find: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(found) = find() {
            return found;
        }
        assert!(processes.iter_mut().all(|process| process.try_wait().unwrap().is_none()), "one has ended");
        std::thread::sleep(Duration::from_micros(200));
    }
}

/// Sends a signal to a process, or to none if it has ended.
#[cfg(unix)]
pub fn send_signal(process: u32, signal: libc::c_int) {
    // SAFETY: the process was started by the test, and nobody has waited for it.
    unsafe { libc::kill(process as i32, signal) };
}

/// Returns the standard output of a run that must succeed.
#[track_caller]
pub fn succeed(arguments: &[&str]) -> String {
    run_process(&mut command(arguments)).0
}

/// Returns the one-sentence error of a run that must be refused with exit code 2.
pub fn refuse(arguments: &[&str]) -> String {
    fail(arguments, 2)
}

/// Returns the one-sentence error of a run that must end with `code`. The run is in this process, which saves the start of another.
#[track_caller]
pub fn fail(arguments: &[&str], code: u8) -> String {
    let (found, message) = globalsplat::run(arguments).expect_err("a failure");
    assert_eq!((found, message.lines().count()), (code, 1), "{arguments:?}: {message}");
    assert!(!message.contains("internal error"), "{message}");
    message
}

/// Returns the path as an argument.
pub fn arg(path: &Path) -> &str {
    path.to_str().expect("an UTF-8 path")
}

fn text(word: &OsString) -> &str {
    word.to_str().expect("a word in UTF-8")
}

pub fn copy_dir(from: &Path, to: &Path) {
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

/// Writes untrained weights of [`TINY_CONFIG`].
pub fn tiny_weights(folder: &Path, capture: &Path) -> PathBuf {
    static WEIGHTS: OnceLock<Vec<u8>> = OnceLock::new();
    let (config, weights) = (tiny_config(folder, capture), folder.join("tiny.safetensors"));
    let bytes = WEIGHTS.get_or_init(|| {
        globalsplat::run(&["export", "--config", arg(&config), "--out", arg(&weights)]).expect("weights");
        std::fs::read(&weights).expect("weights")
    });
    std::fs::write(&weights, bytes).expect("weights");
    weights
}

/// A temporary folder for the commands of a test. In their lines, words that begin with @ are files in the folder, and LPIPS is off, because
/// it takes longer than all the rest.
pub struct Sandbox {
    _temporary: TempDir,
    folder: PathBuf,
}

impl Sandbox {
    pub fn empty() -> Self {
        Sandbox::named("sandbox")
    }

    /// Returns an empty folder called `name`.
    pub fn named(name: impl AsRef<OsStr>) -> Self {
        let temporary = tempfile::tempdir().expect("a folder");
        let folder = temporary.path().join(name.as_ref());
        std::fs::create_dir(&folder).expect("a folder");
        Sandbox { _temporary: temporary, folder }
    }

    /// Contains the capture `room` of nine 40×40 photos with its splat `room/truth.ply`, and the configuration `tiny.toml`, which trains with
    /// it.
    pub fn new() -> Self {
        static ORIGINAL: OnceLock<Sandbox> = OnceLock::new();
        let original = ORIGINAL.get_or_init(|| {
            let sandbox = Sandbox::empty();
            write_room(&sandbox.path("room"), 0, 9, [40, 40].into());
            sandbox
        });
        let sandbox = Sandbox::empty();
        copy_dir(original.folder(), sandbox.folder());
        tiny_config(sandbox.folder(), &sandbox.path("room"));
        sandbox
    }

    /// Also contains untrained weights, `tiny.safetensors`.
    pub fn with_weights() -> Self {
        let sandbox = Sandbox::new();
        tiny_weights(sandbox.folder(), &sandbox.path("room"));
        sandbox
    }

    pub fn folder(&self) -> &Path {
        &self.folder
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    pub fn text(&self, name: &str) -> String {
        String::from_utf8(self.read(name)).expect("text")
    }

    pub fn read_json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.read(name)).expect("JSON")
    }

    /// Writes a file, and the folders that lead to it.
    pub fn write(&self, name: &str, contents: impl AsRef<[u8]>) {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, contents).expect("a file");
    }

    pub fn copy(&self, from: &str, to: &str) {
        self.write(to, self.read(from));
    }

    /// Changes the JSON object in the file `name`.
    pub fn change_json(&self, name: &str, change: impl FnOnce(&mut Value)) {
        let mut json = self.read_json(name);
        change(&mut json);
        self.write(name, json.to_string());
    }

    /// Returns the sorted names of the entries of the folder `name`.
    pub fn names(&self, name: &str) -> Vec<String> {
        let entries = std::fs::read_dir(self.path(name)).expect("a folder");
        let mut names: Vec<String> =
            entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("text")).collect();
        names.sort();
        names
    }

    /// Returns every file of the folder, with its contents.
    pub fn contents(&self) -> BTreeMap<PathBuf, Vec<u8>> {
        contents(self.folder())
    }

    fn words(&self, line: &str) -> Vec<OsString> {
        let folder = self.folder.join("").into_os_string();
        let with_folder =
            |word: String| word.split('@').map(OsStr::new).collect::<Vec<_>>().join(folder.as_os_str());
        shlex::split(line).expect("words").into_iter().map(with_folder).collect()
    }

    /// Returns the command of `line`, to run it in a process of its own.
    pub fn command(&self, line: &str) -> Command {
        let mut command = command(&[]);
        command.args(self.words(line)).env("GLOBALSPLAT_WEIGHTS", self.folder());
        command
    }

    /// Returns the exit code, the standard output and the standard error of a process.
    pub fn output(&self, line: &str) -> (Option<i32>, String, String) {
        let output = self.command(line).output().expect("a program that starts");
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("text");
        (output.status.code(), text(output.stdout), text(output.stderr))
    }

    /// Returns the standard output of a process that must succeed.
    #[track_caller]
    pub fn succeed(&self, line: &str) -> String {
        self.succeed_with_messages(line).0
    }

    /// Returns the standard output and the standard error of a process that must succeed.
    #[track_caller]
    pub fn succeed_with_messages(&self, line: &str) -> (String, String) {
        run_process(&mut self.command(line))
    }

    /// Returns the one JSON object that a process prints with `--json`.
    #[track_caller]
    pub fn json(&self, line: &str) -> Value {
        let out = self.succeed(&format!("{line} --json"));
        assert_eq!(out.lines().count(), 1, "one object: {out}");
        serde_json::from_str(&out).expect("JSON")
    }

    /// Runs a command that must succeed in this process, which saves the start of another. Its output is lost.
    #[track_caller]
    pub fn run(&self, line: &str) {
        let words = self.words(line);
        if let Err((_, message)) = globalsplat::run(&words.iter().map(text).collect::<Vec<_>>()) {
            panic!("{line}: {message}");
        }
    }

    /// Returns the one-sentence error of a command that must be refused with exit code 2, in this process.
    #[track_caller]
    pub fn refuse(&self, line: &str) -> String {
        self.fail(line, 2)
    }

    /// Returns the one-sentence error of a command that must end with `code`, in this process.
    #[track_caller]
    pub fn fail(&self, line: &str, code: u8) -> String {
        let words = self.words(line);
        fail(&words.iter().map(text).collect::<Vec<_>>(), code)
    }
}

/// Returns every file below `folder`, with its contents.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        match path.is_dir() {
            true => files.extend(contents(&path)),
            false => drop(files.insert(path.clone(), std::fs::read(&path).expect("a file"))),
        }
    }
    files
}

/// Returns the number at the JSON pointer `path`.
pub fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} in {value}"))
}

/// Asserts that `message` contains each of `parts`.
#[track_caller]
pub fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part:?} is not in: {message}");
    }
}
