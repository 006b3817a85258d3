//! SPZ files of every version, with valid compression.

use super::file;
use arbitrary::{Arbitrary, Unstructured};
use globalsplat::io::{read_splat, write_splat};
use std::io::Write;

#[derive(Arbitrary)]
struct Spz {
    version: u8,
    /// Number of Gaussians; by default the number that the streams contain.
    count: Option<u32>,
    few: u8,
    degree: u8,
    bits: u8,
    flags: u8,
    /// Offset of the contents in version 4 that replaces the right one.
    contents_at: Option<u32>,
    streams: Option<u8>,
    lengths: Vec<(u8, u64)>,
    extensions: Vec<(u32, u32)>,
    /// Bytes repeated until the streams are full.
    body: Vec<u8>,
}

/// Reads a generated SPZ; a splat that can be read must survive a round trip.
pub fn spz(bytes: &[u8]) {
    let Ok(made) = Spz::arbitrary(&mut Unstructured::new(bytes)) else { return };
    let (version, degree, few) = (made.version % 6, made.degree % 5, usize::from(made.few % 8));
    let harmonics = 3 * (usize::from(degree + 1).pow(2) - 1);
    let position = if version == 1 { 6 } else { 9 };
    let rotation = if version < 3 { 3 } else { 4 };
    let mut numbers = made.body.iter().copied().chain([128]).cycle();
    let streams = [position, 1, 3, 3, rotation, harmonics]
        .map(|width| numbers.by_ref().take(width * few).collect::<Vec<u8>>());
    let mut header = [b"NGSP", &[version, 0, 0, 0][..]].concat();
    header.extend(made.count.unwrap_or(few as u32).to_le_bytes());
    header.extend([degree, made.bits % 40, made.flags]);
    let extensions = made.extensions.iter().flat_map(|&(kind, number)| {
        let kind = if kind % 2 == 0 { 0xADBE_0003 } else { kind };
        [kind, 4, number % 20].map(u32::to_le_bytes).concat()
    });
    let extensions: Vec<u8> = extensions.collect();
    let contents = if version < 4 {
        header.push(0);
        let mut encoder = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
        encoder.write_all(&[header, streams.concat(), extensions].concat()).unwrap();
        encoder.finish().unwrap()
    } else {
        let compressed = streams.map(|stream| zstd::encode_all(&stream[..], 1).unwrap());
        header.push(made.streams.unwrap_or(6));
        header.extend(made.contents_at.unwrap_or(32 + extensions.len() as u32).to_le_bytes());
        header.extend([0; 12]);
        let mut lengths = [0, 1, 2, 3, 4, 5].map(|stream: usize| compressed[stream].len() as u64);
        for &(stream, length) in &made.lengths {
            lengths[usize::from(stream) % 6] = length;
        }
        let entries = lengths.iter().flat_map(|length| [length.to_le_bytes(), [0; 8]].concat()).collect();
        [header, extensions, entries, compressed.concat()].concat()
    };
    let Ok(splat) = read_splat(&file("made_spz", "splat.spz", &contents)) else { return };
    let copy = file("made_spz", "copy.spz", b"");
    if write_splat(&copy, &splat).is_ok() {
        let again = read_splat(&copy).unwrap();
        assert_eq!(again.len(), splat.len());
        assert_eq!(again.sh_degree, splat.sh_degree);
    }
}
