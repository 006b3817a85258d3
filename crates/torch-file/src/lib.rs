#![doc = include_str!("../README.md")]

mod archive;
mod array;
mod dtype;
mod globals;
mod legacy;
mod pickle;
mod value;
mod write;

pub use archive::Archive;
pub use array::{Array, row_major};
pub use dtype::Dtype;
pub use globalsplat_files::{Error, Result};
pub use pickle::{UnknownGlobals, unpickle};
pub use value::{Id, Rebuild, Value, Values};
pub use write::{TensorView, write_checkpoint};

use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Byte ranges of tensors' storages in a file, by the keys under which its pickle refers to them.
pub type Storages = HashMap<String, Range<usize>>;

/// Contents of a file that `torch.save` wrote, in the zip format or the legacy one. Values of unknown types are kept as [`Value`]s.
#[derive(Debug)]
pub struct TorchFile<'a> {
    /// Values of the pickle.
    pub values: Values<'a>,
    /// Byte ranges of the tensors' storages in the file.
    pub storages: Storages,
}

/// Returns `true` if `bytes`, the contents of a file, begin like a file that `torch.save` wrote, in the zip format or in the format before
/// torch 1.6. The result is `true` for any zip archive, because only the first bytes are examined.
pub fn is_torch_file(bytes: &[u8]) -> bool {
    bytes.starts_with(archive::MAGIC) || legacy::is_legacy_file(bytes)
}

impl<'a> TorchFile<'a> {
    /// Parses `bytes`, the contents of `file`; the path only serves for error messages. Nothing in the file is executed, and no size that
    /// it states is trusted.
    ///
    /// # Errors
    /// Returns an error if `torch.save` didn't write the file, if the file is damaged, or if Python would call a function to load it that
    /// isn't known to only assemble data.
    pub fn parse(file: &Path, bytes: &'a [u8]) -> Result<Self> {
        let expected = "numbers, strings and tensors, as in a checkpoint that runs nothing; nothing was run";
        let refuse = |found: String| Error::input(file, "the pickle", found, expected);
        if legacy::is_legacy_file(bytes) {
            return legacy::parse(bytes).map_err(refuse);
        }
        let Archive { pickle, storages } = Archive::parse(file, bytes)?;
        let values = unpickle(&mut &bytes[pickle], UnknownGlobals::Keep).map_err(refuse)?;
        Ok(TorchFile { values, storages })
    }
}
