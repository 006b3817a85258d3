//! The library's error type, which is that of [`globalsplat_files`]; every message is one sentence.

pub use globalsplat_files::{Error, Result, panic_message};
