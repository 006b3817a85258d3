//! The library's error type; every message is one sentence.

use std::error::Error as StdError;
use std::path::Path;

pub use globalsplat_files::panic_message;

/// Result type of the library.
pub type Result<T> = std::result::Result<T, Error>;

/// Error of the library. [`Error::is_invalid_request`] distinguishes an invalid request from work that failed.
///
/// `Display` shows one sentence with all causes: the text of a [`source`](StdError::source) is part of the message.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Invalid file or setting, or a failed read, write or computation.
    #[error(transparent)]
    Files(#[from] globalsplat_files::Error),
    /// Failed communication with the other processes, almost always because one of them has ended.
    #[error(
        "distributed communication failed ({message}); restart the processes to resume from the last checkpoint"
    )]
    Distributed {
        /// Description of the exchange and of the reason for its failure.
        message: String,
    },
    /// Error of libtorch.
    #[error("libtorch: {0}")]
    Torch(Box<dyn StdError + Send + Sync>),
    /// Error of the C++ ops.
    #[error("{0}")]
    Cpp(Box<dyn StdError + Send + Sync>),
}

impl From<tch::TchError> for Error {
    fn from(source: tch::TchError) -> Self {
        Error::Torch(Box::new(source))
    }
}

impl From<cxx::Exception> for Error {
    fn from(source: cxx::Exception) -> Self {
        Error::Cpp(Box::new(source))
    }
}

impl Error {
    /// Returns the error of an invalid file: in `file`, `field` is `found`, expected `expected`.
    pub fn input(
        file: impl AsRef<Path>,
        field: impl Into<String>,
        found: impl std::fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        globalsplat_files::Error::input(file, field, found, expected).into()
    }

    /// Returns the error of an invalid setting: `name` is `found`, expected `expected`.
    pub fn setting(
        name: impl std::fmt::Display,
        found: impl std::fmt::Display,
        expected: impl std::fmt::Display,
    ) -> Self {
        globalsplat_files::Error::setting(name, found, expected).into()
    }

    /// Returns the error of an invalid request that isn't a single setting.
    pub fn request(message: impl Into<String>) -> Self {
        globalsplat_files::Error::request(message).into()
    }

    /// Returns the error of work that failed.
    pub fn failed(message: impl Into<String>) -> Self {
        globalsplat_files::Error::failed(message).into()
    }

    /// Returns a closure for `map_err` that wraps an error as [`globalsplat_files::Error::Failed`] with the message "`context`: error".
    pub fn failed_with_context<E: StdError + Send + Sync + 'static>(
        context: impl std::fmt::Display,
    ) -> impl FnOnce(E) -> Self {
        move |source| globalsplat_files::Error::failed_with_context(context)(source).into()
    }

    /// Returns a closure for `map_err` that wraps an I/O error of reading `path`.
    pub fn read(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| globalsplat_files::Error::read(path)(source).into()
    }

    /// Returns a closure for `map_err` that wraps an I/O error of writing `path`.
    pub fn write(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| globalsplat_files::Error::write(path)(source).into()
    }

    /// Returns `true` if a file could not be written.
    pub fn is_failed_write(&self) -> bool {
        matches!(self, Error::Files(globalsplat_files::Error::Write { .. }))
    }

    /// Returns `true` if the communication with the other processes failed.
    pub fn is_distributed(&self) -> bool {
        matches!(self, Error::Distributed { .. })
    }

    /// Returns `true` if the request was invalid (exit code 2), `false` if the work failed (exit code 1).
    pub fn is_invalid_request(&self) -> bool {
        matches!(self, Error::Files(error) if error.is_invalid_request())
    }
}
