//! Container of SPZ: a header and six streams, together in gzip up to version 3, each in Zstandard since version 4.

use crate::axes::Axes;
use crate::numbers::{u32_at, u64_at};
use crate::{Error, Result};
use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use globalsplat_files::write_atomically;
use std::io::{Read, Write};
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
/// Type of the extension that names the axes.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;
/// Maximum size of the extensions in bytes.
const MAX_EXTENSIONS: u64 = 1 << 16;
/// Maximum ratio of decompressed to compressed size, with `MAX_SMALL` bytes allowed in addition. Real splats reach a ratio of ten.
const MAX_RATIO: u128 = 256;
const MAX_SMALL: u128 = 1 << 20;
/// Level of Zstandard: higher ones take three times as long and save a hundredth.
const ZSTD_LEVEL: i32 = 12;

/// Streams in the file's order, each with the values of all Gaussians: positions (three coordinates, float16 in version 1, 24 bits each since
/// version 2), opacities, colors, scales, rotations (three bytes up to version 2, four since version 3), spherical harmonics.
pub type Streams = [Vec<u8>; 6];

/// Properties of the streams, as a file declares them.
#[derive(Debug, Clone, Copy)]
pub struct Description {
    pub version: u32,
    pub count: usize,
    pub sh_degree: usize,
    /// Number of fractional bits of positions.
    pub fractional_bits: u32,
    pub antialiased: bool,
    pub axes: Axes,
}

impl Description {
    /// Parses the part of the header that all versions have in common.
    fn parse(path: &Path, header: &[u8]) -> Result<(Self, u8)> {
        if header[..4] != MAGIC {
            return Err(Error::input(path, "the first bytes", format!("{:?}", &header[..4]), "NGSP"));
        }
        let (version, count) = (u32_at(header, 4), u32_at(header, 8) as usize);
        let [sh_degree, fractional_bits, flags] = [12, 13, 14].map(|at| header[at]);
        if !(1..=4).contains(&version) {
            return Err(Error::input(path, "the version", version, "1 to 4"));
        }
        if sh_degree > 3 {
            return Err(Error::input(path, "the SH degree", sh_degree, "0 to 3"));
        }
        if fractional_bits > 30 {
            return Err(Error::input(path, "the number of fractional bits", fractional_bits, "0 to 30"));
        }
        let description = Description {
            version,
            count,
            sh_degree: sh_degree.into(),
            fractional_bits: fractional_bits.into(),
            antialiased: flags & ANTIALIASED != 0,
            axes: Axes::RUB,
        };
        Ok((description, flags))
    }

    /// Returns the number of bytes per Gaussian in each stream.
    fn widths(&self) -> [usize; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version >= 3 { 4 } else { 3 };
        [position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1).pow(2) - 1)]
    }

    /// Checks that a file of `length` bytes may decompress to the size that it claims. No memory is allocated before this check.
    fn check_decompressed_size(&self, path: &Path, length: usize) -> Result<()> {
        let bytes = self.widths().iter().sum::<usize>() as u128 * self.count as u128;
        if bytes > MAX_SMALL + MAX_RATIO * length as u128 {
            let found = format!("{}, {bytes} bytes of them in a file of {length}", self.count);
            let expected = format!("{MAX_RATIO} times the file's bytes at most");
            return Err(Error::input(path, "the number of Gaussians", found, expected));
        }
        Ok(())
    }
}

/// Returns `true` if `bytes` begin like an SPZ of any version.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC) || (bytes.starts_with(&GZIP) && bytes.get(3).is_some_and(|flags| flags < &0x20))
}

pub fn read(path: &Path, bytes: &[u8]) -> Result<(Description, Streams)> {
    match recognizes(bytes) {
        true if bytes.starts_with(&MAGIC) => read_plain(path, bytes),
        true => read_gzip(path, bytes),
        false => Err(Error::input(path, "the file", "no SPZ", "one in gzip, or NGSP")),
    }
}

/// Reads versions 1 to 3: header, streams and extensions in one gzip.
fn read_gzip(path: &Path, bytes: &[u8]) -> Result<(Description, Streams)> {
    let mut decoder = GzDecoder::new(bytes);
    let mut decompress = |length: u64, what: &str| -> Result<Vec<u8>> {
        let mut decompressed = vec![];
        let read = decoder.by_ref().take(length).read_to_end(&mut decompressed);
        read.map_err(|why| Error::input(path, what, format!("damaged: {why}"), "a whole gzip"))?;
        Ok(decompressed)
    };
    let header = decompress(GZIP_HEADER as u64, "the header")?;
    if header.len() < GZIP_HEADER {
        let found = format!("{} bytes", header.len());
        return Err(Error::input(path, "the header", found, format!("{GZIP_HEADER} bytes")));
    }
    let (mut description, flags) = Description::parse(path, &header)?;
    if description.version > 3 {
        return Err(Error::input(path, "the version in gzip", description.version, "1 to 3"));
    }
    description.check_decompressed_size(path, bytes.len())?;
    let mut streams = Streams::default();
    for (stream, width) in streams.iter_mut().zip(description.widths()) {
        let length = width * description.count;
        *stream = decompress(length as u64, "the body")?;
        if stream.len() < length {
            let found = format!("cut short: {} bytes of a stream", stream.len());
            let expected = format!("{length} bytes for {} Gaussians", description.count);
            return Err(Error::input(path, "the body", found, expected));
        }
    }
    // Reading to the end also verifies gzip's checksum.
    let extensions = decompress(MAX_EXTENSIONS, "the end")?;
    if flags & HAS_EXTENSIONS != 0 {
        description.axes = parse_axes(path, &extensions)?;
    }
    Ok((description, streams))
}

/// Reads version 4: uncompressed header, extensions and table of contents, then each stream compressed separately.
fn read_plain(path: &Path, bytes: &[u8]) -> Result<(Description, Streams)> {
    if bytes.len() < PLAIN_HEADER {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the header", found, format!("{PLAIN_HEADER} bytes")));
    }
    let (mut description, flags) = Description::parse(path, bytes)?;
    if description.version < 4 {
        return Err(Error::input(path, "the version outside of gzip", description.version, "4"));
    }
    description.check_decompressed_size(path, bytes.len())?;
    let contents = u32_at(bytes, 16) as usize;
    let stored = usize::from(bytes[15]);
    let end = contents.saturating_add(16 * stored);
    if contents < PLAIN_HEADER || end > bytes.len() {
        let expected = format!("{stored} entries within the file's {} bytes", bytes.len());
        return Err(Error::input(path, "the table of contents", format!("at {contents}"), expected));
    }
    if flags & HAS_EXTENSIONS != 0 {
        description.axes = parse_axes(path, &bytes[PLAIN_HEADER..contents])?;
    }
    let mut rest = &bytes[end..];
    let mut entries = bytes[contents..end].as_chunks::<16>().0.iter();
    let mut streams = Streams::default();
    for (index, (stream, width)) in streams.iter_mut().zip(description.widths()).enumerate() {
        let length = width * description.count;
        let error =
            |found: String, expected: String| Error::input(path, format!("stream {index}"), found, expected);
        let Some(entry) = entries.next() else {
            if length > 0 {
                return Err(error("missing".into(), format!("one of {length} bytes")));
            }
            continue;
        };
        let stored = u64_at(entry, 0);
        let split = usize::try_from(stored).ok().and_then(|at| rest.split_at_checked(at));
        let cut_short = || error(format!("cut short: {} bytes", rest.len()), format!("{stored} bytes"));
        let (compressed, after) = split.ok_or_else(cut_short)?;
        rest = after;
        zstd::stream::read::Decoder::new(compressed)
            .and_then(|decoder| decoder.take(length as u64 + 1).read_to_end(stream))
            .map_err(|why| error(format!("damaged: {why}"), "Zstandard".into()))?;
        if stream.len() != length {
            let expected = format!("{length} bytes for {} Gaussians", description.count);
            return Err(error(format!("{} bytes or more", stream.len()), expected));
        }
    }
    Ok((description, streams))
}

/// Returns the axes that one of the `extensions` names. Each extension is a type, a length and that many bytes.
fn parse_axes(path: &Path, mut extensions: &[u8]) -> Result<Axes> {
    let mut axes = Axes::RUB;
    while let Some((head, rest)) = extensions.split_first_chunk::<8>() {
        let [kind, length] = [0, 4].map(|at| u32_at(head, at));
        let Some((contents, after)) = rest.split_at_checked(length as usize) else {
            let found = format!("cut short: {} bytes", rest.len());
            return Err(Error::input(path, "an extension", found, format!("{length} bytes")));
        };
        if let (COORDINATE_SYSTEM, Some(number)) = (kind, contents.first_chunk()) {
            let number = u32::from_le_bytes(*number);
            axes = Axes::from_code(number)
                .ok_or_else(|| Error::input(path, "the coordinate system", number, "1 to 8 (LDB to RUF)"))?;
        }
        extensions = after;
    }
    Ok(axes)
}

/// Writes the streams atomically: together in gzip up to version 3, each in Zstandard since version 4.
pub fn write(path: &Path, description: &Description, streams: Streams) -> Result<()> {
    let mut streams = Vec::from(streams);
    // Since version 4 a splat of degree 0 has no sixth stream.
    streams.retain(|stream| !stream.is_empty());
    let is_plain = description.version >= 4;
    let mut header = MAGIC.to_vec();
    header.extend(description.version.to_le_bytes());
    header.extend((description.count as u32).to_le_bytes());
    let flags = if description.antialiased { ANTIALIASED } else { 0 };
    let stream_count = if is_plain { streams.len() as u8 } else { 0 };
    header.extend([description.sh_degree as u8, description.fractional_bits as u8, flags, stream_count]);
    if !is_plain {
        return write_atomically(path, |writer| {
            let mut encoder = GzEncoder::new(writer, Compression::best());
            let parts = [&[header], &streams[..]].concat();
            parts.iter().try_for_each(|part| encoder.write_all(part)).map_err(Error::write(path))?;
            encoder.finish().map(drop).map_err(Error::write(path))
        });
    }
    header.extend((PLAIN_HEADER as u32).to_le_bytes()); // the table of contents follows the header
    header.resize(PLAIN_HEADER, 0);
    let compress = |stream: &Vec<u8>| zstd::bulk::compress(stream, ZSTD_LEVEL).map_err(Error::write(path));
    let compressed = streams.iter().map(compress).collect::<Result<Vec<_>>>()?;
    for (stream, compressed) in streams.iter().zip(&compressed) {
        header.extend((compressed.len() as u64).to_le_bytes());
        header.extend((stream.len() as u64).to_le_bytes());
    }
    write_atomically(path, |writer| {
        let mut parts = [&[header], &compressed[..]].concat().into_iter();
        parts.try_for_each(|part| writer.write_all(&part)).map_err(Error::write(path))
    })
}
