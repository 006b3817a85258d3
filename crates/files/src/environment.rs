//! Expansion of environment variables in paths of a configuration.

use crate::{Error, Result};
use std::ffi::OsString;
use std::path::PathBuf;

/// Returns the path that `text` names, with `${NAME}` and `${NAME:-default}` expanded. An empty variable counts as unset.
///
/// # Errors
/// Returns an error if a variable is unset and has no default.
pub fn expand_path(text: &str) -> Result<PathBuf> {
    expand(text).map(PathBuf::from)
}

fn expand(text: &str) -> Result<OsString> {
    let Some((before, rest)) = text.split_once("${") else { return Ok(text.into()) };
    let Some((inside, after)) = rest.split_once('}') else { return Ok(text.into()) };
    let (name, default) = match inside.split_once(":-") {
        Some((name, default)) => (name, Some(OsString::from(default))),
        None => (inside, None),
    };
    let value = std::env::var_os(name).filter(|v| !v.is_empty()).or(default);
    let value = value.ok_or_else(|| {
        Error::request(format!(
            "{text}: the environment variable {name} is not set, expected it or a path in its place"
        ))
    })?;
    Ok([before.into(), value, expand(after)?].into_iter().collect())
}
