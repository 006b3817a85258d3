//! Reader for event files that another process is still writing: the events so far, and their images.

use super::event_file::masked_crc32c;
use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Maximum length of a message in bytes. A longer record isn't one of ours and is skipped.
const LONGEST: u64 = 64 << 20;
/// Number of bytes of a record before its message: the length, and its checksum.
const HEAD: usize = 12;
/// Number of bytes of a record after its message: a checksum.
const TAIL: u64 = 4;
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// An event of an event file.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedEvent {
    pub step: u64,
    /// Time at which it was written, in seconds since 1970.
    pub wall_time: f64,
    /// `true` if the run starts here: earlier events of this step and later steps are invalid.
    pub is_start: bool,
    /// Offset of the event in the file, if it has an image.
    pub image_offset: Option<u64>,
}

/// Reader for a file that may still grow, which continues where it stopped.
#[derive(Debug)]
pub struct EventReader {
    path: PathBuf,
    position: u64,
}

impl EventReader {
    /// Creates a reader for the file at `path`, which is opened when it is read.
    pub fn new(path: &Path) -> Self {
        EventReader { path: path.to_owned(), position: 0 }
    }

    /// Returns `true` if the file is no longer the one that was read: it is missing or shorter.
    pub fn is_stale(&self) -> bool {
        std::fs::metadata(&self.path).map_or(true, |file| file.len() < self.position)
    }

    /// Returns the events that were added since the last call. An incomplete record is left for the next call; nothing is read after a
    /// damaged one.
    ///
    /// # Errors
    /// Returns an error if the file can't be read.
    pub fn read_new(&mut self) -> Result<Vec<LoggedEvent>> {
        let read = || Error::read(&self.path);
        let file = File::open(&self.path).map_err(read())?;
        let end = file.metadata().map_err(read())?.len();
        let mut file = BufReader::new(file);
        file.seek(SeekFrom::Start(self.position)).map_err(read())?;
        let mut found = vec![];
        while end - self.position >= HEAD as u64 {
            let Some(length) = read_head(&mut file).map_err(read())? else { break };
            let whole = length.saturating_add(HEAD as u64 + TAIL);
            if whole > end - self.position {
                break;
            }
            if length > LONGEST {
                file.seek_relative((length + TAIL) as i64).map_err(read())?;
            } else {
                let mut message = vec![0; length as usize];
                file.read_exact(&mut message).map_err(read())?;
                file.seek_relative(TAIL as i64).map_err(read())?;
                found.extend(event(&message, self.position));
            }
            self.position += whole;
        }
        Ok(found)
    }
}

/// Returns the PNG in the event at the offset `at` in the file, if there is one.
///
/// # Errors
/// Returns an error if the file can't be read.
pub fn read_event_image(path: &Path, at: u64) -> Result<Option<Vec<u8>>> {
    let mut file = File::open(path).map_err(Error::read(path))?;
    file.seek(SeekFrom::Start(at)).map_err(Error::read(path))?;
    let Some(length) = read_head(&mut file).map_err(Error::read(path))? else { return Ok(None) };
    let mut message = vec![];
    file.take(length.min(LONGEST)).read_to_end(&mut message).map_err(Error::read(path))?;
    Ok(png(&message).map(<[u8]>::to_vec))
}

/// Reads the length of the message that follows, or returns `None` if its checksum doesn't match.
fn read_head(file: &mut impl Read) -> std::io::Result<Option<u64>> {
    let mut head = [0; HEAD];
    file.read_exact(&mut head)?;
    let (length, sum) = head.split_at(8);
    let is_right = masked_crc32c(length).to_le_bytes() == sum;
    Ok(is_right.then(|| u64::from_le_bytes(length.try_into().expect("eight bytes"))))
}

fn event(message: &[u8], at: u64) -> Option<LoggedEvent> {
    let mut event = LoggedEvent { step: 0, wall_time: 0., is_start: false, image_offset: None };
    for (number, field) in Fields(message) {
        match (number, field) {
            (1, Field::Fixed64(bytes)) => event.wall_time = f64::from_le_bytes(bytes),
            (2, Field::Varint(step)) => event.step = step,
            // The version of the format belongs to no step.
            (3, _) => return None,
            (7, _) => event.is_start = true,
            _ => {}
        }
    }
    event.image_offset = png(message).map(|_| at);
    Some(event)
}

/// Returns Summary.value.image.encoded_image_string of an event, if it is a PNG.
fn png(event: &[u8]) -> Option<&[u8]> {
    [5, 1, 4, 4]
        .into_iter()
        .try_fold(event, |message, wanted| {
            Fields(message).find_map(|(number, field)| match field {
                Field::Bytes(bytes) if number == wanted => Some(bytes),
                _ => None,
            })
        })
        .filter(|bytes| bytes.starts_with(PNG))
}

/// Iterator over a protobuf message's fields with their numbers, which stops where the bytes aren't a valid message.
struct Fields<'a>(&'a [u8]);

enum Field<'a> {
    Varint(u64),
    Fixed64([u8; 8]),
    Bytes(&'a [u8]),
    Fixed32,
}

impl<'a> Fields<'a> {
    fn varint(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (&byte, rest) = self.0.split_first()?;
            self.0 = rest;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }

    fn take(&mut self, count: u64) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(usize::try_from(count).ok()?)?;
        self.0 = rest;
        Some(taken)
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = (u64, Field<'a>);

    fn next(&mut self) -> Option<Self::Item> {
        let key = self.varint()?;
        let field = match key & 7 {
            0 => Field::Varint(self.varint()?),
            1 => Field::Fixed64(self.take(8)?.try_into().ok()?),
            2 => {
                let length = self.varint()?;
                Field::Bytes(self.take(length)?)
            }
            5 => self.take(4).map(|_| Field::Fixed32)?,
            _ => return None,
        };
        Some((key >> 3, field))
    }
}

#[cfg(test)]
mod tests {
    use super::super::event_file::EventFile;
    use super::*;
    use tch::{Device, Kind, Tensor};

    #[test]
    fn what_was_written_is_read_while_it_grows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tfevents");
        let mut file = EventFile::create(&path).unwrap();
        file.start(7).unwrap();
        file.write_scalars(8, &[("train/psnr".into(), 12.5)]).unwrap();
        let mut reader = EventReader::new(&path);
        let seen = reader.read_new().unwrap();
        assert_eq!(seen.iter().map(|e| (e.step, e.is_start)).collect::<Vec<_>>(), [(7, true), (8, false)]);
        assert!(seen.iter().all(|event| event.wall_time > 1.7e9 && event.image_offset.is_none()));

        // An incomplete record is read once it is complete.
        file.write_image(9, "train/views", &Tensor::zeros([3, 4, 5], (Kind::Float, Device::Cpu))).unwrap();
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() - 9]).unwrap();
        assert_eq!(reader.read_new().unwrap(), []);
        std::fs::write(&path, &whole).unwrap();
        let seen = reader.read_new().unwrap();
        let picture = read_event_image(&path, seen[0].image_offset.unwrap()).unwrap().unwrap();
        let picture = image::load_from_memory(&picture).unwrap();
        assert_eq!((seen[0].step, picture.width(), picture.height()), (9, 5, 4));
        assert_eq!(reader.read_new().unwrap(), []);
        assert!(!reader.is_stale());

        // Nothing after a damaged length is read.
        std::fs::write(&path, [&whole[..], &[255; 40]].concat()).unwrap();
        assert_eq!(reader.read_new().unwrap(), []);
        assert_eq!(read_event_image(&path, whole.len() as u64).unwrap(), None);
        std::fs::write(&path, &whole[..20]).unwrap();
        assert!(reader.is_stale());
    }

    #[test]
    fn arbitrary_bytes_do_not_panic() {
        for length in 0..40 {
            for byte in [0, 0x0a, 0x2a, 0x7f, 0x80, 0xff] {
                let message = vec![byte; length];
                assert!(png(&message).is_none());
                let _ = event(&message, 0);
            }
        }
    }
}
