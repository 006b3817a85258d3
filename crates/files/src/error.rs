//! The error type of the crates that read and write files; every message is one sentence.

use std::any::Any;
use std::error::Error as StdError;
use std::path::{Path, PathBuf};

/// Result type of the crates that read and write files.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Error of reading, checking or writing files. [`Error::is_invalid_request`] distinguishes an invalid request from work that failed.
///
/// `Display` shows one sentence with all causes: the text of a [`source`](StdError::source) is part of the message.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
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
    /// Invalid setting.
    #[error("{name} is {found}, expected {expected}")]
    Setting {
        /// Name of the setting.
        name: String,
        /// Its value.
        found: String,
        /// Value or values that were expected.
        expected: String,
    },
    /// Invalid argument, or invalid combination of arguments, that isn't a single setting.
    #[error("{message}")]
    Request {
        /// Description of the mistake, in one sentence.
        message: String,
    },
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
    #[error("{message}")]
    Failed {
        /// Description of the failed work and the reason, in one sentence.
        message: String,
        /// Error that caused the failure, if another library reported one.
        source: Option<Box<dyn StdError + Send + Sync>>,
    },
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

    /// Returns an [`Error::Setting`]: the setting `name` is `found`, expected `expected`.
    pub fn setting(
        name: impl std::fmt::Display,
        found: impl std::fmt::Display,
        expected: impl std::fmt::Display,
    ) -> Self {
        let (name, found, expected) = (name.to_string(), found.to_string(), expected.to_string());
        Error::Setting { name, found, expected }
    }

    /// Returns an [`Error::Request`].
    pub fn request(message: impl Into<String>) -> Self {
        Error::Request { message: message.into() }
    }

    /// Returns an [`Error::Failed`] that no other error caused.
    pub fn failed(message: impl Into<String>) -> Self {
        Error::Failed { message: message.into(), source: None }
    }

    /// Returns an [`Error::Failed`] with the message of an error of another library.
    pub fn external(source: impl StdError + Send + Sync + 'static) -> Self {
        Error::Failed { message: source.to_string(), source: Some(Box::new(source)) }
    }

    /// Returns a closure for `map_err` that wraps an error as [`Error::Failed`] with the message "`context`: error".
    pub fn failed_with_context<E: StdError + Send + Sync + 'static>(
        context: impl std::fmt::Display,
    ) -> impl FnOnce(E) -> Self {
        move |source| Error::Failed {
            message: format!("{context}: {source}"),
            source: Some(Box::new(source)),
        }
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

    /// Returns `true` if a file could not be written.
    pub fn is_failed_write(&self) -> bool {
        matches!(self, Error::Write { .. })
    }

    /// Returns `true` if the request was invalid (exit code 2), `false` if the work failed (exit code 1).
    pub fn is_invalid_request(&self) -> bool {
        match self {
            Error::Input { .. } | Error::Setting { .. } | Error::Request { .. } => true,
            // The file itself is fine if there was too little memory to map it.
            Error::Read { source, .. } => source.kind() != std::io::ErrorKind::OutOfMemory,
            Error::Write { .. } | Error::Failed { .. } => false,
        }
    }
}

/// Returns the message of a panic, cut to its first line because libtorch appends stack traces to its messages.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("an unknown reason");
    text.lines().next().unwrap_or(text)
}

/// Returns `true` if `error`, of starting a program by its name, means that no folder of the PATH contains the program.
///
/// Without permission to enter one of the folders, the operating system reports a lack of permission, even if no other folder contains the
/// program.
pub fn is_program_missing(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{NotFound, PermissionDenied};
    matches!(error.kind(), NotFound | PermissionDenied)
}
