#![doc = include_str!("../README.md")]

mod archive;
mod array;
mod pickle;
mod write;

pub use array::{Array, row_major};
pub use globalsplat_files::{Error, Result};
pub use pickle::{Id, Value, Values};
pub use safetensors::Dtype;
pub use safetensors::tensor::TensorView;
pub use write::{Item, serialize, write_checkpoint};

use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Byte ranges of tensors' storages in a file, by the keys under which its pickle refers to them.
pub type Storages = HashMap<String, Range<usize>>;

/// Contents of a file that `torch.save` wrote. Values of unknown types are kept as [`Value`]s.
#[derive(Debug)]
pub struct TorchFile<'a> {
    /// Values of the pickle.
    pub values: Values<'a>,
    /// Byte ranges of the tensors' storages in the file.
    pub storages: Storages,
}

/// Returns `true` if `bytes`, the contents of a file, begin like a file that `torch.save` wrote. The result is `true` for any zip archive,
/// because only the first bytes are examined.
pub fn is_torch_file(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04")
}

impl<'a> TorchFile<'a> {
    /// Parses `bytes`, the contents of `file`; the path only serves for error messages. Nothing in the file is executed, and no size that
    /// it states is trusted.
    ///
    /// # Errors
    /// Returns an error if `torch.save` didn't write the file, if the file is damaged, or if Python would call a function to load it that
    /// isn't known to only assemble data.
    pub fn parse(file: &Path, bytes: &'a [u8]) -> Result<Self> {
        let (pickle, storages) = archive::find_parts(file, bytes)?;
        let expected = "numbers, strings and tensors, as in a checkpoint that runs nothing; nothing was run";
        let values = pickle::unpickle(&bytes[pickle])
            .map_err(|found| Error::input(file, "the pickle", found, expected))?;
        Ok(TorchFile { values, storages })
    }
}
