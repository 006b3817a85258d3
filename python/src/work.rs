//! Work of the library on behalf of Python.

use crate::error::to_python;
use globalsplat::{Error, Result};
use globalsplat_files::panic_message;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rayon::ThreadPoolBuilder;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;

/// Runs `work` while other Python threads run. Errors of libtorch that the library doesn't expect arrive as panics, and become exceptions
/// as well.
pub fn run<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    let done = py.detach(|| {
        catch_unwind(AssertUnwindSafe(|| in_process(work)))
            .map_err(|panic| panic_message(panic.as_ref()).to_string())
    });
    match done {
        Ok(result) => result.map_err(to_python),
        Err(message) => Err(PyRuntimeError::new_err(format!("internal error (please report): {message}"))),
    }
}

/// Runs `work` on threads of this process. A process that was forked from another one, as a worker of PyTorch's `DataLoader` is, has none
/// of the threads of rayon's global pool, and would wait for them forever: it gets a pool for this call.
fn in_process<T: Send>(work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    static OWNER_OF_GLOBAL_POOL: OnceLock<u32> = OnceLock::new();
    let process = std::process::id();
    if *OWNER_OF_GLOBAL_POOL.get_or_init(|| process) == process {
        return work();
    }
    let pool = ThreadPoolBuilder::new().num_threads(tch::get_num_threads() as usize).build();
    pool.map_err(Error::failed_with_context("threads can't be started"))?.install(work)
}
