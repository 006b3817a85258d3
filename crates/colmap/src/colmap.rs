//! COLMAP, as a program or as the Python package pycolmap: found, and its commands run.

use crate::process::Process;
use crate::progress::{Progress, Reporter};
use globalsplat_files::{Error, Result};
use serde_json::Value;
use std::fmt;
use std::fs::OpenOptions;
use std::io::Write;
#[cfg(unix)]
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};

/// Environment variable that names the COLMAP to use: the path of a `colmap` program, or of a Python that has pycolmap.
const VARIABLE: &str = "GLOBALSPLAT_COLMAP";
/// How to get COLMAP.
const GET: &str = "pip install pycolmap, or apt install colmap";
/// Oldest versions that are supported.
const OLDEST_COLMAP: (u32, u32) = (3, 8);
const OLDEST_PYCOLMAP: (u32, u32) = (4, 0);

/// Adds the packages of the user, which `-I` leaves out.
const ADD_USER_PACKAGES: &str = "import site, sys; sys.path.append(site.getusersitepackages())\n";
/// Prints pycolmap's version.
const PRINT_VERSION: &str = "import pycolmap; print('COLMAP', pycolmap.__version__)";
/// Program that runs a command by pycolmap.
const RUN_COMMAND: &str = include_str!("pycolmap_command.py");

/// An installed COLMAP.
#[derive(Debug, Clone)]
pub struct Colmap {
    program: PathBuf,
    /// `true` if `program` is a Python that has pycolmap, `false` if it is COLMAP's own program.
    pub(crate) is_python: bool,
    version: String,
}

impl Colmap {
    /// Finds COLMAP: the program or the Python that `GLOBALSPLAT_COLMAP` names; else the newest of `colmap` on the PATH and the pycolmap of
    /// the first Python that has it, and of equal versions pycolmap. Python is looked for in `.venv` beside this program, or of the
    /// checkout in whose `target` it is, in the environment among whose packages it is, in the active virtual or Conda environment, and as
    /// `python3` on the PATH.
    ///
    /// # Errors
    /// Returns an error that says how to install COLMAP if there is none, or what is wrong with the one that `GLOBALSPLAT_COLMAP` names.
    pub fn find() -> Result<Self> {
        if let Some(path) = std::env::var_os(VARIABLE).filter(|path| !path.is_empty()) {
            return Self::at(Path::new(&path));
        }
        let program = Self::new("colmap".into(), false);
        let python = python_programs().into_iter().find_map(|python| Self::new(python, true));
        let found = [program, python].into_iter().flatten();
        let newest = found.max_by_key(|colmap| (colmap.check().is_ok(), parse_version(&colmap.version)));
        let newest = newest.ok_or_else(|| {
            Error::request(format!("COLMAP, which finds the poses of photos, isn't installed ({GET})"))
        })?;
        newest.check().map(|()| newest)
    }

    /// Returns the COLMAP at `path`, a `colmap` program or a Python that has pycolmap.
    ///
    /// # Errors
    /// Returns an error if it can't be started, or if its version isn't supported.
    pub fn at(path: &Path) -> Result<Self> {
        let is_python =
            path.file_stem().is_some_and(|name| name.to_string_lossy().to_lowercase().starts_with("python"));
        let found = Self::new(path.to_owned(), is_python);
        let colmap = found.ok_or_else(|| {
            let found = if is_python { "a Python without pycolmap" } else { "no COLMAP that starts" };
            Error::input(
                path,
                "the program",
                found,
                format!("a colmap program or a Python with pycolmap ({GET})"),
            )
        })?;
        colmap.check().map(|()| colmap)
    }

    /// Returns the name and the version, as `pycolmap 4.2.1`.
    pub fn name_and_version(&self) -> String {
        format!("{} {}", if self.is_python { "pycolmap" } else { "COLMAP" }, self.version)
    }

    /// Returns `None` if the program can't be started, or has no version.
    fn new(program: PathBuf, is_python: bool) -> Option<Self> {
        let mut command = Command::new(&program);
        match is_python {
            true => isolate(&mut command, PRINT_VERSION),
            false => command.arg("help"),
        };
        let output = command.stdin(Stdio::null()).output().ok()?;
        let version = version_in(&String::from_utf8_lossy(&output.stdout))?.to_string();
        Some(Colmap { program, is_python, version })
    }

    fn check(&self) -> Result<()> {
        let oldest = if self.is_python { OLDEST_PYCOLMAP } else { OLDEST_COLMAP };
        match parse_version(&self.version) >= Some(oldest) {
            true => Ok(()),
            false => {
                let expected = format!("{}.{} or newer ({GET})", oldest.0, oldest.1);
                Err(Error::input(&self.program, "the version of COLMAP", &self.version, expected))
            }
        }
    }

    /// Runs a command of COLMAP and appends what it prints to the file `log`. `options` have the names that COLMAP 4 gives them. Reports
    /// progress regularly, from `start` by the number of photos in the log.
    ///
    /// # Errors
    /// Returns an error that quotes COLMAP's if the command can't be started or fails, or the one of [`Reporter::stop`].
    pub(crate) fn run(
        &self,
        name: &str,
        options: &Value,
        log: &Path,
        start: Progress,
        reporter: &mut Reporter,
    ) -> Result<()> {
        let failed_start = || Error::failed_with_context(format!("{self} can't be started"));
        reporter.report(start)?;
        let mut command = Command::new(&self.program);
        if self.is_python {
            isolate(&mut command, RUN_COMMAND).args([name, &options.to_string()]);
        } else {
            let mut help = Command::new(&self.program);
            let help = help.args([name, "-h"]).stdin(Stdio::null()).output().map_err(failed_start())?;
            command.arg(name).args(arguments(options, &String::from_utf8_lossy(&help.stdout)));
        }
        // Python ends when its standard input closes.
        command.stdin(Stdio::piped());
        let process = Process::start(command, false).map_err(failed_start())?;
        let mut log_file =
            OpenOptions::new().create(true).append(true).open(log).map_err(Error::write(log))?;
        let (mut current, mut last_words) = (start, "without a message".to_string());
        let status = process.wait(|line| {
            if let Some(line) = line {
                writeln!(log_file, "{line}").map_err(Error::write(log))?;
                if let Some(message) = message_in(&line) {
                    last_words = message.to_string();
                }
                if let Some(count) = count_in(&line) {
                    current.done = (start.done + count).min(start.total);
                }
            }
            reporter.report(current)
        })?;
        if status.success() {
            return Ok(());
        }
        if is_interrupted(status) {
            return reporter.stop();
        }
        reporter.report(current)?;
        let log = log.display();
        Err(Error::failed(format!("COLMAP's {name} failed: {last_words} ({status}); see {log}")))
    }
}

/// Returns `true` if Ctrl-C (SIGINT), SIGTERM or SIGHUP ended a process. They reach COLMAP, too, possibly before this process knows of them.
fn is_interrupted(status: ExitStatus) -> bool {
    #[cfg(unix)]
    return matches!(status.signal(), Some(1 | 2 | 15));
    // STATUS_CONTROL_C_EXIT.
    #[cfg(windows)]
    return status.code() == Some(0xc000_013a_u32 as i32);
}

/// Formats the version and the program, as `pycolmap 4.2.1 (.venv/bin/python)`.
impl fmt::Display for Colmap {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} ({})", self.name_and_version(), self.program.display())
    }
}

/// Returns the version in the output of `colmap help`, whose first line begins with `COLMAP 3.8`.
fn version_in(text: &str) -> Option<&str> {
    text.lines().find_map(|line| line.strip_prefix("COLMAP ")?.split_whitespace().next())
}

/// Returns the first two numbers of a version: those of `4.2.0.dev0` are (4, 2).
fn parse_version(version: &str) -> Option<(u32, u32)> {
    let mut numbers = version.split(|c: char| !c.is_ascii_digit());
    Some((numbers.next()?.parse().ok()?, numbers.next()?.parse().ok()?))
}

/// Makes `python` run `code` isolated (`-I`) from the working folder and from variables that name other modules, but with packages of the
/// user.
fn isolate<'a>(python: &'a mut Command, code: &str) -> &'a mut Command {
    // `site` follows this variable even in isolation.
    python.env_remove("PYTHONUSERBASE").args(["-I", "-c"]).arg(format!("{ADD_USER_PACKAGES}{code}"))
}

/// Returns the Pythons that may have pycolmap.
fn python_programs() -> Vec<PathBuf> {
    let program = std::env::current_exe().unwrap_or_default();
    let target = program.ancestors().take(5).find(|folder| folder.ends_with("target"));
    let local = [Some(&*program), target].into_iter().flatten().map(|path| path.with_file_name(".venv"));
    // ENVIRONMENT/lib/python3.N/site-packages/globalsplat/bin/globalsplat.
    let packages = program.ancestors().find(|folder| folder.ends_with("site-packages"));
    let own = packages.and_then(|folder| folder.ancestors().nth(3)).map(PathBuf::from);
    let active =
        ["VIRTUAL_ENV", "CONDA_PREFIX"].map(std::env::var_os).into_iter().flatten().map(PathBuf::from);
    let pythons = local.chain(own).chain(active).map(|environment| environment.join("bin/python"));
    let is_usable = |python: &PathBuf| python.is_absolute() && python.is_file();
    pythons.filter(is_usable).chain(["python3".into()]).collect()
}

/// Returns the arguments of COLMAP's program for `options`, in the version whose help for the command is `help`. Sections that are named
/// `Feature…` were named after SIFT before COLMAP 3.13.
fn arguments(options: &Value, help: &str) -> Vec<String> {
    let arguments = options.as_object().into_iter().flatten().flat_map(|(name, value)| {
        let option = format!("--{name}");
        let value = match value {
            Value::Bool(is_on) => u8::from(*is_on).to_string(),
            Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        [if help.contains(&option) { option } else { option.replacen("--Feature", "--Sift", 1) }, value]
    });
    arguments.collect()
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
    // "E20261127 01:56:37.250 1405 mapper.cc:270] …"; older versions print "ERROR: …", and Python "ValueError: …".
    if line.starts_with("E20") || line.starts_with("F20") {
        return Some(line.split_once("] ")?.1);
    }
    let (start, text) = line.trim_start().split_once(": ")?;
    let is_message =
        start == "ERROR" || start == "WARNING" || start.ends_with("Error") && !start.contains(' ');
    is_message.then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn versions_are_read_and_compared() {
        let help = "COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n(Commit Unknown on Unknown without CUDA)\n";
        assert_eq!(version_in(help), Some("3.8"));
        assert_eq!(version_in("COLMAP 4.2.1\n"), Some("4.2.1"));
        assert_eq!(version_in("Usage: something else"), None);
        assert_eq!(parse_version("4.2.0.dev0"), Some((4, 2)));
        assert!(parse_version("3.12.3") > parse_version("3.8"));
        assert_eq!(parse_version("unknown"), None);
    }

    #[test]
    fn options_have_the_names_of_the_version() {
        let options = json!({
            "image_path": "my photos",
            "FeatureExtraction.use_gpu": false,
            "FeatureExtraction.max_image_size": 1600,
            "SiftExtraction.max_num_features": 2048,
        });
        for section in ["SiftExtraction", "FeatureExtraction"] {
            let help = format!(
                "--image_path arg\n --{section}.use_gpu arg (=1)\n --{section}.max_image_size arg (=-1)\n"
            );
            let expected = format!(
                "--{section}.max_image_size 1600 --{section}.use_gpu 0 --SiftExtraction.max_num_features 2048 --image_path my photos"
            );
            assert_eq!(arguments(&options, &help).join(" "), expected);
        }
    }

    #[test]
    fn logs_of_all_versions_are_understood() {
        for (line, count, message) in [
            ("Processed file [12/50]", Some(12), None),
            ("I20261127 01:56:37.250 1405 feature_extraction.cc:270] Processed file [2/50]", Some(2), None),
            ("Registering image #7 (3)", Some(4), None),
            (
                "I20261127 02:05:53.566 1396 pipeline.cc:620] Registering image #8 (num_reg_frames=7)",
                Some(8),
                None,
            ),
            ("  Name:            0001.jpg", None, None),
            ("  => Image sees 128 / 367 points", None, None),
            ("Elapsed time: 0.003 [minutes]", None, None),
            ("I20261127 01:56:37.250 1405 mapper.cc:270] all is well", None, None),
            ("ERROR: failed to create sparse model", None, Some("failed to create sparse model")),
            ("E20261127 01:56:37.250 1405 mapper.cc:270] no images", None, Some("no images")),
            ("ValueError: [sift.cc:12] Check failed", None, Some("[sift.cc:12] Check failed")),
        ] {
            assert_eq!((count_in(line), message_in(line)), (count, message), "{line}");
        }
    }
}
