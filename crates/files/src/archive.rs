//! ZIP archives of files that can't be compressed further.

use std::io::{Cursor, Write};
use zip::write::{FileOptions, ZipWriter};
use zip::{CompressionMethod, DateTime};

/// Returns a ZIP archive of `entries`, which are short names and contents, without compression. The contents of each begin at a multiple of
/// `alignment` bytes. The same entries give the same bytes at any time.
pub fn stored_zip<'a>(
    entries: impl IntoIterator<Item = (impl Into<String>, &'a [u8])>,
    alignment: u16,
) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    for (name, contents) in entries {
        let options = FileOptions::default()
            .compression_method(CompressionMethod::Stored)
            // The default is the time of day.
            .last_modified_time(DateTime::default())
            .large_file(contents.len() > u32::MAX as usize);
        zip.start_file_aligned(name, options, alignment).expect("a short name");
        zip.write_all(contents).expect("memory");
    }
    zip.finish().expect("memory").into_inner()
}
