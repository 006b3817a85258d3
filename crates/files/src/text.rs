//! Reading of text files that other programs wrote.

use crate::{Error, Result};
use std::path::Path;

/// Reads a UTF-8 file. A byte order mark at its start, which Windows programs may write, is left out.
///
/// # Errors
/// Returns an error if the file can't be read or isn't UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    let text = std::fs::read_to_string(path).map_err(Error::read(path))?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(text) => text.to_string(),
        None => text,
    })
}
