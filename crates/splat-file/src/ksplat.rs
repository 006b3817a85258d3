//! mkkellogg's `.ksplat` format, versions 0.1 and later, which is only read. A header of 4,096 bytes and one of 1,024 bytes per section
//! are followed by the sections. From compression level 1, positions are relative to the centers of buckets of Gaussians.

use crate::numbers::{f32_at, u16_at, u32_at};
use crate::splat::{color_to_sh0, logit_of_opacity};
use crate::{Error, Result, Splat};
use half::f16;
use std::fmt::Display;
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

/// Reads a `.ksplat`.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let refuse =
        |field: &str, found: String, expected: String| Err(Error::input(path, field, found, expected));
    if bytes.len() < HEADER {
        return refuse("the header", format!("{} bytes", bytes.len()), format!("{HEADER} bytes"));
    }
    let (major, minor) = (bytes[0], bytes[1]);
    if major != 0 || minor < 1 {
        return refuse("the version", format!("{major}.{minor}"), "0.1 or later below 1".into());
    }
    let level = u16_at(bytes, 20);
    if level > 2 {
        return refuse("the compression level", level.to_string(), "0 to 2".into());
    }
    let bound = |at: usize, default: f32| match f32_at(bytes, at) {
        0. => default,
        bound => bound,
    };
    let sh_range = [bound(36, -DEFAULT_SH_RANGE), bound(40, DEFAULT_SH_RANGE)].map(f64::from);
    let [number_bytes, sh_bytes] = [[4, 4], [2, 2], [2, 1]][usize::from(level)];
    let (section_count, count) = (u32_at(bytes, 4) as usize, u32_at(bytes, 16) as usize);
    let headers_length = section_count.saturating_mul(SECTION_HEADER);
    let Some((headers, mut rest)) = bytes[HEADER..].split_at_checked(headers_length) else {
        let most = (bytes.len() - HEADER) / SECTION_HEADER;
        let expected = format!("{most} at most in a file of {} bytes", bytes.len());
        return refuse("the number of sections", section_count.to_string(), expected);
    };
    let section = |(index, header)| Section { path, index, header, number_bytes, sh_bytes, sh_range };
    let sections = headers.as_chunks().0.iter().enumerate().map(section).collect::<Vec<_>>();
    let sh_degree = sections.iter().map(Section::sh_degree).max().unwrap_or(0);
    if sh_degree > 3 {
        return refuse("the SH degree", sh_degree.to_string(), "0 to 3".into());
    }
    let mut splat = Splat { sh_degree, linear_scales: Some(vec![]), ..Splat::default() };
    for section in sections {
        rest = section.read(rest, &mut splat)?;
    }
    if splat.is_empty() || splat.len() != count {
        let found = format!("{count}, with {} in the sections", splat.len());
        return refuse("the number of Gaussians", found, "1 or more, as many in the sections".into());
    }
    Ok(splat)
}

/// Section of a file: Gaussians with the same layout.
struct Section<'a> {
    path: &'a Path,
    index: usize,
    header: &'a [u8; SECTION_HEADER],
    /// Size in bytes of a position's coordinate, which above compression level 0 is an integer, of a scale and of a quaternion's component:
    /// 4 for float32, 2 for float16.
    number_bytes: usize,
    /// Size in bytes of an SH coefficient, which may also be a byte.
    sh_bytes: usize,
    /// SH coefficients of the bytes 0 and 255.
    sh_range: [f64; 2],
}

impl Section<'_> {
    fn error(&self, field: &str, found: impl Display, expected: String) -> Error {
        Error::input(self.path, format!("{field} of section {}", self.index), found, expected)
    }

    /// Returns the degree of the spherical harmonics, which is 0 if there are no Gaussians.
    fn sh_degree(&self) -> usize {
        if u32_at(self.header, 4) == 0 { 0 } else { u16_at(self.header, 40).into() }
    }

    /// Appends the Gaussians of the section, with which `bytes` begin, to `splat`, whose SH degree is at least that of the section. Returns
    /// the bytes after the section.
    fn read<'b>(&self, bytes: &'b [u8], splat: &mut Splat) -> Result<&'b [u8]> {
        let number = |at: usize| u32_at(self.header, at) as usize;
        let (count, max_count, bucket_count) = (number(0), number(4), number(12));
        let (full_buckets, partial_buckets) = (number(32), number(36));
        let (bucket_bytes, bases) = (u16_at(self.header, 20), (self.sh_degree() + 1).pow(2));
        // Position, scale and quaternion, then color and opacity, then spherical harmonics.
        let stride = 10 * self.number_bytes + 4 + 3 * (bases - 1) * self.sh_bytes;
        let lengths = [(partial_buckets, 4), (bucket_count, bucket_bytes.into()), (max_count, stride)];
        let lengths = lengths.map(|(count, size)| count.saturating_mul(size));
        let length = lengths.iter().fold(0usize, |sum, &length| sum.saturating_add(length));
        let Some((mut parts, rest)) = bytes.split_at_checked(length) else {
            let found = format!("cut short: {} bytes", bytes.len());
            return Err(self.error("the body", found, format!("{length} bytes")));
        };
        let [partial_lengths, buckets, gaussians] =
            lengths.map(|length| parts.split_off(..length).expect("their sum"));
        if count > max_count {
            return Err(self.error("the number of Gaussians", count, format!("{max_count} at most")));
        }
        let gaussians = gaussians.chunks_exact(stride).take(count);
        if self.number_bytes == 4 {
            for gaussian in gaussians {
                splat.means.push([0, 4, 8].map(|at| f32_at(gaussian, at)));
                self.push_others(gaussian, bases, splat);
            }
            return Ok(rest);
        }
        if usize::from(bucket_bytes) != BUCKET {
            return Err(self.error("the size of a bucket", bucket_bytes, format!("{BUCKET} bytes")));
        }
        let (buckets, _) = buckets.as_chunks::<BUCKET>();
        if full_buckets.saturating_add(partial_buckets) > buckets.len() {
            let expected = format!("{full_buckets} full and {partial_buckets} partially filled ones");
            return Err(self.error("the number of buckets", buckets.len(), expected));
        }
        let range = f64::from(match u32_at(self.header, 24) {
            0 => DEFAULT_RANGE,
            range => range,
        });
        let half_block = f64::from(f32_at(self.header, 16)) / 2.;
        let full = std::iter::repeat_n(number(8), full_buckets);
        let partial = partial_lengths.as_chunks().0.iter().map(|&length| u32::from_le_bytes(length) as usize);
        let lengths = full.chain(partial).zip(buckets);
        let mut centers = lengths.flat_map(|(length, bucket)| std::iter::repeat_n(bucket, length));
        for (place, gaussian) in gaussians.enumerate() {
            let Some(bucket) = centers.next() else {
                let expected = format!("{count}, as many as in the section");
                return Err(self.error("the number of Gaussians in the buckets", place, expected));
            };
            splat.means.push([0, 1, 2].map(|axis| {
                let step = f64::from(u16_at(gaussian, 2 * axis)) - range;
                (step * half_block / range + f64::from(f32_at(bucket, 4 * axis))) as f32
            }));
            self.push_others(gaussian, bases, splat);
        }
        Ok(rest)
    }

    /// Appends the values of a Gaussian to `splat`, except for its position.
    fn push_others(&self, gaussian: &[u8], bases: usize, splat: &mut Splat) {
        let number = |index: usize| self.number(gaussian, index, self.number_bytes);
        splat.push_linear_scale([3, 4, 5].map(number));
        splat.quaternions.push([6, 7, 8, 9].map(number));
        let (color, harmonics) = gaussian[10 * self.number_bytes..].split_at(4);
        splat.sh.push([0, 1, 2].map(|channel| color_to_sh0(f64::from(color[channel]) / 255.)));
        splat.opacity_logits.push(logit_of_opacity(f64::from(color[3]) / 255.));
        // Degree by degree, and within a degree channel by channel.
        for degree in 1..bases.isqrt() {
            let (begin, count) = (3 * (degree * degree - 1), 2 * degree + 1);
            splat.sh.extend((0..count).map(|basis| {
                let index = |channel: usize| begin + channel * count + basis;
                [0, 1, 2].map(|channel| self.number(harmonics, index(channel), self.sh_bytes))
            }));
        }
        splat.sh.resize(splat.means.len() * splat.bases(), [0.; 3]);
    }

    /// Returns number `index` of those in `bytes`, each of `size` bytes.
    fn number(&self, bytes: &[u8], index: usize, size: usize) -> f32 {
        let [min, max] = self.sh_range;
        match size {
            4 => f32_at(bytes, 4 * index),
            2 => f16::from_bits(u16_at(bytes, 2 * index)).to_f32(),
            _ => (min + f64::from(bytes[index]) / 255. * (max - min)) as f32,
        }
    }
}
