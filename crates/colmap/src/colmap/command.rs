//! A command of COLMAP: its options by version, its log, its progress, and its end when it is stopped.

use super::Colmap;
use globalsplat_files::{Error, Result};
use serde_json::{Map, Value};
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{self, Child, ExitStatus, Stdio};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// Program that runs a command by pycolmap.
const PYTHON: &str = include_str!("pycolmap_command.py");

/// Sections of options that were named after SIFT before COLMAP 3.13, with their present names.
const RENAMED: [(&str, &str); 2] =
    [("FeatureExtraction", "SiftExtraction"), ("FeatureMatching", "SiftMatching")];

/// Maximum time between two calls of the callback.
const PAUSE: Duration = Duration::from_millis(100);

/// A command of COLMAP and its options, under the names that COLMAP 4 gives them.
#[derive(Debug, Clone)]
pub(crate) struct Command {
    name: &'static str,
    options: Map<String, Value>,
}

/// End of a command that didn't fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    Finished,
    Stopped,
}

impl Command {
    pub fn new(name: &'static str) -> Self {
        Command { name, options: Map::new() }
    }

    /// Adds an option.
    pub fn option(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.options.insert(name.into(), value.into());
        self
    }

    /// Adds an option whose value is a path.
    pub fn path(self, name: &str, path: &Path) -> Self {
        let path = path.to_string_lossy().into_owned();
        self.option(name, path)
    }

    /// Returns the arguments of COLMAP's program, whose help for this command is `help`.
    fn arguments(&self, help: &str) -> Vec<String> {
        let mut arguments = vec![self.name.to_string()];
        for (name, value) in &self.options {
            let renamed = RENAMED.iter().find_map(|(now, before)| {
                let key = name.strip_prefix(now)?;
                (!help.contains(&format!("--{name}"))).then(|| format!("{before}{key}"))
            });
            arguments.push(format!("--{}", renamed.as_ref().unwrap_or(name)));
            arguments.push(match value {
                Value::Bool(is_on) => u8::from(*is_on).to_string(),
                Value::String(text) => text.clone(),
                other => other.to_string(),
            });
        }
        arguments
    }

    /// Runs the command with `colmap` and appends what it prints to the file `log`. Calls `on_count` for every count of photos in the log,
    /// and regularly with `None` in between; the command is stopped as soon as it returns `false`.
    ///
    /// # Errors
    /// Returns an error that quotes COLMAP's if the command can't be started or fails.
    pub fn run(
        &self,
        colmap: &Colmap,
        log: &Path,
        on_count: &mut dyn FnMut(Option<usize>) -> bool,
    ) -> Result<Outcome> {
        let failed_start = || Error::failed_with_context(format!("{colmap} can't be started"));
        let mut command = process::Command::new(&colmap.program);
        if colmap.is_python {
            command.args(["-c", PYTHON, self.name, &Value::Object(self.options.clone()).to_string()]);
        } else {
            let mut help = process::Command::new(&colmap.program);
            let help = help.args([self.name, "-h"]).stdin(Stdio::null()).output().map_err(failed_start())?;
            command.args(self.arguments(&String::from_utf8_lossy(&help.stdout)));
        }
        // Python ends when its standard input closes.
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let mut child = Running(child.map_err(failed_start())?);
        let mut log_file =
            OpenOptions::new().create(true).append(true).open(log).map_err(Error::write(log))?;
        let (sender, lines) = channel();
        send_lines(child.0.stdout.take().expect("a pipe was requested"), sender.clone());
        send_lines(child.0.stderr.take().expect("a pipe was requested"), sender);
        let mut last_words = "without a message".to_string();
        let mut last_call = Instant::now();
        loop {
            let is_wanted = match lines.recv_timeout(PAUSE) {
                Ok(line) => {
                    writeln!(log_file, "{line}").map_err(Error::write(log))?;
                    if let Some(message) = message_in(&line) {
                        last_words = message.to_string();
                    }
                    let count = count_in(&line);
                    let is_due = count.is_some() || last_call.elapsed() >= PAUSE;
                    if is_due {
                        last_call = Instant::now();
                    }
                    !is_due || on_count(count)
                }
                Err(RecvTimeoutError::Timeout) => on_count(None),
                Err(RecvTimeoutError::Disconnected) => break,
            };
            if !is_wanted {
                return Ok(Outcome::Stopped);
            }
        }
        let status = child.0.wait().map_err(Error::failed_with_context(colmap))?;
        if status.success() {
            return Ok(Outcome::Finished);
        }
        // Ctrl-C reaches COLMAP, too, possibly before this process knows of it.
        if is_interrupted(status) || !on_count(None) {
            return Ok(Outcome::Stopped);
        }
        Err(Error::failed(format!(
            "COLMAP's {} failed: {last_words} ({status}); see {}",
            self.name,
            log.display()
        )))
    }
}

/// A process that is killed on drop unless it has ended.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Sends the lines of `pipe` from a thread.
fn send_lines(pipe: impl Read + Send + 'static, sender: Sender<String>) {
    std::thread::spawn(move || {
        let mut pipe = BufReader::new(pipe);
        let mut line = vec![];
        while pipe.read_until(b'\n', &mut line).is_ok_and(|count| count > 0) {
            let text = String::from_utf8_lossy(&line).trim_end().to_string();
            if sender.send(text).is_err() {
                break;
            }
            line.clear();
        }
    });
}

/// Returns `true` if a process was ended by a request to stop.
fn is_interrupted(status: ExitStatus) -> bool {
    const SIGHUP: i32 = 1;
    const SIGINT: i32 = 2;
    const SIGTERM: i32 = 15;
    use std::os::unix::process::ExitStatusExt;
    matches!(status.signal(), Some(SIGHUP | SIGINT | SIGTERM))
}

/// Returns the number of photos that a line of COLMAP's log reports: those with features, or those registered so far.
fn count_in(line: &str) -> Option<usize> {
    let number = |text: &str| -> Option<usize> {
        let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
        text[..end].parse().ok()
    };
    if let Some((_, rest)) = line.split_once("Processed file [") {
        return number(rest);
    }
    // "Registering image #7 (3)" until COLMAP 3.11, "Registering image #7 (num_reg_frames=3)" since.
    let (_, rest) = line.split_once("Registering image #")?;
    let (_, rest) = rest.split_once('(')?;
    number(rest.strip_prefix("num_reg_frames=").unwrap_or(rest)).map(|others| others + 1)
}

/// Returns the text of a warning, an error or an exception in COLMAP's log.
fn message_in(line: &str) -> Option<&str> {
    if let Some(message) =
        ["ERROR: ", "WARNING: "].iter().find_map(|start| line.trim_start().strip_prefix(start))
    {
        return Some(message);
    }
    let is_logged = |level: char| {
        let rest = line.strip_prefix(level)?;
        rest.starts_with("20").then_some(())?;
        Some(rest.split_once("] ")?.1)
    };
    let exception =
        || line.split_once("Error: ").filter(|(class, _)| !class.contains(' ')).map(|(_, text)| text);
    ['E', 'F'].into_iter().find_map(is_logged).or_else(exception)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_have_the_names_of_the_version() {
        let command = Command::new("feature_extractor")
            .path("image_path", Path::new("my photos"))
            .option("FeatureExtraction.use_gpu", false)
            .option("FeatureExtraction.max_image_size", 1600)
            .option("SiftExtraction.max_num_features", 2048);
        let old = "  --image_path arg\n  --SiftExtraction.use_gpu arg (=1)\n  --SiftExtraction.max_image_size arg (=3200)\n  \
                   --SiftExtraction.max_num_features arg (=8192)\n";
        let new = "  --image_path arg\n  --FeatureExtraction.use_gpu arg (=1)\n  --FeatureExtraction.max_image_size arg (=-1)\n  \
                   --SiftExtraction.max_num_features arg (=8192)\n";
        let expected = |section: &str| {
            format!(
                "feature_extractor --{section}.max_image_size 1600 --{section}.use_gpu 0 \
                 --SiftExtraction.max_num_features 2048 --image_path my photos"
            )
        };
        assert_eq!(command.arguments(old).join(" "), expected("SiftExtraction"));
        assert_eq!(command.arguments(new).join(" "), expected("FeatureExtraction"));
    }

    #[test]
    fn counts_are_read_from_logs_of_all_versions() {
        for (line, count) in [
            ("Processed file [12/50]", Some(12)),
            ("I20261127 01:56:37.250 1405 feature_extraction.cc:270] Processed file [2/50]", Some(2)),
            ("Registering image #7 (3)", Some(4)),
            (
                "I20261127 02:05:53.566 1396 incremental_pipeline.cc:620] Registering image #8 (num_reg_frames=7)",
                Some(8),
            ),
            ("  Name:            0001.jpg", None),
            ("  => Image sees 128 / 367 points", None),
        ] {
            assert_eq!(count_in(line), count, "{line}");
        }
    }

    #[test]
    fn the_reason_of_a_failure_is_found_in_the_log() {
        for (line, message) in [
            ("ERROR: failed to create sparse model", Some("failed to create sparse model")),
            ("E20261127 01:56:37.250 1405 mapper.cc:270] no images", Some("no images")),
            ("ValueError: [sift.cc:12] Check failed", Some("[sift.cc:12] Check failed")),
            ("I20261127 01:56:37.250 1405 mapper.cc:270] all is well", None),
            ("Elapsed time: 0.003 [minutes]", None),
        ] {
            assert_eq!(message_in(line), message, "{line}");
        }
    }
}
