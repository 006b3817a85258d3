//! Reading of text that other programs wrote, and checksums of the contents of files.

use crate::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Reads a UTF-8 file. A byte order mark at its start, which Windows programs may write, is left out.
///
/// # Errors
/// Returns an error if the file can't be read or isn't UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    let text = std::fs::read_to_string(path).map_err(Error::read(path))?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(text) => text.to_string(),
        None => text,
    })
}

/// Number of bytes that are read at a time.
const BUFFER: usize = 1 << 20;

/// Computes the CRC-32 of the contents of `files`, one after the other, without holding any of them in memory.
///
/// # Errors
/// Returns an error if a file can't be read.
pub fn checksum(files: impl IntoIterator<Item = impl AsRef<Path>>) -> Result<u32> {
    let (mut hasher, mut buffer) = (crc32fast::Hasher::new(), vec![0; BUFFER]);
    for path in files {
        let read = Error::read(path.as_ref());
        let mut file = match File::open(&path) {
            Ok(file) => file,
            Err(e) => return Err(read(e)),
        };
        loop {
            match file.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => hasher.update(&buffer[..count]),
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(read(e)),
            }
        }
    }
    Ok(hasher.finalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksum_covers_all_files_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
        let bytes: Vec<u8> = (0..2 * BUFFER + 3).map(|i| (i % 251) as u8).collect();
        std::fs::write(&a, &bytes).unwrap();
        std::fs::write(&b, "end").unwrap();
        let all = [bytes.as_slice(), b"end"].concat();
        assert_eq!(checksum([&a, &b]).unwrap(), crc32fast::hash(&all));
        assert_ne!(checksum([&b, &a]).unwrap(), crc32fast::hash(&all));
        assert!(checksum([folder.path().join("c")]).is_err());
    }
}
