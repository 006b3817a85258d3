//! Splats in the PLY layout of 3DGS, which every viewer reads (spec 10.9).
//!
//! A vertex has x y z, nx ny nz (zeros), f_dc_0..2, f_rest_*, opacity (a logit), scale_0..2 (logs), rot_0..3 (w, x, y, z).
//! f_rest is channel-major: all reds, all greens, all blues. Written is float32, binary, little-endian.

use super::ply_body::columns;
use super::ply_header::Header;
use super::{Splat, all_finite};
use crate::error::{Error, Result};
use crate::io::atomic::write_atomically;
use crate::render::HarmonicLimits;
use crate::scene::RawGaussians;
use glam::DVec3;
use std::path::Path;
use tch::Tensor;

/// Larger logarithms of scales aren't those of a float32.
const MAX_LOG_SCALE: f32 = 88.;

/// Whether `bytes` are a PLY's.
pub(super) fn recognizes(bytes: &[u8]) -> bool {
    Header::begins(bytes)
}

/// Reads a 3DGS splat of any SH degree, in text or binary of either byte order. Properties are found by name, so their order,
/// and others beside them, don't matter.
///
/// # Errors
/// A missing property, a file cut short, a number that isn't finite.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let header = Header::parse(path, bytes)?;
    let rest = match header.element("vertex") {
        Some(vertex) => (0..).take_while(|k| vertex.has(&format!("f_rest_{k}"))).count(),
        None => 0,
    };
    let bases = bases_of_rest(path, rest)?;
    let names: Vec<String> = [owned(["x", "y", "z"]), sh_names(bases), shape_names()].concat();
    let values = columns(path, bytes, &header, "vertex", &names, |number| number as f32)?;
    check(path, &names, &values)?;

    let (n, width) = ((values.len() / names.len()) as i64, names.len() as i64);
    let table = Tensor::from_slice(&values).view([1, n, width]);
    let mut at = 0;
    let mut next = |width: i64| {
        at += width;
        table.narrow(2, at - width, width).contiguous()
    };
    let means = next(3);
    let dc = next(3).unsqueeze(2); // [1, N, 1, 3]
    let rest = next(3 * (bases - 1)).view([1, n, 3, bases - 1]).transpose(2, 3); // channel-major to basis-major
    let raw = RawGaussians {
        means,
        opacity_logits: next(1).squeeze_dim(-1),
        log_scales: next(3),
        quaternions: next(4),
        sh: Tensor::cat(&[dc, rest], 2),
    };
    Ok(Splat { gaussians: raw.activate(), origin: DVec3::ZERO })
}

/// Spherical harmonics of a colour channel, where there are so many f_rest.
pub(super) fn bases_of_rest(path: &Path, rest: usize) -> Result<i64> {
    match rest {
        0 | 9 | 24 | 45 => Ok(rest as i64 / 3 + 1),
        _ => {
            let expected = "0, 9, 24 or 45 (SH degree 0 to 3)";
            Err(Error::input(path, "f_rest_*", format!("{rest} properties"), expected))
        }
    }
}

/// Numbers have to be finite, but for logits of 0 and 1 and the logarithm of 0, which other programs write.
fn check(path: &Path, names: &[String], values: &[f32]) -> Result<()> {
    for (row, vertex) in values.chunks_exact(names.len()).enumerate() {
        for (name, &value) in names.iter().zip(vertex) {
            let is_scale = name.starts_with("scale_");
            let infinite = (name == "opacity" && !value.is_nan()) || (is_scale && value == f32::NEG_INFINITY);
            if !value.is_finite() && !infinite {
                return Err(Error::input(path, format!("{name} of vertex {row}"), value, "a finite number"));
            }
            if is_scale && value > MAX_LOG_SCALE {
                let expected = format!("a logarithm of at most {MAX_LOG_SCALE}");
                return Err(Error::input(path, format!("{name} of vertex {row}"), value, expected));
            }
        }
    }
    Ok(())
}

/// Any number is one of a PLY.
pub(super) fn limits() -> HarmonicLimits {
    HarmonicLimits::up_to(3)
}

/// Writes one scene, [1, N, ..], whole or not at all.
///
/// # Errors
/// Gaussians with numbers that aren't finite, or the system's refusal to write.
pub(super) fn write(path: &Path, splat: &Splat) -> Result<()> {
    let (n, bases) = (splat.gaussians.count(), splat.bases());
    let g = RawGaussians::of(&splat.gaussians);
    let dc = g.sh.narrow(2, 0, 1).view([n, 3]);
    let rest =
        g.sh.narrow(2, 1, bases - 1).view([n, bases - 1, 3]).transpose(1, 2).reshape([n, 3 * (bases - 1)]);
    let means = g.means.view([n, 3]);
    let normals = means.zeros_like();
    let (logits, log_scales) = (g.opacity_logits.view([n, 1]), g.log_scales.view([n, 3]));
    let table = Tensor::cat(&[means, normals, dc, rest, logits, log_scales, g.quaternions.view([n, 4])], 1);
    all_finite(path, &table)?;

    let header = header(n, bases);
    let values = Vec::<f32>::try_from(table.flatten(0, 1))?;
    write_atomically(path, |writer| {
        writer.write_all(header.as_bytes()).map_err(Error::write(path))?;
        values.iter().try_for_each(|v| writer.write_all(&v.to_le_bytes())).map_err(Error::write(path))
    })
}

/// What [`write`] writes before the numbers of `n` Gaussians with `bases` spherical harmonics.
fn header(n: i64, bases: i64) -> String {
    let means_and_normals = owned(["x", "y", "z", "nx", "ny", "nz"]);
    let names = [means_and_normals, sh_names(bases), shape_names()].concat();
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {n}\n");
    for name in &names {
        header.push_str(&format!("property float {name}\n"));
    }
    header.push_str("end_header\n");
    header
}

fn owned<const N: usize>(names: [&str; N]) -> Vec<String> {
    names.map(String::from).into()
}

fn sh_names(bases: i64) -> Vec<String> {
    let dc = (0..3).map(|k| format!("f_dc_{k}"));
    dc.chain((0..3 * (bases - 1)).map(|k| format!("f_rest_{k}"))).collect()
}

fn shape_names() -> Vec<String> {
    let names = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    owned(names)
}

/// Bytes of the file that [`write`] would write.
pub(super) fn size(splat: &Splat) -> u64 {
    /// Position, normal, opacity, scale and rotation.
    const NUMBERS: i64 = 14;
    let (n, bases) = (splat.gaussians.count(), splat.bases());
    header(n, bases).len() as u64 + (n * (NUMBERS + 3 * bases) * 4) as u64
}
