//! The command line: one file per command, which parses arguments, calls the library and prints the result.
//!
//! Exit codes: 0 success, 1 the work failed, 2 the request was wrong. Results go to standard output (with `--json` one object),
//! everything else to standard error.

mod bench;
mod capture;
mod convert;
mod device;
mod distributed;
mod doctor;
mod edits;
mod eval;
mod inspect;
mod man;
mod model;
mod pack;
mod parity;
mod progress;
mod reconstruct;
mod refine;
mod render;
mod report;
mod signals;
mod splat_out;
mod synth;
mod train;
mod view;
mod weights;

use crate::Error;
use crate::data::{Capture, Holdout};
use crate::distributed::is_communication_error;
use crate::error::panic_message;
use crate::scene::ImageSize;
use clap::{Parser, Subcommand};
use serde_json::Value;
use std::backtrace::{Backtrace, BacktraceStatus};
use std::io::{ErrorKind, Write, stdout};
use std::panic;
use std::path::Path;
use std::process::ExitCode;

const DONE: u8 = 0;
const FAILED: u8 = 1;
const WRONG_REQUEST: u8 = 2;

/// Turn posed photos into a compact 3D Gaussian splat in one forward pass.
#[derive(Parser)]
#[command(name = "globalsplat", version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Print the result as one JSON object
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand)]
enum Command {
    Capture(capture::Capture),
    Train(train::Train),
    Eval(Box<eval::Eval>),
    Report(report::Report),
    Reconstruct(reconstruct::Reconstruct),
    Refine(Box<refine::Refine>),
    Render(render::Render),
    View(view::View),
    Convert(convert::Convert),
    Export(weights::Export),
    Import(weights::Import),
    Synth(synth::Synth),
    Pack(pack::Pack),
    Inspect(inspect::Inspect),
    Bench(bench::Bench),
    Doctor(doctor::Doctor),
    Completions(man::Completions),
    Man(man::Man),
    #[command(hide = true)]
    Parity(parity::Parity),
}

impl Command {
    /// Runs the command and prints its result.
    fn run(self, as_json: bool) -> anyhow::Result<()> {
        let output = match self {
            Command::Train(command) => command.run()?,
            Command::Eval(command) => command.run()?,
            Command::Report(command) => command.run()?,
            Command::Refine(command) => command.run()?,
            Command::Capture(command) => command.run()?,
            Command::Reconstruct(command) => command.run()?,
            Command::Render(command) => command.run()?,
            Command::View(command) => command.run()?,
            Command::Convert(command) => command.run()?,
            Command::Export(command) => command.run()?,
            Command::Import(command) => command.run()?,
            Command::Synth(command) => command.run()?,
            Command::Pack(command) => command.run()?,
            Command::Inspect(command) => command.run()?,
            Command::Bench(command) => command.run()?,
            Command::Doctor(command) => command.run()?,
            Command::Completions(command) => command.run()?,
            Command::Man(command) => command.run()?,
            Command::Parity(command) => return command.run(),
        };
        if distributed::is_main_process() {
            let text = if as_json { output.json.to_string() } else { output.text };
            match writeln!(stdout().lock(), "{text}") {
                // A reader, such as `head`, has closed the pipe early.
                Err(e) if e.kind() == ErrorKind::BrokenPipe => std::process::exit(FAILED.into()),
                written => written.map_err(Error::failed_with_context("standard output can't be written"))?,
            }
        }
        output.failure.map_or(Ok(()), |failure| Err(failure.into()))
    }

    /// Returns `true` if the processes that `torchrun` started share the work of this command.
    fn is_shared(&self) -> bool {
        match self {
            Command::Train(_) => true,
            Command::Eval(command) => command.is_shared(),
            Command::Bench(command) => command.is_shared(),
            _ => false,
        }
    }
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            if distributed::is_main_process() {
                let _ = e.print();
            }
            // clap returns --help and --version as errors too, with exit code 0.
            return ExitCode::from(e.exit_code() as u8);
        }
    };
    // Denormals halve the speed of training on some processors. This must precede the start of other threads.
    globalsplat_csrc::runtime::flush_denormals();
    // Errors of libtorch that the library's own checks don't catch arrive as panics: the user still gets one sentence, and with
    // RUST_BACKTRACE=1 a backtrace.
    panic::set_hook(Box::new(|_| {
        let backtrace = Backtrace::capture();
        if backtrace.status() == BacktraceStatus::Captured {
            eprintln!("{backtrace}");
        }
    }));
    match cli.command.run_to_end(cli.json) {
        Ok(()) => ExitCode::from(DONE),
        Err((code, message)) => {
            if let Some(message) = message {
                eprintln!("globalsplat: {message}");
            }
            ExitCode::from(code)
        }
    }
}

/// Runs the program with `arguments` in this process, for tests, which thereby save the start of another one.
///
/// # Errors
/// Returns the exit code of a failure, and the message that the program would print.
pub fn run(arguments: &[&str]) -> Result<(), (u8, String)> {
    let cli = Cli::try_parse_from([&["globalsplat"], arguments].concat());
    let cli = cli.map_err(|e| (e.exit_code() as u8, e.to_string()))?;
    cli.command.run_to_end(cli.json).map_err(|(code, message)| (code, message.unwrap_or_default()))
}

impl Command {
    /// Runs the command. A failure is returned as its exit code and the message for the user, unless another process prints it.
    fn run_to_end(self, as_json: bool) -> Result<(), (u8, Option<String>)> {
        // Errors stay one sentence.
        globalsplat_csrc::runtime::disable_stack_traces();
        let result = panic::catch_unwind(panic::AssertUnwindSafe(|| {
            if !self.is_shared() {
                distributed::require_single_process()?;
            }
            self.run(as_json)
        }));
        let error = match result {
            Ok(Ok(())) => return Ok(()),
            Ok(Err(error)) => error,
            Err(panic) => {
                anyhow::anyhow!("internal error (please report): {}", panic_message(&*panic))
            }
        };
        let message = error.to_string();
        let error = error.downcast_ref::<Error>();
        let code = if error.is_some_and(Error::is_invalid_request) { WRONG_REQUEST } else { FAILED };
        Err((code, user_message(&message, error.is_some_and(is_communication_error))))
    }
}

/// Returns an error's message as the user sees it, or `None` if another process reports it.
fn user_message(message: &str, is_secondary: bool) -> Option<String> {
    let message = distributed::message_to_print(message, is_secondary)?;
    let is_out_of_memory = message.contains("DefaultCPUAllocator") || message.contains("std::bad_alloc");
    Some(if is_out_of_memory { "out of memory".into() } else { message })
}

/// Parses an image size as `--size` takes it.
fn parse_size(text: &str) -> Result<ImageSize, Error> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match sides {
        Some((width @ 1..=16384, height @ 1..=16384)) => Ok(ImageSize { width, height }),
        _ => Err(Error::request(format!("--size {text}: expected WxH, as in 640x480, up to 16384x16384"))),
    }
}

/// Parses the views that `--holdout` holds out.
fn parse_holdout(text: &str) -> anyhow::Result<Holdout> {
    Ok(text.parse::<Holdout>().map_err(Error::request)?)
}

/// Returns an error if --views is smaller than the number of photos that a reconstruction needs.
fn check_views(views: Option<usize>) -> Result<(), Error> {
    match views {
        Some(views @ ..2) => Err(Error::request(format!("--views is {views}, expected 2 or more"))),
        _ => Ok(()),
    }
}

/// Opens a capture and prints warnings about what is ignored or changed in it.
fn open_capture(path: &Path) -> crate::Result<Capture> {
    open_masked_capture(path, None)
}

/// Opens a capture like [`open_capture`], with the masks in the folder `masks` if it is given.
fn open_masked_capture(path: &Path, masks: Option<&Path>) -> crate::Result<Capture> {
    let mut capture = crate::data::open_capture(path)?;
    if let Some(masks) = masks {
        capture = capture.with_masks(masks)?;
    }
    warn(capture.warnings());
    Ok(capture)
}

/// Prints warnings about what is ignored or changed in an input, one per line.
fn warn(lines: &[String]) {
    if distributed::is_main_process() {
        lines.iter().for_each(|line| eprintln!("{line}"));
    }
}

/// Prints the first few warnings about what is ignored or changed in many inputs, and the number of further lines.
fn warn_of_many<'a>(lines: impl Iterator<Item = &'a String>) {
    const SHOWN: usize = 5;
    let lines: Vec<String> = lines.cloned().collect();
    let (shown, others) = lines.split_at(lines.len().min(SHOWN));
    warn(shown);
    if !others.is_empty() {
        warn(&[format!(
            "and {} more lines of this kind: `globalsplat inspect` says those of a capture",
            others.len()
        )]);
    }
}

/// Makes the process keep freed memory, for commands that allocate the same sizes again and again: the system zeroes every page that it
/// hands out, and by default glibc returns the memory of large tensors to it. A million Gaussians at 1920×1080 take a fifth longer
/// without this (`globalsplat bench raster`), and a training step of the main model a sixth (docs/speed.md).
fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the calls set parameters of the allocator.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1);
    }
}

/// Result of a command, which `main` prints.
#[derive(Default)]
struct Output {
    /// Object that `--json` prints.
    json: Value,
    /// Lines for people.
    text: String,
    /// Error with which the command ends after the result of the other work is printed.
    failure: Option<Error>,
}

impl Output {
    fn new(json: Value, text: impl Into<String>) -> Self {
        Output { json, text: text.into(), failure: None }
    }

    /// Creates a result whose text has a line for each value of the object `json`, and for each row of a list in it.
    fn table(json: Value) -> Self {
        let line = |name: &str, value: &Value| {
            let text = value_to_text(value).replace('\n', &format!("\n{:25}", ""));
            format!("{name:<24} {text}")
        };
        let mut lines = vec![];
        for (key, value) in json.as_object().into_iter().flatten() {
            match value {
                Value::Null => {}
                Value::Array(rows) if rows.is_empty() => {}
                Value::Array(rows) if rows.iter().any(|row| row.is_object() || row.is_array()) => {
                    lines.extend(rows.iter().map(|row| line(row["name"].as_str().unwrap_or(key), row)));
                }
                value => lines.push(line(key, value)),
            }
        }
        Output::new(json, lines.join("\n"))
    }
}

/// Formats a value for people: numbers with four significant digits, and the values of an object side by side.
fn value_to_text(value: &Value) -> String {
    let join = |values: Vec<String>| values.join(", ");
    match value {
        Value::String(text) => text.clone(),
        Value::Array(values) => join(values.iter().map(value_to_text).collect()),
        Value::Object(values) => {
            let values = values.iter().filter(|(key, _)| *key != "name");
            join(values.map(|(key, value)| format!("{key} {}", value_to_text(value))).collect())
        }
        other => match other.as_f64().filter(|number| number.fract() != 0.) {
            Some(number) => {
                let decimals = (3. - number.abs().log10().floor()).clamp(0., 12.) as usize;
                format!("{number:.decimals$}")
            }
            None => other.to_string(),
        },
    }
}

/// Reports that the photos in the file at `path` are downscaled, if the sides of the largest are divided by more than 1.
fn report_downscaling(path: &Path, by: i64) {
    if by > 1 {
        eprintln!(
            "{}: pictures are shrunk to 1/{by} of their sides, to 64 million pixels at most in all",
            path.display()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn every_command_has_examples() {
        let program = Cli::command();
        for command in program.get_subcommands().filter(|command| !command.is_hide_set()) {
            assert!(command.get_after_help().is_some(), "{} has no example", command.get_name());
        }
    }

    /// Every command has a page with its examples, and bash takes the completions.
    #[test]
    fn man_pages_and_completions_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let pages = folder.path().join("man1");
        let arguments = ["globalsplat", "man", pages.to_str().unwrap()];
        Cli::try_parse_from(arguments).unwrap().command.run(false).unwrap();
        let page = std::fs::read_to_string(pages.join("globalsplat-bench-raster.1")).unwrap();
        assert!(
            page.contains("\\-\\-gaussians") && page.contains(".SH EXAMPLES\n.nf\nglobalsplat "),
            "{page}"
        );
        let (script, mut text) = (folder.path().join("completions.sh"), vec![]);
        clap_complete::generate(clap_complete::Shell::Bash, &mut Cli::command(), "globalsplat", &mut text);
        std::fs::write(&script, text).unwrap();
        assert!(std::process::Command::new("bash").arg("-n").arg(&script).status().unwrap().success());
    }

    /// Every `globalsplat` command of the documentation's shell blocks has options that the program takes.
    #[test]
    fn documented_commands_parse() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let pages = std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path());
        let pages = pages.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
        for page in pages.chain(["README.md", "models/README.md"].map(|file| root.join(file))) {
            let text = std::fs::read_to_string(&page).unwrap().replace("\\\n", " ");
            let blocks = text.split("```sh\n").skip(1).filter_map(|rest| rest.split("```").next());
            for line in blocks.flat_map(str::lines) {
                let words = shlex::split(line).unwrap_or_else(|| panic!("{}: {line}", page.display()));
                let is_program = |word: &String| word == "globalsplat" || word.ends_with("/globalsplat");
                let is_operator = |word: &String| ["|", "&&", ">", "&", ";"].contains(&word.as_str());
                let command = words.into_iter().take_while(|word| !is_operator(word));
                let command: Vec<String> = command.skip_while(|word| !is_program(word)).collect();
                if let Some(Err(error)) = (!command.is_empty()).then(|| Cli::try_parse_from(command)) {
                    assert!(!error.use_stderr(), "{}: {line}\n{error}", page.display());
                }
            }
        }
    }
}
