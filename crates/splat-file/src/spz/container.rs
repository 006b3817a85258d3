//! Container of SPZ: a header and six streams, together in gzip up to version 3, each in Zstandard since version 4.

use crate::axes::Axes;
use crate::numbers::{ClaimedGaussians, u32_at};
use crate::{Error, Result};
use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use globalsplat_files::{write_atomically, write_file};
use std::fmt::Display;
use std::io::{Read, Write};
use std::ops::RangeInclusive;
use std::path::Path;

/// First bytes of every version, after gzip is decompressed.
const MAGIC: [u8; 4] = *b"NGSP";
/// First bytes of gzip. In the next byte, the flags, the upper three bits are 0.
const GZIP: [u8; 3] = [0x1f, 0x8b, 8];
/// Size of the header in bytes, up to version 3 (`GZIP_HEADER`) and since version 4 (`PLAIN_HEADER`).
const GZIP_HEADER: usize = 16;
const PLAIN_HEADER: usize = 32;
/// Flag that the splat is antialiased.
const ANTIALIASED: u8 = 1;
/// Flag that there are extensions: after the streams up to version 3, before them since version 4.
const HAS_EXTENSIONS: u8 = 2;
/// Flag of Spark's levels of detail: a tree of Gaussians, each with the number of its children and the index of the first one, in 16 and 32
/// bits. Opacities are stored as halves.
const HAS_LEVELS: u8 = 0x80;
/// Type of the extension that names the axes.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;
/// Maximum size of the extensions in bytes.
const MAX_EXTENSIONS: usize = 1 << 16;
/// Level of Zstandard: higher ones take three times as long and save a hundredth.
const ZSTD_LEVEL: i32 = 12;

/// Streams in the file's order, each with the values of all Gaussians: positions (three coordinates, float16 in version 1, 24 bits each since
/// version 2), opacities, colors, scales, rotations (three bytes up to version 2, four since version 3), spherical harmonics, and with
/// levels of detail the numbers of children, followed by the indices of the first ones.
pub type Streams = [Vec<u8>; 7];

/// Header of a file.
#[derive(Debug, Clone, Copy)]
pub struct Header {
    pub version: u32,
    pub count: usize,
    pub sh_degree: usize,
    /// Number of fractional bits of positions.
    pub fractional_bits: u32,
    pub antialiased: bool,
    /// `true` if there are extensions. None are written.
    pub has_extensions: bool,
    /// `true` if there are levels of detail. None are written.
    pub has_levels: bool,
}

impl Header {
    /// Parses the header of `length` bytes at the beginning of `bytes`, in a file of `file_length` bytes. The version must be one of
    /// `versions`.
    fn parse(
        path: &Path,
        bytes: &[u8],
        length: usize,
        file_length: usize,
        versions: RangeInclusive<u32>,
    ) -> Result<Self> {
        let refuse = |field: &str, found: &dyn Display, expected: &str| {
            Err(Error::input(path, field, found, expected))
        };
        if bytes.len() < length {
            return refuse("the header", &format!("{} bytes", bytes.len()), &format!("{length} bytes"));
        }
        if bytes[..4] != MAGIC {
            return refuse("the first bytes", &format!("{:?}", &bytes[..4]), "NGSP");
        }
        let (version, count) = (u32_at(bytes, 4), u32_at(bytes, 8) as usize);
        let [sh_degree, fractional_bits, flags] = [12, 13, 14].map(|at| bytes[at]);
        if !versions.contains(&version) {
            return refuse("the version", &version, "1 to 3 in gzip, 4 outside of it");
        }
        if sh_degree > 3 {
            return refuse("the SH degree", &sh_degree, "0 to 3");
        }
        if fractional_bits > 30 {
            return refuse("the number of fractional bits", &fractional_bits, "0 to 30");
        }
        let has_levels = flags & HAS_LEVELS != 0;
        if has_levels && version > 3 {
            return refuse("the flags", &format!("{flags}, Spark's levels of detail"), "none in version 4");
        }
        let header = Header {
            version,
            count,
            sh_degree: sh_degree.into(),
            fractional_bits: fractional_bits.into(),
            antialiased: flags & ANTIALIASED != 0,
            has_extensions: flags & HAS_EXTENSIONS != 0,
            has_levels,
        };
        ClaimedGaussians::default().add(path, count, header.sh_degree, file_length)?;
        Ok(header)
    }

    /// Returns the number of bytes per Gaussian in each stream.
    fn widths(&self) -> [usize; 7] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version >= 3 { 4 } else { 3 };
        let children = if self.has_levels { 2 + 4 } else { 0 };
        [position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1).pow(2) - 1), children]
    }

    /// Returns the axes that one of the `extensions` names, if there are any. Each extension is a type, a length and that many bytes.
    fn parse_axes(&self, path: &Path, mut extensions: &[u8]) -> Result<Axes> {
        let mut axes = Axes::RUB;
        while let Some((head, rest)) = extensions.split_first_chunk::<8>().filter(|_| self.has_extensions) {
            let [kind, length] = [0, 4].map(|at| u32_at(head, at));
            let Some((contents, after)) = rest.split_at_checked(length as usize) else {
                let found = format!("cut short: {} bytes", rest.len());
                return Err(Error::input(path, "an extension", found, format!("{length} bytes")));
            };
            if let (COORDINATE_SYSTEM, Some(number)) = (kind, contents.first_chunk()) {
                let number = u32::from_le_bytes(*number);
                let unknown = || Error::input(path, "the coordinate system", number, "1 to 16 (LDB to RBU)");
                axes = Axes::from_code(number).ok_or_else(unknown)?;
            }
            extensions = after;
        }
        Ok(axes)
    }
}

/// Returns `true` if `bytes` begin like an SPZ of any version.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC) || (bytes.starts_with(&GZIP) && bytes.get(3).is_some_and(|flags| flags < &0x20))
}

pub fn read(path: &Path, bytes: &[u8]) -> Result<(Header, Axes, Streams)> {
    match recognizes(bytes) {
        true if bytes.starts_with(&MAGIC) => read_plain(path, bytes),
        true => read_gzip(path, bytes),
        false => Err(Error::input(path, "the file", "no SPZ", "one in gzip, or NGSP")),
    }
}

/// Reads versions 1 to 3: header, streams and extensions in one gzip.
fn read_gzip(path: &Path, bytes: &[u8]) -> Result<(Header, Axes, Streams)> {
    let mut decoder = GzDecoder::new(bytes);
    let mut decompress = |length: usize| -> Result<Vec<u8>> {
        let mut decompressed = vec![];
        let read = decoder.by_ref().take(length as u64).read_to_end(&mut decompressed);
        read.map_err(|why| Error::input(path, "the file", format!("damaged: {why}"), "a whole gzip"))?;
        Ok(decompressed)
    };
    let header = Header::parse(path, &decompress(GZIP_HEADER)?, GZIP_HEADER, bytes.len(), 1..=3)?;
    let lengths = header.widths().map(|width| width * header.count);
    let length = lengths.iter().sum();
    // Reading to the end, where extensions may be, also verifies gzip's checksum.
    let body = decompress(length + MAX_EXTENSIONS)?;
    let Some((mut body, extensions)) = body.split_at_checked(length) else {
        let expected = format!("{length} bytes for {} Gaussians", header.count);
        return Err(Error::input(path, "the body", format!("cut short: {} bytes", body.len()), expected));
    };
    let streams = lengths.map(|length| body.split_off(..length).expect("their sum").to_vec());
    Ok((header, header.parse_axes(path, extensions)?, streams))
}

/// Reads version 4: uncompressed header, extensions and table of contents, then each stream compressed separately.
fn read_plain(path: &Path, bytes: &[u8]) -> Result<(Header, Axes, Streams)> {
    let header = Header::parse(path, bytes, PLAIN_HEADER, bytes.len(), 4..=4)?;
    let contents = u32_at(bytes, 16) as usize;
    let stored = usize::from(bytes[15]);
    let end = contents.saturating_add(16 * stored);
    if contents < PLAIN_HEADER || end > bytes.len() {
        let expected = format!("{stored} entries within the file's {} bytes", bytes.len());
        return Err(Error::input(path, "the table of contents", format!("at {contents}"), expected));
    }
    let axes = header.parse_axes(path, &bytes[PLAIN_HEADER..contents])?;
    let mut rest = &bytes[end..];
    let mut entries = bytes[contents..end].as_chunks::<16>().0.iter();
    let mut streams = Streams::default();
    for (index, (stream, width)) in streams.iter_mut().zip(header.widths()).enumerate() {
        let length = width * header.count;
        let error =
            |found: String, expected: String| Error::input(path, format!("stream {index}"), found, expected);
        let Some((size, _)) = entries.next().and_then(|entry| entry.split_first_chunk()) else {
            if length > 0 {
                return Err(error("missing".into(), format!("one of {length} bytes")));
            }
            continue;
        };
        let size = u64::from_le_bytes(*size);
        let compressed = usize::try_from(size).ok().and_then(|size| rest.split_off(..size));
        let cut_short = || error(format!("cut short: {} bytes", rest.len()), format!("{size} bytes"));
        zstd::stream::read::Decoder::new(compressed.ok_or_else(cut_short)?)
            .and_then(|decoder| decoder.take(length as u64 + 1).read_to_end(stream))
            .map_err(|why| error(format!("damaged: {why}"), "Zstandard".into()))?;
        if stream.len() != length {
            let expected = format!("{length} bytes for {} Gaussians", header.count);
            return Err(error(format!("{} bytes or more", stream.len()), expected));
        }
    }
    Ok((header, axes, streams))
}

/// Writes the streams atomically: together in gzip up to version 3, each in Zstandard since version 4.
pub fn write(path: &Path, header: &Header, streams: Streams) -> Result<()> {
    let mut streams = Vec::from(streams);
    // Since version 4 a splat of degree 0 has no sixth stream.
    streams.retain(|stream| !stream.is_empty());
    let is_plain = header.version >= 4;
    let flags = if header.antialiased { ANTIALIASED } else { 0 };
    let stream_count = if is_plain { streams.len() as u8 } else { 0 };
    let mut bytes = [MAGIC, header.version.to_le_bytes(), (header.count as u32).to_le_bytes()].concat();
    bytes.extend([header.sh_degree as u8, header.fractional_bits as u8, flags, stream_count]);
    if !is_plain {
        bytes.extend(streams.concat());
        return write_atomically(path, |writer| {
            let mut encoder = GzEncoder::new(writer, Compression::best());
            encoder.write_all(&bytes).and_then(|()| encoder.finish().map(drop)).map_err(Error::write(path))
        });
    }
    bytes.extend((PLAIN_HEADER as u32).to_le_bytes()); // the table of contents follows the header
    bytes.resize(PLAIN_HEADER, 0);
    let mut body = vec![];
    for stream in streams {
        let compressed = zstd::bulk::compress(&stream, ZSTD_LEVEL).map_err(Error::write(path))?;
        bytes.extend((compressed.len() as u64).to_le_bytes());
        bytes.extend((stream.len() as u64).to_le_bytes());
        body.extend(compressed);
    }
    bytes.extend(body);
    write_file(path, bytes)
}
