//! Programs that other commands start.

use std::io::{Error, ErrorKind};

/// Returns `true` if `error`, of starting a program by its name, means that no folder of the PATH contains the program.
///
/// Without permission to enter one of the folders, the operating system reports a lack of permission, even if no other folder contains the
/// program.
pub fn is_program_missing(error: &Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::PermissionDenied)
}
