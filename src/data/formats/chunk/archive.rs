//! The zip archive that torch.save writes: a pickle, and the bytes of its tensors, all of it stored as it is.

use crate::error::{Error, Result};
use globalsplat_csrc::chunk::ChunkRecord;
use std::fmt::Display;
use std::io::Cursor;
use std::ops::Range;
use std::path::Path;
use zip::CompressionMethod;
use zip::read::ZipArchive;

/// An archive's parts, as places in its file.
#[derive(Debug)]
pub(super) struct Archive {
    /// Of data.pkl.
    pub pickle: Range<usize>,
    /// Of the tensors, in the order in which they lie in the file. None overlaps another.
    pub records: Vec<ChunkRecord>,
}

impl Archive {
    /// Finds the parts of `bytes`, which `file` holds, and checks their checksums. Whatever the archive claims, nothing is
    /// larger than the file: compressed entries, which could inflate without end, are refused.
    ///
    /// # Errors
    /// A file that is no such archive, was cut off, or has changed since it was written.
    pub(super) fn open(file: &Path, bytes: &[u8]) -> Result<Self> {
        let refuse = |field: &str, found: &dyn Display, expected: &str| {
            Err(Error::input(file, field, found, expected))
        };
        let mut zip = match ZipArchive::new(Cursor::new(bytes)) {
            Ok(zip) => zip,
            Err(e) => {
                return refuse("the file", &format!("no whole zip archive ({e})"), "what torch.save writes");
            }
        };
        let (mut pickle, mut records) = (None, vec![]);
        for index in 0..zip.len() {
            let entry = match zip.by_index_raw(index) {
                Ok(entry) => entry,
                Err(e) => {
                    return refuse(&format!("entry {index}"), &format!("broken ({e})"), "a stored file");
                }
            };
            let name = entry.name();
            let stored =
                entry.compression() == CompressionMethod::Stored && entry.size() == entry.compressed_size();
            if !stored {
                return refuse(name, &"compressed", "a stored file, as torch.save writes");
            }
            let start = entry.data_start();
            let range = start as usize..start.saturating_add(entry.size()) as usize;
            let Some(contents) = bytes.get(range.clone()) else {
                return refuse(name, &format!("{} bytes at byte {start}", entry.size()), "inside the file");
            };
            if crc32fast::hash(contents) != entry.crc32() {
                return refuse(name, &"damaged: its checksum differs", "the bytes that were written");
            }
            // The first folder is the archive's own name.
            match name.split_once('/').map(|(_, inside)| inside) {
                Some("data.pkl") => pickle = Some(range),
                Some(inside) => {
                    if let Some(key) = inside.strip_prefix("data/") {
                        records.push(ChunkRecord { key: key.into(), start, length: entry.size() });
                    }
                }
                None => {}
            }
        }
        let Some(pickle) = pickle else {
            return refuse("the archive", &"one without data.pkl", "what torch.save writes");
        };
        records.sort_by_key(|record| (record.start, record.length));
        match records.windows(2).find(|pair| pair[0].start + pair[0].length > pair[1].start) {
            Some(pair) => refuse(
                &format!("data/{}", pair[0].key),
                &"in one place with another entry",
                "a place of its own",
            ),
            None => Ok(Archive { pickle, records }),
        }
    }
}
