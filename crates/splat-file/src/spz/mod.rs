//! Niantic's SPZ (spec 10.13): a byte for most values, grouped by kind over all Gaussians, compressed. Versions 1 to 4 are read, versions
//! 2 to 4 are written. Rotations of version 2 have 8 bits per component, those of later versions 10.

#[cfg(feature = "spz")]
mod codec;
#[cfg(feature = "spz")]
mod container;

#[cfg(feature = "spz")]
pub(crate) use codec::CODEC;

/// The functions of the format are absent from a build without the feature `spz`.
#[cfg(not(feature = "spz"))]
pub(crate) const CODEC: Option<crate::codec::Codec> = None;

/// First bytes of every version, after gzip is decompressed.
const MAGIC: [u8; 4] = *b"NGSP";
/// First bytes of gzip. In the next byte, the flags, the upper three bits are 0.
const GZIP: [u8; 3] = [0x1f, 0x8b, 8];

/// Returns `true` if `bytes` begin like an SPZ of any version.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC) || (bytes.starts_with(&GZIP) && bytes.get(3).is_some_and(|flags| flags < &0x20))
}
