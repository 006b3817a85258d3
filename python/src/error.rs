//! Python exceptions for the errors of the library.

use globalsplat::Error;
use pyo3::PyErr;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyRuntimeError, PyValueError};
use std::io::ErrorKind;

/// Converts an error to an exception with the same sentence: `OSError` if a file can't be read or written, `ValueError` for an invalid
/// file, setting or request, `RuntimeError` for work that failed.
pub fn to_python(error: Error) -> PyErr {
    let message = error.to_string();
    match &error {
        Error::Read { source, .. } if source.kind() == ErrorKind::NotFound => {
            PyFileNotFoundError::new_err(message)
        }
        Error::Read { .. } | Error::Write { .. } => PyOSError::new_err(message),
        _ if error.is_invalid_request() => PyValueError::new_err(message),
        _ => PyRuntimeError::new_err(message),
    }
}
