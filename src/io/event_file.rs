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
        let version = record(&event(0, &bytes(3, VERSION.as_bytes())));
        let session = record(&event(step, &bytes(7, &varint(1, START))));
        self.file.append(&[version, session].concat())
    }

    /// Writes the scalars of one step, by tag.
    pub fn write_scalars(&mut self, step: u64, values: &[(String, f64)]) -> Result<()> {
        let value = |(tag, value): &(String, f64)| {
            bytes(1, &[bytes(1, tag.as_bytes()), float(2, *value as f32)].concat())
        };
        self.write_summary(step, &values.iter().flat_map(value).collect::<Vec<_>>())
    }

    /// Writes an image [3, H, W] in [0, 1].
    pub fn write_image(&mut self, step: u64, tag: &str, image: &Tensor) -> Result<()> {
        let pixels = rgb_from_tensor(image)?;
        let [height, width] = [pixels.height(), pixels.width()].map(u64::from);
        let encoded = encode_photo(&pixels, false)?;
        let image = [varint(1, height), varint(2, width), varint(3, RGB), bytes(4, &encoded)].concat();
        self.write_summary(step, &bytes(1, &[bytes(1, tag.as_bytes()), bytes(4, &image)].concat()))
    }

    fn write_summary(&mut self, step: u64, summary: &[u8]) -> Result<()> {
        self.file.append(&record(&event(step, &bytes(5, summary))))
    }
}

/// Returns an `Event` of `step` with the current time and the field `content`.
fn event(step: u64, content: &[u8]) -> Vec<u8> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
    [&field(1, 1, &now.to_le_bytes()), &varint(2, step), content].concat()
}

/// Returns a field of a protobuf message in its wire format: its key, and its value. Wire types: 0 varint, 1 eight bytes, 2 length and bytes,
/// 5 four bytes.
fn field(number: u64, wire_type: u64, value: &[u8]) -> Vec<u8> {
    [&encode_varint(number << 3 | wire_type), value].concat()
}

fn varint(number: u64, value: u64) -> Vec<u8> {
    field(number, 0, &encode_varint(value))
}

fn float(number: u64, value: f32) -> Vec<u8> {
    field(number, 5, &value.to_le_bytes())
}

/// Returns a field of bytes, which may be those of a message.
fn bytes(number: u64, value: &[u8]) -> Vec<u8> {
    field(number, 2, &[&encode_varint(value.len() as u64), value].concat())
}

fn encode_varint(mut value: u64) -> Vec<u8> {
    let mut bytes = vec![];
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

/// Returns a TFRecord: the length, its checksum, the message, its checksum.
fn record(message: &[u8]) -> Vec<u8> {
    let length = (message.len() as u64).to_le_bytes();
    let sums = [masked_crc32c(&length), masked_crc32c(message)].map(u32::to_le_bytes);
    [&length[..], &sums[0], message, &sums[1]].concat()
}

/// Returns the masked CRC-32C of `bytes`, for data that may contain checksums themselves.
fn masked_crc32c(bytes: &[u8]) -> u32 {
    CRC_32C.checksum(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}
