//! Search for an installed COLMAP.

use globalsplat_files::{Error, Result};
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Environment variable that names the COLMAP to use: the path of a `colmap` program, or of a Python that has pycolmap.
pub const VARIABLE: &str = "GLOBALSPLAT_COLMAP";

/// How to get COLMAP.
const GET: &str = "pip install pycolmap, or apt install colmap";

/// Oldest versions that are supported.
const OLDEST_COLMAP: (u32, u32) = (3, 8);
const OLDEST_PYCOLMAP: (u32, u32) = (4, 0);

/// Prints pycolmap's version. Modules in the working directory are not imported.
const PRINT_VERSION: &str = "import sys; sys.path = [p for p in sys.path if p]; import pycolmap; print('COLMAP', pycolmap.__version__)";

/// An installed COLMAP.
#[derive(Debug, Clone)]
pub struct Colmap {
    pub(super) program: PathBuf,
    /// `true` if `program` is a Python that has pycolmap, `false` if it is COLMAP's own program.
    pub(crate) is_python: bool,
    version: String,
}

impl Colmap {
    /// Finds COLMAP: the program or the Python that [`VARIABLE`] names; else the newest of `colmap` on the PATH and the pycolmap of
    /// the first Python that has it, and of equal versions pycolmap. Python is looked for in `.venv` of the working directory and of
    /// the folders above this program, in the active virtual or Conda environment, and as `python3` on the PATH.
    ///
    /// # Errors
    /// Returns an error that says how to install COLMAP if there is none, or what is wrong with the one that [`VARIABLE`] names.
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
            true => command.args(["-c", PRINT_VERSION]),
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

/// Returns the Pythons that may have pycolmap.
fn python_programs() -> Vec<PathBuf> {
    let program = std::env::current_exe().unwrap_or_default();
    let folders = [Path::new("")].into_iter().chain(program.ancestors().skip(1));
    let local = folders.map(|folder| folder.join(".venv"));
    let active =
        ["VIRTUAL_ENV", "CONDA_PREFIX"].map(std::env::var_os).into_iter().flatten().map(PathBuf::from);
    let pythons = local.chain(active).map(|environment| environment.join("bin/python"));
    pythons.filter(|python| python.is_file()).chain(["python3".into()]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_program_that_is_named_but_missing_is_an_error() {
        let error = Colmap::at(Path::new("/no/such/python3")).unwrap_err();
        assert!(error.is_invalid_request());
        assert_eq!(
            error.to_string(),
            "/no/such/python3: the program is a Python without pycolmap, expected a colmap program or a Python with \
             pycolmap (pip install pycolmap, or apt install colmap)"
        );
    }
}
