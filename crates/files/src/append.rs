//! Files to which whole records are appended.

use super::atomic::check_regular;
use crate::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// A file to which records are appended. If a record can't be written, for example because the disk is full, no part of it stays in the
/// file.
#[derive(Debug)]
pub struct AppendFile {
    path: PathBuf,
    file: File,
    /// Length of the whole records, in bytes.
    length: u64,
}

impl AppendFile {
    /// Opens the file at `path` to append to it, or creates it.
    ///
    /// # Errors
    /// Returns an error if something other than a regular file is at `path`, or if the file can't be opened.
    pub fn open(path: &Path) -> Result<Self> {
        check_regular(path)?;
        let file = OpenOptions::new().create(true).append(true).open(path).map_err(Error::write(path))?;
        let length = file.metadata().map_err(Error::read(path))?.len();
        Ok(AppendFile { path: path.to_owned(), file, length })
    }

    /// Removes what follows the first `length` bytes, the end of the last whole record.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn truncate(&mut self, length: u64) -> Result<()> {
        self.length = length;
        self.file.set_len(length).map_err(Error::write(&self.path))
    }

    /// Appends `record`.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn append(&mut self, record: &[u8]) -> Result<()> {
        if let Err(e) = self.file.write_all(record) {
            let _ = self.file.set_len(self.length);
            return Err(Error::write(&self.path)(e));
        }
        self.length += record.len() as u64;
        Ok(())
    }
}
