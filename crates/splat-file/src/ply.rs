//! Splats in the PLY layout of 3DGS, which every viewer reads (spec 10.9).
//!
//! A vertex has x y z, nx ny nz (zeros), f_dc_0..2, f_rest_*, opacity (a logit), scale_0..2 (logs), rot_0..3 (w, x, y, z). f_rest is
//! channel-major: all reds, all greens, all blues. Files are written as float32, binary, little-endian.

use crate::invalid::InvalidGaussians;
use crate::numbers::Scalar;
use crate::ply_table::{Header, Kind};
use crate::splat::color_to_sh0;
use crate::{Error, MIN_SCALE, OPACITY_MARGIN, Result, Splat, WriteOptions};
use globalsplat_files::write_atomically;
use std::path::Path;

/// Maximum logarithm of a scale: larger scales exceed float32.
const MAX_LOG_SCALE: f32 = 88.;

/// Names of color channels in point clouds.
const COLORS: [[&str; 3]; 3] =
    [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]];

/// Reads a 3DGS splat of any SH degree, in text or binary of either byte order. Properties are found by name, so their order doesn't
/// matter, and others may be present. Without `scale_2`, as in 2DGS, Gaussians are flat in their third direction; without `f_dc_*` their
/// colors are those of `red`, `green` and `blue`.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let header = Header::parse(path, bytes)?;
    let vertex = header.element("vertex");
    let has = |name: &str| vertex.is_some_and(|vertex| vertex.property(name).is_some());
    if vertex.is_some() && !["opacity", "scale_0", "rot_0"].into_iter().any(has) {
        let found = "a point cloud, without opacity, scale_* and rot_*";
        return Err(Error::input(path, "the element vertex", found, "the properties of a 3D Gaussian splat"));
    }
    let rest = (0..).take_while(|k| has(&format!("f_rest_{k}"))).count();
    let sh_degree = degree_of_rest(path, rest)?;
    let mut splat = Splat { sh_degree, antialiased: header.antialiased, ..Splat::default() };
    let bases = splat.bases();
    let mut names = property_names(bases);
    let colors = COLORS.into_iter().find(|names| names.iter().all(|name| has(name)));
    let colors = colors.filter(|_| !["f_dc_0", "f_dc_1", "f_dc_2"].into_iter().any(has));
    if let Some(colors) = colors {
        names[3..6].clone_from_slice(&colors.map(String::from));
        let said = format!("colors are those of {}, because f_dc_* is missing", colors.join(", "));
        splat.warnings.push(format!("{}: {said}", path.display()));
    }
    let is_flat = !has("scale_2") && has("scale_1");
    if is_flat {
        names.retain(|name| name != "scale_2");
        let said = "Gaussians are flat in their third direction, because scale_2 is missing";
        splat.warnings.push(format!("{}: {said}", path.display()));
    }
    let mut values = header.columns(path, bytes, "vertex", &names, None, |number| number as f32)?;
    if let Some(red) = colors.zip(vertex).and_then(|(colors, vertex)| vertex.property(colors[0])) {
        harmonics_from_colors(red.kind, names.len(), &mut values);
    }
    for vertex in values.chunks_exact(names.len()) {
        let (means, vertex) = vertex.split_at(3);
        let (dc, vertex) = vertex.split_at(3);
        let (rest, vertex) = vertex.split_at(3 * (bases - 1));
        splat.means.push([0, 1, 2].map(|axis| means[axis]));
        splat.sh.push([0, 1, 2].map(|channel| dc[channel]));
        let of_basis = |basis: usize| [0, 1, 2].map(|channel| rest[channel * (bases - 1) + basis]);
        splat.sh.extend((0..bases - 1).map(of_basis));
        splat.opacity_logits.push(vertex[0]);
        splat.log_scales.push(match is_flat {
            true => [vertex[1], vertex[2], MIN_SCALE.ln() as f32],
            false => [1, 2, 3].map(|column| vertex[column]),
        });
        let quaternion = &vertex[vertex.len() - 4..];
        splat.quaternions.push([0, 1, 2, 3].map(|part| quaternion[part]));
    }
    Ok(splat)
}

/// Converts the colors in columns 3 to 5 of a table, which are of type `kind` in the file, to spherical harmonics of degree 0. White is 255
/// for bytes and 65,535 for unsigned 16-bit numbers; for other numbers it is 1, or 255 if any is above 1.
fn harmonics_from_colors(kind: Kind, width: usize, values: &mut [f32]) {
    let colors = values.chunks_exact(width).flat_map(|vertex| &vertex[3..6]);
    let brightest = colors.filter(|color| color.is_finite()).fold(0f32, |a, &b| a.max(b));
    let white = match kind {
        Kind::Number(Scalar::U8) => 255.,
        Kind::Number(Scalar::U16) => 65535.,
        _ if brightest > 1. => 255.,
        _ => 1.,
    };
    for color in values.chunks_exact_mut(width).flat_map(|vertex| &mut vertex[3..6]) {
        *color = color_to_sh0(f64::from(*color) / white);
    }
}

/// Returns the degree of the spherical harmonics for a number of f_rest properties.
pub(crate) fn degree_of_rest(path: &Path, rest: usize) -> Result<usize> {
    [0, 9, 24, 45].into_iter().position(|count| count == rest).ok_or_else(|| {
        let expected = "0, 9, 24 or 45 (SH degree 0 to 3)";
        Error::input(path, "f_rest_*", format!("{rest} properties"), expected)
    })
}

/// Finds Gaussians with values that aren't finite or scales that are too large. Logits of 0 and 1 and the logarithm of 0, which other
/// programs write, are valid.
pub(crate) fn find_invalid(splat: &Splat) -> InvalidGaussians {
    let mut invalid = InvalidGaussians::default();
    let names = property_names(splat.bases());
    for row in 0..splat.len() {
        for (name, value) in names.iter().zip(values_of(splat, row)) {
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

/// Writes a PLY. Infinite logits and logarithms, which not every program reads, become those of [`OPACITY_MARGIN`] and [`MIN_SCALE`].
pub(crate) fn write(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let max_logit = ((1. - OPACITY_MARGIN) / OPACITY_MARGIN).ln() as f32;
    let finite = |number: f32, min: f32, max: f32| match number.is_finite() {
        true => number,
        false => number.clamp(min, max),
    };
    write_atomically(path, |writer| {
        writer.write_all(header(splat).as_bytes()).map_err(Error::write(path))?;
        for index in 0..splat.len() {
            let mut row = values_of(splat, index);
            let [.., opacity, scale_0, scale_1, scale_2, _, _, _, _] = &mut row[..] else { unreachable!() };
            *opacity = finite(*opacity, -max_logit, max_logit);
            for scale in [scale_0, scale_1, scale_2] {
                *scale = finite(*scale, MIN_SCALE.ln() as f32, MAX_LOG_SCALE);
            }
            row.splice(3..3, [0.; 3]); // the normal
            let bytes: Vec<u8> = row.into_iter().flat_map(f32::to_le_bytes).collect();
            writer.write_all(&bytes).map_err(Error::write(path))?;
        }
        Ok(())
    })
}

/// Returns the header that [`write`] writes before the values of the Gaussians.
fn header(splat: &Splat) -> String {
    let mut names = property_names(splat.bases());
    names.splice(3..3, ["nx", "ny", "nz"].map(String::from));
    let properties: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    let first = Header::first_lines(splat.antialiased);
    format!("{first}element vertex {}\n{properties}end_header\n", splat.len())
}

/// Returns the names of a Gaussian's properties, without the normal: position, spherical harmonics, opacity, scale and rotation.
fn property_names(bases: usize) -> Vec<String> {
    let rest: Vec<String> = (0..3 * (bases - 1)).map(|k| format!("f_rest_{k}")).collect();
    let first = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from);
    let last =
        ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(String::from);
    [&first[..], &rest, &last].concat()
}

/// Returns the values of the properties of [`property_names`] of a Gaussian.
fn values_of(splat: &Splat, index: usize) -> Vec<f32> {
    let (dc, rest) = splat.sh_of(index).split_at(1);
    let mut values = [splat.means[index], dc[0]].concat();
    values.extend((0..3).flat_map(|channel| rest.iter().map(move |of_basis| of_basis[channel])));
    values.push(splat.opacity_logits[index]);
    values.extend(splat.log_scales[index].iter().chain(&splat.quaternions[index]));
    values
}

impl Splat {
    /// Returns the size in bytes of the splat as a 3DGS PLY, the format that every program reads.
    pub fn ply_bytes(&self) -> u64 {
        let numbers = property_names(self.bases()).len() + 3;
        header(self).len() as u64 + (self.len() * numbers * size_of::<f32>()) as u64
    }
}
