//! Event files, which TensorBoard shows: TFRecords of `Event` messages. These are all the fields that we need:
//!
//! ```text
//! message Event   { double wall_time = 1; int64 step = 2; string file_version = 3; Summary summary = 5;
//!                   SessionLog session_log = 7; }
//! message SessionLog { enum { START = 1 } status = 1; }
//! message Summary { message Value { string tag = 1; float simple_value = 2; Image image = 4; }
//!                   repeated Value value = 1; }
//! message Image   { int32 height = 1; int32 width = 2; int32 colorspace = 3; bytes encoded_image_string = 4; }
//! ```

use super::images::rgb_from_tensor;
use crate::error::{Error, Result};
use crc::{CRC_32_ISCSI, Crc};
use globalsplat_capture::encode_photo;
use globalsplat_files::AppendFile;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};
use tch::Tensor;

/// Version string by which readers recognize the format.
const VERSION: &str = "brain.Event:2";
/// Value of `SessionLog.START`.
const START: u64 = 1;
/// Value of `Image.colorspace` for RGB.
const RGB: u64 = 3;

/// CRC-32 with Castagnoli's polynomial.
const CRC_32C: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// Folder of event files in the folder of a run.
const FOLDER: &str = "tensorboard";
/// Prefix of the names of our files. A number follows, because TensorBoard reads the files of a folder in the order of their names.
const PREFIX: &str = "events.out.tfevents.";

/// Returns the number in the name of one of our files.
fn number_of(file: &Path) -> Option<u64> {
    file.file_name()?.to_str()?.strip_prefix(PREFIX)?.parse().ok()
}

/// Returns the event files of the folder `run`, oldest first. The list is empty if there are none or if they can't be listed.
pub fn event_files(run: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(run.join(FOLDER)).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        entries.filter_map(|entry| Some((number_of(&entry.path())?, entry.path()))).collect();
    files.sort();
    files.into_iter().map(|(_, file)| file).collect()
}

/// A file of events, written by one process.
#[derive(Debug)]
pub struct EventFile {
    file: AppendFile,
}

impl EventFile {
    /// Creates the next file of the run in the folder `run`, in its folder `tensorboard`.
    pub fn create_for(run: &Path) -> Result<Self> {
        let folder = run.join(FOLDER);
        std::fs::create_dir_all(&folder).map_err(Error::write(&folder))?;
        let number = event_files(run).last().and_then(|file| number_of(file)).map_or(0, |last| last + 1);
        Ok(EventFile { file: AppendFile::open(&folder.join(format!("{PREFIX}{number:010}")))? })
    }

    /// Writes the first records of the file: the version, and a session start that invalidates events of `step` and later steps in earlier
    /// files.
    pub fn start(&mut self, step: u64) -> Result<()> {
        let version = record(&Message::event(0).bytes(3, VERSION.as_bytes()));
        let session = record(&Message::event(step).message(7, &Message::default().varint(1, START)));
        Ok(self.file.append(&[version, session].concat())?)
    }

    /// Writes the scalars of one step, by tag.
    pub fn write_scalars(&mut self, step: u64, values: &[(String, f64)]) -> Result<()> {
        let summary = values.iter().fold(Message::default(), |summary, (tag, value)| {
            summary.message(1, &Message::default().bytes(1, tag.as_bytes()).float(2, *value as f32))
        });
        Ok(self.file.append(&record(&Message::event(step).message(5, &summary)))?)
    }

    /// Writes an image [3, H, W] in [0, 1].
    pub fn write_image(&mut self, step: u64, tag: &str, image: &Tensor) -> Result<()> {
        let pixels = rgb_from_tensor(image)?;
        let image = Message::default()
            .varint(1, u64::from(pixels.height()))
            .varint(2, u64::from(pixels.width()))
            .varint(3, RGB)
            .bytes(4, &encode_photo(&pixels, false)?);
        let value = Message::default().bytes(1, tag.as_bytes()).message(4, &image);
        let summary = Message::default().message(1, &value);
        Ok(self.file.append(&record(&Message::event(step).message(5, &summary)))?)
    }
}

/// A protobuf message in its wire format.
#[derive(Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    /// Creates an `Event` of `step` with the current time.
    fn event(step: u64) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let mut event = Message::default();
        event.key(1, 1);
        event.0.extend(now.to_le_bytes());
        event.varint(2, step)
    }

    /// Appends the key of a field. Wire types: 0 varint, 1 eight bytes, 2 length and bytes, 5 four bytes.
    fn key(&mut self, field: u64, wire_type: u64) {
        push_varint(&mut self.0, field << 3 | wire_type);
    }

    fn varint(mut self, field: u64, value: u64) -> Self {
        self.key(field, 0);
        push_varint(&mut self.0, value);
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.key(field, 5);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.key(field, 2);
        push_varint(&mut self.0, value.len() as u64);
        self.0.extend(value);
        self
    }

    fn message(self, field: u64, value: &Message) -> Self {
        self.bytes(field, &value.0)
    }
}

fn push_varint(bytes: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
}

/// Returns a TFRecord: the length, its checksum, the message, its checksum.
fn record(message: &Message) -> Vec<u8> {
    let length = (message.0.len() as u64).to_le_bytes();
    let sums = [masked_crc32c(&length), masked_crc32c(&message.0)].map(u32::to_le_bytes);
    [&length[..], &sums[0], &message.0, &sums[1]].concat()
}

/// Returns the masked CRC-32C of `bytes`, for data that may contain checksums themselves.
fn masked_crc32c(bytes: &[u8]) -> u32 {
    CRC_32C.checksum(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}
