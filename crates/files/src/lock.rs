//! Locks of folders, by which several processes don't write to one at the same time.

use crate::{Error, Result};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Write};
use std::path::Path;

/// Name of the file in a folder that its user locks.
const LOCK_FILE: &str = ".lock";

/// Lock that limits a folder to one process. It is released when it is dropped, or when the process ends for any reason.
#[derive(Debug)]
pub struct FolderLock {
    _file: File,
}

impl FolderLock {
    /// Returns `true` if a process ever locked `folder`.
    pub fn was_ever_taken(folder: &Path) -> bool {
        folder.join(LOCK_FILE).exists()
    }

    /// Locks `folder`, which must exist. Returns the ID of the other process if it is locked.
    ///
    /// # Errors
    /// Returns an error if the lock's file can't be written.
    pub fn try_take(folder: &Path) -> Result<Result<Self, String>> {
        let path = folder.join(LOCK_FILE);
        let options = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = options.map_err(Error::write(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = file.read_to_string(&mut holder);
                return Ok(Err(holder.trim().into()));
            }
            Err(TryLockError::Error(e)) => return Err(Error::write(&path)(e)),
        }
        let written = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
        written.map_err(Error::write(&path))?;
        Ok(Ok(FolderLock { _file: file }))
    }
}
