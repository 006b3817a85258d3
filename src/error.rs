//! What can go wrong, told in one sentence.

use std::any::Any;
use std::path::{Path, PathBuf};

/// The library's result.
pub type Result<T> = std::result::Result<T, Error>;

/// What a panic says of itself, on one line: libtorch appends stack traces to its messages.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("an unknown reason");
    text.lines().next().unwrap_or(text)
}

/// Has libtorch's errors, from now on and in the whole process, carry no stack trace. It is taken for every error, and kills the
/// process where memory is short.
pub fn leave_out_stack_traces() {
    globalsplat_csrc::render::leave_out_stack_traces();
}

/// Every failure of the library. [`Error::is_request`] tells a wrong request from work that failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file holds something that can't be used.
    #[error("{}: {field} is {found}, expected {expected}", .file.display())]
    Input {
        /// The file.
        file: PathBuf,
        /// Where in the file, in the file's own words.
        field: String,
        /// What stands there.
        found: String,
        /// What could stand there.
        expected: String,
    },
    /// An argument, or a combination of arguments, that can't be met.
    #[error("{0}")]
    Request(String),
    /// The operating system refused to read.
    #[error("{} can't be read: {source}", .path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's own words.
        source: std::io::Error,
    },
    /// The operating system refused to write.
    #[error("{} can't be written: {source}", .path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's own words.
        source: std::io::Error,
    },
    /// Work that was under way failed.
    #[error("{0}")]
    Failed(String),
    /// Processes that work together can't any more: almost always because one of them is gone.
    #[error("the processes have lost each other ({0}); started again, they go on from what was saved")]
    Ranks(String),
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// The C++ side refused an operation.
    #[error("{0}")]
    Cpp(#[from] cxx::Exception),
}

impl Error {
    /// `file`: `field` is `found`, expected `expected`.
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

    /// The setting `field` is `found`, expected `expected`.
    pub fn setting(
        field: impl std::fmt::Display,
        found: impl std::fmt::Display,
        expected: impl std::fmt::Display,
    ) -> Self {
        Error::Request(format!("{field} is {found}, expected {expected}"))
    }

    /// For `map_err` on reading.
    pub fn read(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Error::Read { path, source }
    }

    /// For `map_err` on writing.
    pub fn write(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Error::Write { path, source }
    }

    /// Whether writing failed for want of room, which may come.
    pub fn is_disk_full(&self) -> bool {
        use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
        matches!(self, Error::Write { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded | FileTooLarge))
    }

    /// Whether the request was wrong (exit code 2) rather than the work having failed (exit code 1).
    pub fn is_request(&self) -> bool {
        match self {
            Error::Input { .. } | Error::Request(_) => true,
            // A file for which there is no room to be mapped is all right.
            Error::Read { source, .. } => source.kind() != std::io::ErrorKind::OutOfMemory,
            _ => false,
        }
    }
}
