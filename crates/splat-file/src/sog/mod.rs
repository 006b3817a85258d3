//! PlayCanvas' SOG, version 2 (spec 10.19): the properties of all Gaussians as lossless WebP images and a `meta.json`, together in a ZIP archive (`.sog`)
//! or as files in a folder (`meta.json`). The pixel at x, y of each image belongs to Gaussian x + width · y. The axes are a PLY's.

mod codec;
mod container;
mod palette;

pub(crate) use codec::{CODEC, FOLDER_CODEC, IMAGES};

/// Returns `true` if `bytes` are a ZIP archive, which no other format is.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04")
}
