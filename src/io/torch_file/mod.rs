//! Reader and writer for files of torch.save, without torch: a pickle, and the bytes of the tensors that it describes. Nothing that a file
//! contains is executed, and none of its sizes is trusted (spec 10.16).

mod archive;
mod array;
mod globals;
mod legacy;
mod pickle;
mod value;
mod write;

pub(crate) use archive::Archive;
pub(crate) use array::{Array, row_major};
pub(crate) use pickle::{UnknownGlobals, unpickle};
pub(crate) use value::{Id, Value, Values};
pub use write::write_checkpoint;

use crate::error::{Error, Result};
use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Byte ranges of tensors' storages in a file, by the keys under which its pickle refers to them.
pub(crate) type Storages = HashMap<String, Range<usize>>;

/// Contents of a file in either format. Values of unknown types beside the tensors are kept.
#[derive(Debug)]
pub(crate) struct TorchFile<'a> {
    pub values: Values<'a>,
    pub storages: Storages,
}

impl<'a> TorchFile<'a> {
    /// Returns `true` if `bytes` begin like a file of torch.save, in the current format or in that before torch 1.6.
    pub fn is_one(bytes: &[u8]) -> bool {
        bytes.starts_with(archive::MAGIC) || legacy::is_one(bytes)
    }

    /// Parses `bytes`, the contents of `file`.
    ///
    /// # Errors
    /// Returns an error if the file is damaged, or if it would run code in Python.
    pub fn parse(file: &Path, bytes: &'a [u8]) -> Result<Self> {
        let expected = "numbers, strings and tensors, as in a checkpoint that runs nothing; nothing was run";
        let refuse = |found: String| Error::input(file, "the pickle", found, expected);
        if legacy::is_one(bytes) {
            return legacy::parse(bytes).map_err(refuse);
        }
        let Archive { pickle, storages } = Archive::open(file, bytes)?;
        let values = unpickle(&mut &bytes[pickle], UnknownGlobals::Kept).map_err(refuse)?;
        Ok(TorchFile { values, storages })
    }
}
