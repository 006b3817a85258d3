//! Work of the library on behalf of Python.

use crate::error::to_python;
use globalsplat::Result;
use globalsplat_files::panic_message;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Runs `work` while other Python threads run. Errors of libtorch that the library doesn't expect arrive as panics, and become exceptions
/// as well.
pub fn run<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    let done = py.detach(|| {
        catch_unwind(AssertUnwindSafe(work)).map_err(|panic| panic_message(panic.as_ref()).to_string())
    });
    match done {
        Ok(result) => result.map_err(to_python),
        Err(message) => Err(PyRuntimeError::new_err(format!("internal error (please report): {message}"))),
    }
}
