//! The library's error type, that of the crates that read and write files; every message is one sentence.

pub use globalsplat_files::{Error, Result, panic_message};
