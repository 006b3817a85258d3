//! Little-endian numbers in the bytes of a file, and how many Gaussians it may hold.

use crate::{Error, Result};
use std::path::Path;

/// Maximum ratio of the Gaussians' size in memory to that of the file, with `MAX_SMALL` bytes allowed in addition. Real splats reach 20.
const MAX_RATIO: u128 = 256;
const MAX_SMALL: u128 = 1 << 24;

/// Gaussians that a compressed file claims to hold.
#[derive(Default)]
pub(crate) struct ClaimedGaussians {
    count: u128,
    /// Size in memory in bytes.
    memory: u128,
}

impl ClaimedGaussians {
    /// Adds `count` Gaussians, and checks that files of `size` bytes may hold all of them. Call it before memory is allocated.
    pub fn add(&mut self, path: &Path, count: usize, sh_degree: usize, size: usize) -> Result<()> {
        let numbers = 3 + 3 + 4 + 1 + 3 * (sh_degree + 1).pow(2);
        self.count += count as u128;
        self.memory += count as u128 * (numbers * size_of::<f32>()) as u128;
        if self.memory <= MAX_SMALL + MAX_RATIO * size as u128 {
            return Ok(());
        }
        let found = format!("{}, which take {} bytes of memory", self.count, self.memory);
        let expected =
            format!("at most {} MiB plus {MAX_RATIO} times the file's {size} bytes", MAX_SMALL >> 20);
        Err(Error::input(path, "the number of Gaussians", found, expected))
    }
}

/// Type of a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    /// Returns the size of a number in bytes.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Returns the number at the beginning of `bytes`, which are at least as many as its size.
    pub fn read(self, bytes: &[u8]) -> f64 {
        match self {
            Scalar::I8 => f64::from(bytes[0] as i8),
            Scalar::U8 => f64::from(bytes[0]),
            Scalar::I16 => f64::from(u16_at(bytes, 0) as i16),
            Scalar::U16 => f64::from(u16_at(bytes, 0)),
            Scalar::I32 => f64::from(u32_at(bytes, 0) as i32),
            Scalar::U32 => f64::from(u32_at(bytes, 0)),
            Scalar::F32 => f64::from(f32_at(bytes, 0)),
            Scalar::F64 => f64::from_le_bytes(bytes_at(bytes, 0)),
        }
    }
}

fn bytes_at<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    *bytes[at..].first_chunk().expect("bytes that are long enough")
}

/// Returns the number at byte `at` of `bytes`, which must be long enough.
pub(crate) fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(bytes_at(bytes, at))
}

/// Returns the number at byte `at` of `bytes`, which must be long enough.
pub(crate) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes_at(bytes, at))
}

/// Returns the number at byte `at` of `bytes`, which must be long enough.
pub(crate) fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes_at(bytes, at))
}
