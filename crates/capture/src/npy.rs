//! NumPy arrays.

use globalsplat_files::{Error, Result};
use npyz::{NpyFile, Order};
use std::fs::File;
use std::path::Path;

/// Reads a NumPy array of float32 or float64, and returns its shape and its numbers, the last index first.
///
/// # Errors
/// Fails if the file can't be read, or if it has other numbers or Fortran's order.
pub fn read_npy(file: &Path) -> Result<(Vec<usize>, Vec<f64>)> {
    let opened = File::open(file).map_err(Error::read(file))?;
    let size = opened.metadata().map_err(Error::read(file))?.len();
    let npy = NpyFile::new(opened).map_err(Error::read(file))?;
    let shape: Vec<usize> = npy.shape().iter().map(|&side| side as usize).collect();
    // Nothing is allocated for numbers that aren't there.
    if shape.iter().fold(4u64, |bytes, &side| bytes.saturating_mul(side as u64)) > size {
        let expected = format!("one whose numbers fit into the file's {size} bytes");
        return Err(Error::input(file, "the shape", format!("{shape:?}"), expected));
    }
    if npy.header().order() == Order::Fortran {
        return Err(Error::input(file, "the order", "Fortran's", "C's, the last index first"));
    }
    let numbers = match npy.dtype().descr().ends_with("f8'") {
        true => npy.into_vec::<f64>(),
        false => npy.into_vec::<f32>().map(|numbers| numbers.into_iter().map(f64::from).collect()),
    };
    Ok((shape, numbers.map_err(Error::read(file))?))
}
