//! Splats in glTF 2.0: mesh primitives of points with the extension KHR_gaussian_splatting, in a `.glb`, or in a `.gltf` and the files that
//! it refers to. Scales and opacities are linear. The axes are half a turn about z away from those of other formats, so that y is up.

mod document;
mod read;
mod write;

pub(crate) use read::read;
pub(crate) use write::{buffer_file, write_glb, write_gltf};

/// Name of the extension, with which its attributes begin.
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Name of the extension that compresses the Gaussians of a primitive as an SPZ.
const SPZ_EXTENSION: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Value of `kernel`, for Gaussians as 3DGS projects them.
const KERNEL: &str = "ellipse";
/// Value of `colorSpace`, for the colors that 3DGS is trained with.
const COLOR_SPACE: &str = "srgb_rec709_display";
/// Value of `mode` of primitives of points.
const POINTS: u32 = 0;
/// First bytes of a `.glb`.
const MAGIC: [u8; 4] = *b"glTF";

/// Returns `true` if `bytes` are a `.glb`.
pub(crate) fn recognizes_glb(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC)
}

/// Returns the name of the attribute of a spherical harmonic, counted from 0 within its degree.
fn sh_attribute(degree: usize, index: usize) -> String {
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}")
}

/// Turns the rotation (w, x, y, z) by half a turn about z, from the axes of other formats to those of glTF: the product of the quaternion
/// (0, 0, 0, 1) and this one, which other programs write, too. [`Axes::rotation`](crate::axes::Axes::rotation) differs by half a turn about
/// the Gaussian's own z axis, which doesn't change the Gaussian.
fn rotation_to_gltf([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [-z, -y, x, w]
}

/// Inverts [`rotation_to_gltf`].
fn rotation_from_gltf([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [z, y, -x, -w]
}
