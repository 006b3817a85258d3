//! NumPy arrays.

use globalsplat_files::{Error, Result};
use npyz::{NpyFile, Order};
use std::path::Path;

/// Reads a NumPy array of float32 or float64, and returns its shape and its numbers, the last index first.
///
/// # Errors
/// Fails if the file can't be read, or if it has other numbers or Fortran's order.
pub fn read_npy(file: &Path) -> Result<(Vec<usize>, Vec<f64>)> {
    let bytes = std::fs::read(file).map_err(Error::read(file))?;
    let size = bytes.len() as u64;
    // Nothing is allocated for a header or numbers that aren't there. Since version 2 of the format, the header's length has 32 bits.
    if let [_, _, _, _, _, _, 2..=u8::MAX, _, length @ ..] = &bytes[..]
        && let Some(length) = length.first_chunk().map(|length| u32::from_le_bytes(*length))
        && u64::from(length) > size
    {
        return Err(Error::input(file, "the header", format!("{length} bytes"), format!("at most {size}")));
    }
    let npy = NpyFile::new(&bytes[..]).map_err(Error::read(file))?;
    let shape: Vec<usize> = npy.shape().iter().map(|&side| side as usize).collect();
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
