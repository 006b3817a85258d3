//! Paths of the form `FILE#KEY`: a file, and the key of an entry in it.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// Returns the possible splits of `path` into a file and a key, one for each `#` in it from the first on: keys and folders may contain the
/// sign too. Keys are text; bytes that aren't UTF-8 are replaced.
pub fn split_keyed_path(path: &Path) -> impl DoubleEndedIterator<Item = (PathBuf, String)> {
    let bytes = path.as_os_str().as_bytes();
    let signs = (0..bytes.len()).filter(move |&at| bytes[at] == b'#');
    signs.map(move |at| {
        let file = PathBuf::from(OsStr::from_bytes(&bytes[..at]));
        (file, String::from_utf8_lossy(&bytes[at + 1..]).into_owned())
    })
}
