//! mkkellogg's `.ksplat` format, versions 0.1 and later, which is only read. A header of 4,096 bytes and one of 1,024 bytes per section
//! are followed by the sections. From compression level 1, positions are relative to the centers of buckets of Gaussians.

use crate::invalid::{Contents, InvalidGaussians};
use crate::numbers::{f32_at, u16_at, u32_at};
use crate::splat::{color_to_sh0, logit_of_opacity};
use crate::{Error, Result, Splat};
use half::f16;
use std::path::Path;

/// Size in bytes of the header, and of the header of each section.
const HEADER: usize = 4096;
const SECTION_HEADER: usize = 1024;
/// Size in bytes of a bucket: its center, three float32.
const BUCKET: usize = 12;
/// Position within a bucket that is its center, if a section doesn't say otherwise.
const DEFAULT_RANGE: u32 = 32767;
/// Magnitude of the minimum and maximum of SH coefficients of level 2, if the file doesn't say otherwise.
const DEFAULT_SH_RANGE: f32 = 1.5;

/// How the numbers of a file are stored: float32, float16 or bytes, by their sizes in bytes.
struct Encoding {
    /// Size of a position's coordinate, which above compression level 0 is an integer, of a scale and of a quaternion's component.
    number_bytes: usize,
    /// Size of an SH coefficient.
    sh_bytes: usize,
    /// SH coefficients of the bytes 0 and 255.
    sh_range: [f32; 2],
}

impl Encoding {
    /// Returns the number of bytes of a Gaussian: position, scale, quaternion, then color and opacity, then spherical harmonics.
    fn gaussian_bytes(&self, bases: usize) -> usize {
        10 * self.number_bytes + 4 + 3 * (bases - 1) * self.sh_bytes
    }

    /// Returns number `index` of those in `bytes`, each of `size` bytes.
    fn number(&self, bytes: &[u8], index: usize, size: usize) -> f32 {
        let [min, max] = self.sh_range.map(f64::from);
        match size {
            4 => f32_at(bytes, 4 * index),
            2 => f16::from_bits(u16_at(bytes, 2 * index)).to_f32(),
            _ => (min + f64::from(bytes[index]) / 255. * (max - min)) as f32,
        }
    }
}

/// Reads a `.ksplat`.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
    if bytes.len() < HEADER {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the header", found, format!("{HEADER} bytes")));
    }
    let (major, minor) = (bytes[0], bytes[1]);
    if major != 0 || minor < 1 {
        return Err(Error::input(path, "the version", format!("{major}.{minor}"), "0.1 or later below 1"));
    }
    let level = u16_at(bytes, 20);
    if level > 2 {
        return Err(Error::input(path, "the compression level", level, "0 to 2"));
    }
    let or_default = |bound: f32, default: f32| if bound == 0. { default } else { bound };
    let sh_range =
        [or_default(f32_at(bytes, 36), -DEFAULT_SH_RANGE), or_default(f32_at(bytes, 40), DEFAULT_SH_RANGE)];
    let [number_bytes, sh_bytes] = [[4, 4], [2, 2], [2, 1]][usize::from(level)];
    let encoding = Encoding { number_bytes, sh_bytes, sh_range };
    let (sections, count) = (u32_at(bytes, 4) as usize, u32_at(bytes, 16));
    let Some((headers, mut rest)) =
        sections.checked_mul(SECTION_HEADER).and_then(|length| bytes[HEADER..].split_at_checked(length))
    else {
        let expected =
            format!("{} at most in a file of {} bytes", (bytes.len() - HEADER) / SECTION_HEADER, bytes.len());
        return Err(Error::input(path, "the number of sections", sections, expected));
    };
    let headers = headers.as_chunks::<SECTION_HEADER>().0;
    let sh_degree = headers.iter().map(sh_degree).max().unwrap_or(0);
    if sh_degree > 3 {
        return Err(Error::input(path, "the SH degree", sh_degree, "0 to 3"));
    }
    let mut splat = Splat { sh_degree, linear_scales: Some(vec![]), ..Splat::default() };
    for (index, header) in headers.iter().enumerate() {
        let section = Section { path, index, header, encoding: &encoding };
        rest = section.read(rest, &mut splat)?;
    }
    if splat.is_empty() || splat.len() != count as usize {
        let found = format!("{count}, with {} in the sections", splat.len());
        let expected = "1 or more, as many in the sections";
        return Err(Error::input(path, "the number of Gaussians", found, expected));
    }
    Ok((splat, InvalidGaussians::default()))
}

/// Returns the degree of the spherical harmonics of a section, which is 0 if it has no Gaussians.
fn sh_degree(header: &[u8; SECTION_HEADER]) -> usize {
    if u32_at(header, 4) == 0 { 0 } else { u16_at(header, 40).into() }
}

/// Section of a file: Gaussians with the same layout.
struct Section<'a> {
    path: &'a Path,
    index: usize,
    header: &'a [u8; SECTION_HEADER],
    encoding: &'a Encoding,
}

impl Section<'_> {
    fn error(&self, field: &str, found: impl std::fmt::Display, expected: impl Into<String>) -> Error {
        Error::input(self.path, format!("{field} of section {}", self.index), found, expected)
    }

    /// Appends the Gaussians of the section, with which `bytes` begin, to `splat`, whose SH degree is at least that of the section. Returns
    /// the bytes after the section.
    fn read<'b>(&self, bytes: &'b [u8], splat: &mut Splat) -> Result<&'b [u8]> {
        let number = |at: usize| u32_at(self.header, at) as usize;
        let (count, max_count, bucket_count) = (number(0), number(4), number(12));
        let (full_buckets, partial_buckets) = (number(32), number(36));
        let bases = (sh_degree(self.header) + 1).pow(2);
        let stride = self.encoding.gaussian_bytes(bases);
        let lengths =
            [(partial_buckets, 4), (bucket_count, u16_at(self.header, 20).into()), (max_count, stride)];
        let mut rest = bytes;
        let mut parts = [&[][..]; 3];
        for (part, (count, size)) in parts.iter_mut().zip(lengths) {
            let length = count as u128 * size as u128;
            let split = usize::try_from(length).ok().and_then(|length| rest.split_at_checked(length));
            let Some(split) = split else {
                let all: u128 = lengths.iter().map(|&(count, size)| count as u128 * size as u128).sum();
                let found = format!("cut short: {} bytes", bytes.len());
                return Err(self.error("the body", found, format!("{all} bytes")));
            };
            (*part, rest) = split;
        }
        let [partial_lengths, buckets, gaussians] = parts;
        if count > max_count {
            return Err(self.error("the number of Gaussians", count, format!("{max_count} at most")));
        }
        let gaussians = gaussians.chunks_exact(stride).take(count);
        if self.encoding.number_bytes == 4 {
            for gaussian in gaussians {
                splat.means.push([0, 1, 2].map(|axis| f32_at(gaussian, 4 * axis)));
                self.push_others(gaussian, bases, splat);
            }
            return Ok(rest);
        }
        if usize::from(u16_at(self.header, 20)) != BUCKET {
            let found = u16_at(self.header, 20);
            return Err(self.error("the size of a bucket", found, format!("{BUCKET} bytes")));
        }
        let (buckets, _) = buckets.as_chunks::<BUCKET>();
        if full_buckets.saturating_add(partial_buckets) > buckets.len() {
            let expected = format!("{full_buckets} full and {partial_buckets} partially filled ones");
            return Err(self.error("the number of buckets", buckets.len(), expected));
        }
        let range = match u32_at(self.header, 24) {
            0 => DEFAULT_RANGE,
            range => range,
        };
        let half_block = f64::from(f32_at(self.header, 16)) / 2.;
        let full = std::iter::repeat_n(number(8), full_buckets);
        let partial = partial_lengths.as_chunks().0.iter().map(|&length| u32::from_le_bytes(length) as usize);
        let mut centers =
            full.chain(partial).zip(buckets).flat_map(|(length, bucket)| std::iter::repeat_n(bucket, length));
        for (place, gaussian) in gaussians.enumerate() {
            let Some(bucket) = centers.next() else {
                let expected = format!("{count}, as many as in the section");
                return Err(self.error("the number of Gaussians in the buckets", place, expected));
            };
            splat.means.push([0, 1, 2].map(|axis| {
                let step = f64::from(u16_at(gaussian, 2 * axis)) - f64::from(range);
                (step * half_block / f64::from(range) + f64::from(f32_at(bucket, 4 * axis))) as f32
            }));
            self.push_others(gaussian, bases, splat);
        }
        Ok(rest)
    }

    /// Appends the values of a Gaussian to `splat`, except for its position.
    fn push_others(&self, gaussian: &[u8], bases: usize, splat: &mut Splat) {
        let Encoding { number_bytes, sh_bytes, .. } = *self.encoding;
        let number = |index: usize| self.encoding.number(gaussian, index, number_bytes);
        splat.push_linear_scale([3, 4, 5].map(number));
        splat.quaternions.push([6, 7, 8, 9].map(number));
        let (color, harmonics) = gaussian[10 * number_bytes..].split_at(4);
        splat.sh.push([0, 1, 2].map(|channel| color_to_sh0(f64::from(color[channel]) / 255.)));
        splat.opacity_logits.push(logit_of_opacity(f64::from(color[3]) / 255.));
        // Degree by degree, and within a degree channel by channel.
        for degree in 1..bases.isqrt() {
            let (begin, count) = (3 * (degree * degree - 1), 2 * degree + 1);
            splat.sh.extend((0..count).map(|basis| {
                let index = |channel: usize| begin + channel * count + basis;
                [0, 1, 2].map(|channel| self.encoding.number(harmonics, index(channel), sh_bytes))
            }));
        }
        splat.sh.resize(splat.means.len() * splat.bases(), [0.; 3]);
    }
}
