//! `FILE#KEY`: a file, and the key of something in it.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// Returns what `path` may mean, a file and a key, for each `#` in it from the first on: keys may have the sign, too, and so may
/// folders. Keys are text; what isn't UTF-8 in them is replaced.
pub fn files_and_keys(path: &Path) -> impl DoubleEndedIterator<Item = (PathBuf, String)> {
    let bytes = path.as_os_str().as_bytes();
    let signs = (0..bytes.len()).filter(move |&at| bytes[at] == b'#');
    signs.map(move |at| {
        let file = PathBuf::from(OsStr::from_bytes(&bytes[..at]));
        (file, String::from_utf8_lossy(&bytes[at + 1..]).into_owned())
    })
}
