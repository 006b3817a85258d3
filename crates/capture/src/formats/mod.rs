//! Formats of captures on disk. Each has a module, whose `find` recognizes its captures.

pub mod cameras_json;
#[cfg(feature = "chunks")]
pub mod chunk;
pub mod colmap;
pub mod llff;
pub mod polycam;
pub mod transforms_json;

use crate::capture::{Capture, Purpose};
use globalsplat_files::{Error, Result, read_text};
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};

/// Function that reads a capture that was found.
pub(crate) type CaptureOpener = Box<dyn FnOnce(Purpose) -> Result<Capture>>;

/// Returns the file `name` that describes a capture, if it exists in the capture's folder `path`.
fn file_in(path: &Path, name: &str) -> Option<PathBuf> {
    Some(path.join(name)).filter(|file| file.is_file())
}

/// Returns the name of the last folder in `path`. An empty path stands for the working directory.
pub fn folder_name(path: &Path) -> String {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let folder = path.canonicalize().unwrap_or(path.to_owned());
    folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Reads the JSON in `file`. NaN, Infinity and -Infinity, which Python writes and JSON lacks, are read as null.
///
/// # Errors
/// Fails if the file can't be read, and if it isn't a `T`: the file is then said to be `found`.
pub(crate) fn read_json<T: DeserializeOwned>(file: &Path, found: &str, expected: &str) -> Result<T> {
    serde_json::from_str(&replace_nan_with_null(&read_text(file)?))
        .map_err(|e| Error::input(file, "the file", format!("{found} ({e})"), expected))
}

/// Replaces NaN, Infinity and -Infinity outside of strings by null.
fn replace_nan_with_null(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    let (mut in_string, mut escaped) = (false, false);
    while let Some(c) = rest.chars().next() {
        let token =
            ["NaN", "Infinity", "-Infinity"].iter().find(|token| !in_string && rest.starts_with(**token));
        match token {
            Some(token) => {
                out.push_str("null");
                rest = &rest[token.len()..];
            }
            None => {
                in_string ^= c == '"' && !escaped;
                escaped = in_string && c == '\\' && !escaped;
                out.push(c);
                rest = &rest[c.len_utf8()..];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::replace_nan_with_null;

    #[test]
    fn only_numbers_are_replaced() {
        let text = r#"{"NaN \" NaN": [NaN, -Infinity, 1.5], "b": Infinity}"#;
        assert_eq!(replace_nan_with_null(text), r#"{"NaN \" NaN": [null, null, 1.5], "b": null}"#);
    }
}
