//! Files that grow by whole records.

use super::atomic::check_regular;
use crate::error::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// A file that records are added to; one that can't be written, as on a full disk, leaves no part of itself.
#[derive(Debug)]
pub struct AppendFile {
    path: PathBuf,
    file: File,
    /// Of whole records, in bytes.
    length: u64,
}

impl AppendFile {
    /// Opens the file at `path` to go on at its end, or makes it.
    ///
    /// # Errors
    /// Anything but a regular file there, or the system's refusal.
    pub fn open(path: &Path) -> Result<Self> {
        check_regular(path)?;
        let file = OpenOptions::new().create(true).append(true).open(path).map_err(Error::write(path))?;
        let length = file.metadata().map_err(Error::read(path))?.len();
        Ok(AppendFile { path: path.to_owned(), file, length })
    }

    /// Adds `record`. After an error it may be tried again.
    ///
    /// # Errors
    /// The system's refusal to write.
    pub fn append(&mut self, record: &[u8]) -> Result<()> {
        // Before, in case that what was left of an earlier one couldn't be taken away after it.
        if let Err(e) = self.file.set_len(self.length).and_then(|()| self.file.write_all(record)) {
            let _ = self.file.set_len(self.length);
            return Err(Error::write(&self.path)(e));
        }
        self.length += record.len() as u64;
        Ok(())
    }
}
