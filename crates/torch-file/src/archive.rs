//! The zip archive that torch.save writes: a pickle, and the bytes of its tensors, all stored without compression.

use crate::Storages;
use globalsplat_files::{Error, Result};
use std::fmt::Display;
use std::io::Cursor;
use std::ops::Range;
use std::path::Path;
use zip::CompressionMethod;
use zip::read::ZipArchive;

/// Returns the byte range of `data.pkl` in `bytes`, the contents of `file`, and those of the tensors' storages (`data/KEY`), after their
/// checksums are verified. Whatever the archive claims, no part is larger than the file, nor are all parts together: compressed entries,
/// which could inflate without limit, are refused, and so are entries that share bytes.
///
/// # Errors
/// Returns an error if the file isn't an archive that torch.save wrote since torch 1.6, is truncated, or has changed since it was written.
pub fn find_parts(file: &Path, bytes: &[u8]) -> Result<(Range<usize>, Storages)> {
    let refuse =
        |field: &str, found: &dyn Display, expected: &str| Err(Error::input(file, field, found, expected));
    let mut zip = ZipArchive::new(Cursor::new(bytes)).map_err(|e| {
        Error::input(file, "the file", format!("no whole zip archive ({e})"), "what torch.save writes")
    })?;
    let mut entries = vec![];
    for index in 0..zip.len() {
        let entry = zip.by_index_raw(index).map_err(|e| {
            Error::input(file, format!("entry {index}"), format!("broken ({e})"), "a stored file")
        })?;
        let name = entry.name();
        let stored =
            entry.compression() == CompressionMethod::Stored && entry.size() == entry.compressed_size();
        if !stored {
            return refuse(name, &"compressed", "a stored file, as torch.save writes");
        }
        let start = entry.data_start();
        let contents = start as usize..start.saturating_add(entry.size()) as usize;
        if contents.end > bytes.len() {
            return refuse(name, &format!("{} bytes at byte {start}", entry.size()), "inside the file");
        }
        entries.push((name.to_string(), contents, entry.crc32()));
    }
    entries.sort_by_key(|(_, contents, _)| (contents.start, contents.end));
    if let Some(pair) = entries.windows(2).find(|pair| pair[0].1.end > pair[1].1.start) {
        return refuse(&pair[0].0, &"in one place with another entry", "a place of its own");
    }
    let (mut pickle, mut storages) = (None, Storages::new());
    for (name, contents, crc32) in entries {
        if crc32fast::hash(&bytes[contents.clone()]) != crc32 {
            return refuse(&name, &"damaged: its checksum differs", "the bytes that were written");
        }
        // The first folder has the name of the archive.
        match name.split_once('/').map(|(_, inside)| inside) {
            Some("data.pkl") => pickle = Some(contents),
            Some("byteorder") if &bytes[contents.clone()] != b"little" => {
                return refuse(&name, &String::from_utf8_lossy(&bytes[contents]), "little");
            }
            Some(inside) => {
                if let Some(key) = inside.strip_prefix("data/") {
                    storages.insert(key.into(), contents);
                }
            }
            None => {}
        }
    }
    match pickle {
        Some(pickle) => Ok((pickle, storages)),
        None => refuse("the archive", &"one without data.pkl", "what torch.save writes"),
    }
}
