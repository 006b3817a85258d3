//! Splats in the PLY layout of 3DGS, which every viewer reads (spec 10.9).
//!
//! A vertex has x y z, nx ny nz (zeros), f_dc_0..2, f_rest_*, opacity (a logit), scale_0..2 (logs), rot_0..3 (w, x, y, z). f_rest is
//! channel-major: all reds, all greens, all blues. Files are written as float32, binary, little-endian.

use super::invalid::InvalidGaussians;
use super::ply_body::columns;
use super::ply_header::{Header, Scalar};
use super::{Contents, Splat, all_finite};
use crate::error::{Error, Result};
use crate::render::HarmonicLimits;
use crate::scene::{MIN_SCALE, RawGaussians, SH_C0};
use globalsplat_files::write_atomically;
use std::path::Path;
use tch::{Device, Kind, Tensor};

/// Maximum logarithm of a scale: larger scales exceed float32.
const MAX_LOG_SCALE: f32 = 88.;

/// Names of colour channels in point clouds.
const COLOURS: [[&str; 3]; 3] =
    [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]];

/// Returns `true` if `bytes` begin like a PLY.
pub(super) fn recognizes(bytes: &[u8]) -> bool {
    Header::begins(bytes)
}

/// Reads a 3DGS splat of any SH degree, in text or binary of either byte order. Properties are found by name, so their order doesn't
/// matter, and others may be present. Without `scale_2`, as in 2DGS, Gaussians are flat in their third direction; without `f_dc_*` their
/// colours are those of `red`, `green` and `blue`.
///
/// # Errors
/// Returns an error if a property is missing, or if the file is a point cloud or truncated.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
    let header = Header::parse(path, bytes)?;
    let vertex = header.element("vertex");
    let has = |name: &str| vertex.is_some_and(|vertex| vertex.has(name));
    if vertex.is_some() && !["opacity", "scale_0", "rot_0"].into_iter().any(has) {
        let found = "a point cloud, without opacity, scale_* and rot_*";
        return Err(Error::input(path, "the element vertex", found, "the properties of a 3D Gaussian splat"));
    }
    let rest = (0..).take_while(|k| has(&format!("f_rest_{k}"))).count();
    let bases = bases_of_rest(path, rest)?;
    let mut names: Vec<String> = [owned(["x", "y", "z"]), sh_names(bases), shape_names()].concat();
    let mut warnings = vec![];
    let colours = COLOURS.into_iter().find(|names| names.iter().all(|name| has(name)));
    let colours = colours.filter(|_| !["f_dc_0", "f_dc_1", "f_dc_2"].into_iter().any(has));
    if let Some(colours) = colours {
        names[3..6].clone_from_slice(&owned(colours));
        let said = format!("colours are those of {}, for want of f_dc_*", colours.join(", "));
        warnings.push(format!("{}: {said}", path.display()));
    }
    let is_flat = !has("scale_2") && has("scale_1");
    if is_flat {
        names.retain(|name| name != "scale_2");
        let said = "Gaussians are flat in their third direction, for want of scale_2";
        warnings.push(format!("{}: {said}", path.display()));
    }
    let mut values = columns(path, bytes, &header, "vertex", &names, |number| number as f32)?;
    if let Some((colours, vertex)) = colours.zip(vertex) {
        harmonics_from_colours(vertex.scalar(colours[0]), names.len(), &mut values);
    }
    let invalid = find_invalid(&names, &values);

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
    let opacity_logits = next(1).squeeze_dim(-1);
    let log_scales = match is_flat {
        true => {
            Tensor::cat(&[next(2), Tensor::full([1, n, 1], MIN_SCALE.ln(), (Kind::Float, Device::Cpu))], 2)
        }
        false => next(3),
    };
    let sh = Tensor::cat(&[dc, rest], 2);
    let raw = RawGaussians { means, opacity_logits, log_scales, quaternions: next(4), sh };
    Ok(Contents { gaussians: raw.activate(), invalid, warnings })
}

/// Converts the colours in columns 3 to 5 of a table, which are numbers of type `scalar` in the file, to spherical harmonics of degree 0.
/// White is 255 for bytes and 65,535 for unsigned 16-bit numbers; for other numbers it is 1, or 255 if any is above 1.
fn harmonics_from_colours(scalar: Option<Scalar>, width: usize, values: &mut [f32]) {
    let colours = values.chunks_exact(width).flat_map(|vertex| &vertex[3..6]);
    let brightest = colours.filter(|colour| colour.is_finite()).fold(0f32, |a, &b| a.max(b));
    let white = match scalar {
        Some(Scalar::U8) => 255.,
        Some(Scalar::U16) => 65535.,
        _ if brightest > 1. => 255.,
        _ => 1.,
    };
    for colour in values.chunks_exact_mut(width).flat_map(|vertex| &mut vertex[3..6]) {
        *colour = ((f64::from(*colour) / white - 0.5) / SH_C0) as f32;
    }
}

/// Returns the number of spherical harmonics per colour channel for a number of f_rest properties.
pub(super) fn bases_of_rest(path: &Path, rest: usize) -> Result<i64> {
    match rest {
        0 | 9 | 24 | 45 => Ok(rest as i64 / 3 + 1),
        _ => {
            let expected = "0, 9, 24 or 45 (SH degree 0 to 3)";
            Err(Error::input(path, "f_rest_*", format!("{rest} properties"), expected))
        }
    }
}

/// Finds Gaussians with values that aren't finite or scales that are too large. Logits of 0 and 1 and the logarithm of 0, which other
/// programs write, are valid.
fn find_invalid(names: &[String], values: &[f32]) -> InvalidGaussians {
    let mut invalid = InvalidGaussians::default();
    for (row, vertex) in values.chunks_exact(names.len()).enumerate() {
        for (name, &value) in names.iter().zip(vertex) {
            let is_scale = name.starts_with("scale_");
            let may_be_infinite =
                (name == "opacity" && !value.is_nan()) || (is_scale && value == f32::NEG_INFINITY);
            let field = || format!("{name} of vertex {row}");
            if !value.is_finite() && !may_be_infinite {
                invalid.add(row, name, field, value, "a finite number");
            } else if is_scale && value > MAX_LOG_SCALE {
                invalid.add(row, name, field, value, &format!("a logarithm of at most {MAX_LOG_SCALE}"));
            }
        }
    }
    invalid
}

/// Returns the limits of coefficients: a PLY can hold any number.
pub(super) fn limits() -> HarmonicLimits {
    HarmonicLimits::up_to(3)
}

/// Writes one scene, [1, N, ..], atomically.
///
/// # Errors
/// Returns an error if a value isn't finite, or if the file can't be written.
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

/// Returns the header that [`write`] writes before the values of `n` Gaussians with `bases` spherical harmonics.
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

/// Returns the size in bytes of the file that [`write`] would write.
pub(super) fn size(splat: &Splat) -> u64 {
    /// Number of values of position, normal, opacity, scale and rotation.
    const NUMBERS: i64 = 14;
    let (n, bases) = (splat.gaussians.count(), splat.bases());
    header(n, bases).len() as u64 + (n * (NUMBERS + 3 * bases) * 4) as u64
}
