//! Arrays in NumPy's .npy format.

use super::write_atomically;
use crate::error::{Error, Result};
use npyz::WriterBuilder;
use std::path::Path;

/// Writes `values`, in row-major order, as a float32 array of shape `shape`.
///
/// # Errors
/// Returns an error if the file can't be written.
pub fn write_npy(path: &Path, shape: &[u64], values: &[f32]) -> Result<()> {
    write_atomically(path, |writer| {
        let write = || {
            let mut npy = npyz::WriteOptions::new().default_dtype().shape(shape).writer(writer).begin_nd()?;
            npy.extend(values)?;
            npy.finish()
        };
        write().map_err(Error::write(path))
    })
}
