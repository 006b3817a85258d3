//! Arrays as NumPy's .npy files.

use super::write_atomically;
use crate::error::{Error, Result};
use npyz::WriterBuilder;
use std::path::Path;

/// Writes `values`, row by row, as a float32 array of that shape.
///
/// # Errors
/// The system's refusal to write.
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
