//! What an opened input left out or changed.

/// Prints each of `lines` on standard error.
pub fn warn(lines: &[String]) {
    lines.iter().for_each(|line| eprintln!("{line}"));
}
