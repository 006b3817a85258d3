//! Paths as users write them: environment variables in a path of a configuration, `FILE#KEY`, an entry of a file, and names of files in a
//! folder.

use crate::{Error, Result};
use std::ffi::{OsStr, OsString};
use std::path::{MAIN_SEPARATOR_STR, Path, PathBuf};

/// Returns `text` with `${NAME}` and `${NAME:-default}` replaced by environment variables. An empty variable counts as unset. A default
/// can't contain `}` or another variable; an unclosed `${` stays as it is.
///
/// # Errors
/// Returns an error if a variable is unset and has no default.
pub fn expand_path(text: &str) -> Result<PathBuf> {
    expand(text, |name| std::env::var_os(name)).map(PathBuf::from)
}

/// Returns `text` with variables replaced by the values that `lookup` returns.
fn expand(text: &str, lookup: impl Fn(&str) -> Option<OsString>) -> Result<OsString> {
    let (mut expanded, mut rest) = (OsString::new(), text);
    while let Some((before, opened)) = rest.split_once("${") {
        let Some((inside, after)) = opened.split_once('}') else { break };
        let (name, default) = match inside.split_once(":-") {
            Some((name, default)) => (name, Some(OsString::from(default))),
            None => (inside, None),
        };
        let value = lookup(name).filter(|value| !value.is_empty()).or(default);
        let value = value.ok_or_else(|| {
            Error::request(format!(
                "{text}: the environment variable {name} is unset or empty, \
                 expected a value or a default, as in ${{NAME:-DEFAULT}}"
            ))
        })?;
        expanded.push(before);
        expanded.push(value);
        rest = after;
    }
    expanded.push(rest);
    Ok(expanded)
}

/// Returns the possible splits of `path` into a file and a key, one for each `#` in it from the first on: keys and folders may contain the
/// sign too. Keys are text; bytes that aren't UTF-8 are replaced.
pub fn split_keyed_path(path: &Path) -> impl DoubleEndedIterator<Item = (PathBuf, String)> {
    let bytes = path.as_os_str().as_encoded_bytes();
    let signs = (0..bytes.len()).filter(move |&at| bytes[at] == b'#');
    signs.map(move |at| {
        // SAFETY: encoded bytes may be split beside a character of ASCII.
        let file = PathBuf::from(unsafe { OsStr::from_encoded_bytes_unchecked(&bytes[..at]) });
        (file, String::from_utf8_lossy(&bytes[at + 1..]).into_owned())
    })
}

/// Returns the path of `file` relative to `folder`, in which it lies, with `/` as the separator on every system, as captures name their
/// photos. Bytes that aren't UTF-8 are replaced.
pub fn relative_name(file: &Path, folder: &Path) -> String {
    let name = file.strip_prefix(folder).unwrap_or(file).to_string_lossy();
    // On Unix, a name may contain a `\`.
    name.replace(MAIN_SEPARATOR_STR, "/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_and_defaults_are_expanded() {
        let lookup = |name: &str| match name {
            "DATA" => Some("/mnt/data".into()),
            "EMPTY" => Some("".into()),
            _ => None,
        };
        for (text, expected) in [
            ("", Ok("")),
            ("data/re10k", Ok("data/re10k")),
            ("${DATA}/re10k", Ok("/mnt/data/re10k")),
            ("a${DATA}b${DATA}c", Ok("a/mnt/datab/mnt/datac")),
            ("${DATA:-data}/${EMPTY:-re10k}/${UNSET:-}x", Ok("/mnt/data/re10k/x")),
            ("${DATA}/${DATA", Ok("/mnt/data/${DATA")),
            ("$DATA/{x}", Ok("$DATA/{x}")),
            ("data/${DATA}/x/${UNSET}/y", Err("UNSET")),
            ("${DATA}${EMPTY}", Err("EMPTY")),
        ] {
            let refused = |name| {
                format!(
                    "{text}: the environment variable {name} is unset or empty, \
                     expected a value or a default, as in ${{NAME:-DEFAULT}}"
                )
            };
            let found = expand(text, lookup).map_err(|e| e.to_string());
            assert_eq!(found, expected.map(OsString::from).map_err(refused), "{text}");
        }
    }
}
