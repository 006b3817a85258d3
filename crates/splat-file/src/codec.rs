//! Interface of a format's module: its functions, and what they take and return. [`formats`](crate::formats) lists the formats.

use crate::invalid::InvalidGaussians;
use crate::{Result, ShLimits, Splat};
use std::path::Path;

/// Choices within a format.
#[derive(Debug, Clone)]
pub struct WriteOptions {
    /// Version of SPZ, 2 to 4. Programs from before 2026 read versions up to 3.
    pub spz_version: u32,
}

impl Default for WriteOptions {
    fn default() -> Self {
        WriteOptions { spz_version: 4 }
    }
}

/// Contents of a file as a format's reader returns them, before its Gaussians are checked.
pub(crate) struct Contents {
    pub splat: Splat,
    pub invalid: InvalidGaussians,
}

/// Functions of a format.
pub(crate) struct Codec {
    pub read: fn(&Path, &[u8]) -> Result<Contents>,
    /// Functions that write the format, or `None` if it is only read.
    pub writer: Option<Writer>,
}

/// Functions that write a format.
pub(crate) struct Writer {
    pub write: fn(&Path, &Splat, &WriteOptions) -> Result<()>,
    pub limits: fn() -> ShLimits,
    /// Function that rounds SH coefficients above degree 0 as the format does, if it has a palette of them.
    pub round_sh: Option<fn(&Splat) -> Splat>,
}

impl Writer {
    /// Creates the functions of a format without a palette.
    pub const fn new(
        write: fn(&Path, &Splat, &WriteOptions) -> Result<()>,
        limits: fn() -> ShLimits,
    ) -> Self {
        Writer { write, limits, round_sh: None }
    }
}
