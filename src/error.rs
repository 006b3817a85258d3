//! The library's error type; every message is one sentence.

use std::any::Any;
use std::path::{Path, PathBuf};

/// Result type of the library.
pub type Result<T> = std::result::Result<T, Error>;

/// Returns the message of a panic, cut to its first line because libtorch appends stack traces to its messages.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("an unknown reason");
    text.lines().next().unwrap_or(text)
}

/// Disables stack traces in libtorch's errors for the rest of the process. libtorch captures one for every error, and that
/// kills the process when memory is short.
pub fn leave_out_stack_traces() {
    globalsplat_csrc::render::leave_out_stack_traces();
}

/// Error of the library. [`Error::is_request`] tells a wrong request from work that failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Invalid value in a file.
    #[error("{}: {field} is {found}, expected {expected}", .file.display())]
    Input {
        /// Path of the file.
        file: PathBuf,
        /// Field of the file, in the words of its format.
        field: String,
        /// Value found there.
        found: String,
        /// Value or values that were expected.
        expected: String,
    },
    /// Invalid argument, or invalid combination of arguments.
    #[error("{0}")]
    Request(String),
    /// Failed read of a file or folder.
    #[error("{} can't be read: {source}", .path.display())]
    Read {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Failed write of a file or folder.
    #[error("{} can't be written: {source}", .path.display())]
    Write {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Failure of work after it had started.
    #[error("{0}")]
    Failed(String),
    /// Failed communication with the other processes, almost always because one of them has ended.
    #[error(
        "distributed communication failed ({0}); restart the processes to resume from the last checkpoint"
    )]
    Ranks(String),
    /// Error reported by libtorch.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// Error reported by the C++ side.
    #[error("{0}")]
    Cpp(#[from] cxx::Exception),
}

impl Error {
    /// Returns an [`Error::Input`]: in `file`, `field` is `found`, expected `expected`.
    pub fn input(
        file: impl AsRef<Path>,
        field: impl Into<String>,
        found: impl std::fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Error::Input {
            file: file.as_ref().to_owned(),
            field: field.into(),
            found: found.to_string(),
            expected: expected.into(),
        }
    }

    /// Returns an [`Error::Request`]: the setting `field` is `found`, expected `expected`.
    pub fn setting(
        field: impl std::fmt::Display,
        found: impl std::fmt::Display,
        expected: impl std::fmt::Display,
    ) -> Self {
        Error::Request(format!("{field} is {found}, expected {expected}"))
    }

    /// Returns a closure for `map_err` that wraps an I/O error in [`Error::Read`].
    pub fn read(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Error::Read { path, source }
    }

    /// Returns a closure for `map_err` that wraps an I/O error in [`Error::Write`].
    pub fn write(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Error::Write { path, source }
    }

    /// Returns `true` if a write failed because the disk was full, which may be temporary.
    pub fn is_disk_full(&self) -> bool {
        use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
        matches!(self, Error::Write { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded | FileTooLarge))
    }

    /// Returns `true` if the request was wrong (exit code 2), `false` if the work failed (exit code 1).
    pub fn is_request(&self) -> bool {
        match self {
            Error::Input { .. } | Error::Request(_) => true,
            // The file itself is fine if there was too little memory to map it.
            Error::Read { source, .. } => source.kind() != std::io::ErrorKind::OutOfMemory,
            _ => false,
        }
    }
}
