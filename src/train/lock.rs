//! Lock that limits a run's folder to one training process. Two processes would overwrite each other's checkpoints.

use crate::error::{Error, Result};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Write};
use std::path::Path;

const FILE: &str = ".lock";

/// Lock on a run's folder. It is released when it is dropped, or when the process ends for any reason.
#[derive(Debug)]
pub(super) struct RunLock {
    _file: File,
}

impl RunLock {
    /// Returns `true` if a run ever locked the folder `run`.
    pub(super) fn was_ever_locked(run: &Path) -> bool {
        run.join(FILE).exists()
    }

    /// Locks the folder `run`, which must exist.
    ///
    /// # Errors
    /// Returns an error that gives the ID of the other process if the folder is locked.
    pub(super) fn take(run: &Path) -> Result<Self> {
        let path = run.join(FILE);
        let options = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = options.map_err(Error::write(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = file.read_to_string(&mut holder);
                let found = format!("in use by process {}", holder.trim());
                return Err(Error::input(
                    run,
                    "the run",
                    found,
                    "a run that no other process trains (choose another --out)",
                ));
            }
            Err(TryLockError::Error(e)) => return Err(Error::write(&path)(e)),
        }
        let written = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
        written.map_err(Error::write(&path))?;
        Ok(RunLock { _file: file })
    }
}
