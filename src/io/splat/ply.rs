//! Splats in the PLY layout of 3DGS, which every viewer reads (spec 10.9).
//!
//! Binary little-endian; a vertex has x y z, nx ny nz (zeros), f_dc_0..2, f_rest_*, opacity (a logit), scale_0..2 (logs),
//! rot_0..3 (w, x, y, z). f_rest is channel-major: all reds, all greens, all blues.

use super::Splat;
use crate::error::{Error, Result};
use crate::io::atomic::write_atomically;
use crate::scene::RawGaussians;
use std::path::Path;
use tch::Tensor;

/// Reads a 3DGS splat of any SH degree. Properties are found by name, so their order, and others beside them, don't matter.
///
/// # Errors
/// A file that can't be read, another format, a missing property, a file cut short, a number that isn't finite.
pub(super) fn read(path: &Path) -> Result<Splat> {
    let bytes = std::fs::read(path).map_err(Error::read(path))?;
    let header = Header::parse(path, &bytes)?;
    let (n, stride) = (header.vertices, header.stride);
    let body = &bytes[header.length..];
    if body.len() / stride.max(1) < n {
        let found = format!("cut short: {} bytes of vertices", body.len());
        return Err(Error::input(
            path,
            "the body",
            found,
            format!("{} bytes for {n} vertices", n as u128 * stride as u128),
        ));
    }

    let rest = (0..).take_while(|k| header.offset_of(&format!("f_rest_{k}")).is_some()).count();
    let sh_degree = match rest {
        0 => 0,
        9 => 1,
        24 => 2,
        45 => 3,
        _ => {
            return Err(Error::input(
                path,
                "f_rest_*",
                format!("{rest} properties"),
                "0, 9, 24 or 45 (SH degree 0 to 3)",
            ));
        }
    };
    let bases = (sh_degree + 1) * (sh_degree + 1);

    // [N, count] of the properties named.
    let columns = |names: &[String]| -> Result<Vec<f32>> {
        let offsets = names
            .iter()
            .map(|name| {
                header.offset_of(name).ok_or_else(|| {
                    Error::input(
                        path,
                        format!("property {name}"),
                        "absent",
                        "one of a 3D Gaussian splat's properties",
                    )
                })
            })
            .collect::<Result<Vec<_>>>()?;
        let mut values = Vec::with_capacity(n * names.len());
        for vertex in body.chunks_exact(stride).take(n) {
            for ((offset, scalar), name) in offsets.iter().zip(names) {
                let value = scalar.read(&vertex[*offset..]);
                if !value.is_finite() {
                    let row = values.len() / names.len();
                    return Err(Error::input(
                        path,
                        format!("{name} of vertex {row}"),
                        value,
                        "a finite number",
                    ));
                }
                values.push(value);
            }
        }
        Ok(values)
    };
    let numbered = |prefix: &str, count: i64| (0..count).map(|k| format!("{prefix}{k}")).collect::<Vec<_>>();
    let tensor = |values: Vec<f32>, width: i64| Tensor::from_slice(&values).view([1, n as i64, width]);

    let means = tensor(columns(&["x".into(), "y".into(), "z".into()])?, 3);
    let dc = tensor(columns(&numbered("f_dc_", 3))?, 3).unsqueeze(2); // [1, N, 1, 3]
    let rest = tensor(columns(&numbered("f_rest_", 3 * (bases - 1)))?, 3 * (bases - 1));
    let rest = rest.view([1, n as i64, 3, bases - 1]).transpose(2, 3); // channel-major to basis-major
    let raw = RawGaussians {
        means,
        log_scales: tensor(columns(&numbered("scale_", 3))?, 3),
        quaternions: tensor(columns(&numbered("rot_", 4))?, 4),
        opacity_logits: tensor(columns(&["opacity".into()])?, 1).squeeze_dim(-1),
        sh: Tensor::cat(&[dc, rest], 2),
    };
    Ok(Splat { gaussians: raw.activate() })
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
    if table.isfinite().all().int64_value(&[]) == 0 {
        return Err(Error::Failed(format!("{}: the splat has numbers that aren't finite", path.display())));
    }

    let header = header(n, bases);
    let values = Vec::<f32>::try_from(table.flatten(0, 1))?;
    write_atomically(path, |writer| {
        writer.write_all(header.as_bytes()).map_err(Error::write(path))?;
        values.iter().try_for_each(|v| writer.write_all(&v.to_le_bytes())).map_err(Error::write(path))
    })
}

/// What [`write`] writes before the numbers of `n` Gaussians with `bases` spherical harmonics.
fn header(n: i64, bases: i64) -> String {
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).into();
    let mut numbered = |prefix: &str, count: i64| names.extend((0..count).map(|k| format!("{prefix}{k}")));
    numbered("f_dc_", 3);
    numbered("f_rest_", 3 * (bases - 1));
    names.push("opacity".into());
    let mut numbered = |prefix: &str, count: i64| names.extend((0..count).map(|k| format!("{prefix}{k}")));
    numbered("scale_", 3);
    numbered("rot_", 4);
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {n}\n");
    for name in &names {
        header.push_str(&format!("property float {name}\n"));
    }
    header.push_str("end_header\n");
    header
}

/// Bytes of the file that [`write`] would write.
pub(super) fn size(splat: &Splat) -> u64 {
    /// Position, normal, opacity, scale and rotation.
    const NUMBERS: i64 = 14;
    let (n, bases) = (splat.gaussians.count(), splat.bases());
    header(n, bases).len() as u64 + (n * (NUMBERS + 3 * bases) * 4) as u64
}

/// A number type of the PLY format.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Scalar {
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
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    fn read(self, bytes: &[u8]) -> f32 {
        fn take<const N: usize>(bytes: &[u8]) -> [u8; N] {
            bytes[..N].try_into().expect("the stride covers every property")
        }
        match self {
            Scalar::I8 => f32::from(bytes[0] as i8),
            Scalar::U8 => f32::from(bytes[0]),
            Scalar::I16 => f32::from(i16::from_le_bytes(take(bytes))),
            Scalar::U16 => f32::from(u16::from_le_bytes(take(bytes))),
            Scalar::I32 => i32::from_le_bytes(take(bytes)) as f32,
            Scalar::U32 => u32::from_le_bytes(take(bytes)) as f32,
            Scalar::F32 => f32::from_le_bytes(take(bytes)),
            Scalar::F64 => f64::from_le_bytes(take(bytes)) as f32,
        }
    }
}

/// The vertex element of a PLY header.
struct Header {
    /// Bytes up to the first vertex.
    length: usize,
    vertices: usize,
    stride: usize,
    properties: Vec<(String, usize, Scalar)>,
}

impl Header {
    fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        const END: &[u8] = b"end_header";
        if !bytes.starts_with(b"ply") {
            return Err(Error::input(path, "the file", "no PLY", "a PLY of a 3D Gaussian splat"));
        }
        let end = bytes.windows(END.len()).position(|w| w == END).map(|at| at + END.len());
        let length = end.and_then(|at| bytes[at..].iter().position(|&b| b == b'\n').map(|n| at + n + 1));
        let Some(length) = length else {
            return Err(Error::input(path, "the header", "without its end", "a line end_header"));
        };
        let mut header = Header { length, vertices: 0, stride: 0, properties: vec![] };
        let (mut format, mut element) = (String::new(), String::new());
        for line in String::from_utf8_lossy(&bytes[..length]).lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            match words.as_slice() {
                ["format", name, ..] => format = name.to_string(),
                ["element", name, count] => {
                    if element.is_empty() && *name != "vertex" {
                        return Err(Error::input(path, "the first element", name, "vertex"));
                    }
                    element = name.to_string();
                    if *name == "vertex" {
                        header.vertices = count.parse().map_err(|_| {
                            Error::input(path, "the number of vertices", count, "a whole number")
                        })?;
                    }
                }
                ["property", kind, name] if element == "vertex" => {
                    let scalar = Scalar::parse(kind).ok_or_else(|| {
                        Error::input(path, format!("the type of {name}"), kind, "a PLY number type")
                    })?;
                    header.properties.push((name.to_string(), header.stride, scalar));
                    header.stride += scalar.size();
                }
                ["property", "list", ..] if element == "vertex" => {
                    return Err(Error::input(path, "a vertex property", "a list", "numbers"));
                }
                _ => {}
            }
        }
        if format != "binary_little_endian" {
            return Err(Error::input(path, "the format", format, "binary_little_endian"));
        }
        if element.is_empty() {
            return Err(Error::input(path, "the element vertex", "absent", "the Gaussians"));
        }
        Ok(header)
    }

    fn offset_of(&self, name: &str) -> Option<(usize, Scalar)> {
        self.properties.iter().find(|(n, ..)| n == name).map(|&(_, offset, scalar)| (offset, scalar))
    }
}
