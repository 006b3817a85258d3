//! Writes splats as glTF: one primitive with float32 attributes, and colors of bytes for programs that show points only.

use super::container::encode_percent;
use super::{COLOR_SPACE, EXTENSION, KERNEL, MAGIC, POINTS, sh_attribute, turn_rotation};
use crate::axes::Axes;
use crate::codec::WriteOptions;
use crate::{Error, Result, SH_C0, Splat};
use globalsplat_files::{write_atomically, write_temporary};
use serde_json::{Map, Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Codes of component types.
const UNSIGNED_BYTE: u32 = 5121;
const FLOAT: u32 = 5126;
/// Code of buffer views with attributes.
const ARRAY_BUFFER: u32 = 34962;
/// Maximum difference from 1 of the squared length of a quaternion that is written unchanged.
const UNIT_TOLERANCE: f64 = 1e-6;

/// Returns the path of the buffer that [`write_gltf`] writes beside the `.gltf` at `path`.
pub(crate) fn buffer_file(path: &Path) -> PathBuf {
    path.with_extension("bin")
}

/// Writes a `.glb`.
///
/// # Errors
/// Returns an error if there is no Gaussian, or more than 4 GiB, or the file can't be written.
pub fn write_glb(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let attributes = attributes(path, splat)?;
    let mut json = document(&attributes, splat, None).to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let body = size(&attributes, splat);
    let length = 12 + 8 + json.len() + 8 + body;
    let (Ok(length), Ok(body)) = (u32::try_from(length), u32::try_from(body)) else {
        return Err(Error::failed(format!(
            "{}: a .glb holds less than 4 GiB, found {length} bytes, which a .gltf would hold",
            path.display()
        )));
    };
    let header = [MAGIC, 2u32.to_le_bytes(), length.to_le_bytes()];
    let json_header = [(json.len() as u32).to_le_bytes(), *b"JSON"];
    let body_header = [body.to_le_bytes(), *b"BIN\0"];
    write_atomically(path, |writer| {
        for part in [header.as_flattened(), json_header.as_flattened(), &json, body_header.as_flattened()] {
            writer.write_all(part).map_err(Error::write(path))?;
        }
        write_buffer(writer, &attributes, splat).map_err(Error::write(path))
    })
}

/// Writes a `.gltf`, and its buffer in the file of [`buffer_file`]. Both files are complete before either replaces an older one.
///
/// # Errors
/// Returns an error if there is no Gaussian, or the name isn't UTF-8, or a file can't be written.
pub fn write_gltf(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let attributes = attributes(path, splat)?;
    let file = buffer_file(path);
    let Some(name) = file.file_name().and_then(|name| name.to_str()) else {
        return Err(Error::failed(format!("{}: the name of a .gltf must be UTF-8", path.display())));
    };
    let json = format!("{:#}\n", document(&attributes, splat, Some(name)));
    let buffer = write_temporary(&file, |writer| {
        write_buffer(writer, &attributes, splat).map_err(Error::write(&file))
    })?;
    let gltf = write_temporary(path, |writer| writer.write_all(json.as_bytes()).map_err(Error::write(path)))?;
    buffer.persist()?;
    gltf.persist()
}

/// Attribute of a primitive, which is written for all Gaussians.
struct Attribute {
    name: String,
    values: Values,
}

/// Kind of values of an attribute.
#[derive(Clone, Copy, PartialEq)]
enum Values {
    Position,
    Color,
    Rotation,
    Scale,
    Opacity,
    /// Index of a basis of the spherical harmonics, and its factor in glTF's axes.
    Harmonic(usize, f32),
}

impl Values {
    /// Returns the type, the component type and the size in bytes.
    fn layout(self) -> (&'static str, u32, usize) {
        match self {
            Values::Color => ("VEC4", UNSIGNED_BYTE, 4),
            Values::Rotation => ("VEC4", FLOAT, 16),
            Values::Opacity => ("SCALAR", FLOAT, 4),
            Values::Position | Values::Scale | Values::Harmonic(..) => ("VEC3", FLOAT, 12),
        }
    }

    /// Appends the value of Gaussian `index` to `bytes`.
    fn append(self, splat: &Splat, index: usize, bytes: &mut Vec<u8>) {
        let mut append =
            |numbers: &[f32]| bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        match self {
            Values::Position => append(&Axes::LUF.position(splat.means[index])),
            Values::Rotation => {
                let [w, x, y, z] = turn_rotation(unit_quaternion(splat, index));
                append(&[x, y, z, w]);
            }
            Values::Scale => append(&splat.scale(index)),
            Values::Opacity => append(&[splat.opacity(index)]),
            Values::Harmonic(basis, sign) => append(&splat.sh_of(index)[basis].map(|channel| sign * channel)),
            Values::Color => {
                let color = splat.sh_of(index)[0].map(|dc| f64::from(dc) * SH_C0 + 0.5);
                let byte = |number: f64| (number * 255.).round() as u8; // clamps to 0 and 255
                bytes.extend(color.map(byte));
                bytes.push(byte(splat.opacity(index).into()));
            }
        }
    }
}

/// Returns the quaternion of Gaussian `index` with length 1. One that has this length already, but for rounding, keeps its bits.
fn unit_quaternion(splat: &Splat, index: usize) -> [f32; 4] {
    let quaternion = splat.quaternions[index];
    let squared: f64 = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum();
    if (squared - 1.).abs() < UNIT_TOLERANCE { quaternion } else { splat.unit_quaternion(index) }
}

/// Returns the attributes in the order in which they are written.
///
/// # Errors
/// Returns an error if there is no Gaussian: glTF has no empty accessors.
fn attributes(path: &Path, splat: &Splat) -> Result<Vec<Attribute>> {
    if splat.is_empty() {
        let message = format!("{}: glTF holds one Gaussian at least, found 0", path.display());
        return Err(Error::failed(message));
    }
    let own = |name: &str| format!("{EXTENSION}:{name}");
    let mut attributes = vec![
        Attribute { name: "POSITION".into(), values: Values::Position },
        Attribute { name: "COLOR_0".into(), values: Values::Color },
        Attribute { name: own("ROTATION"), values: Values::Rotation },
        Attribute { name: own("SCALE"), values: Values::Scale },
        Attribute { name: own("OPACITY"), values: Values::Opacity },
    ];
    let signs = std::iter::once(1.).chain(Axes::LUF.harmonics());
    for (basis, sign) in (0..splat.bases()).zip(signs) {
        let degree = basis.isqrt();
        let name = sh_attribute(degree, basis - degree * degree);
        attributes.push(Attribute { name, values: Values::Harmonic(basis, sign) });
    }
    Ok(attributes)
}

/// Returns the size of the buffer in bytes.
fn size(attributes: &[Attribute], splat: &Splat) -> usize {
    attributes.iter().map(|attribute| attribute.values.layout().2 * splat.len()).sum()
}

/// Returns the JSON. The buffer is in the file `buffer` or, if there is none, in the binary chunk.
fn document(attributes: &[Attribute], splat: &Splat, buffer: Option<&str>) -> Value {
    let (mut views, mut accessors, mut names) = (vec![], vec![], Map::new());
    let mut offset = 0;
    for (index, attribute) in attributes.iter().enumerate() {
        let (shape, component, bytes) = attribute.values.layout();
        let length = bytes * splat.len();
        views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": length, "target": ARRAY_BUFFER}));
        let mut accessor =
            json!({"bufferView": index, "componentType": component, "count": splat.len(), "type": shape});
        match attribute.values {
            Values::Position => {
                let [min, max] = bounds(splat);
                accessor["min"] = json!(min);
                accessor["max"] = json!(max);
            }
            Values::Color => accessor["normalized"] = json!(true),
            _ => {}
        }
        accessors.push(accessor);
        names.insert(attribute.name.clone(), json!(index));
        offset += length;
    }
    let mut own_buffer = json!({"byteLength": offset});
    if let Some(name) = buffer {
        own_buffer["uri"] = json!(encode_percent(name));
    }
    let splatting = json!({
        "kernel": KERNEL,
        "colorSpace": COLOR_SPACE,
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    json!({
        "asset": {"version": "2.0", "generator": "globalsplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": names,
            "mode": POINTS,
            "extensions": {EXTENSION: splatting},
        }]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [own_buffer],
    })
}

/// Returns the minimum and maximum of the positions in glTF's axes.
fn bounds(splat: &Splat) -> [[f32; 3]; 2] {
    let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for mean in splat.means.iter().map(|&mean| Axes::LUF.position(mean)) {
        for (axis, number) in mean.into_iter().enumerate() {
            bounds[0][axis] = bounds[0][axis].min(number);
            bounds[1][axis] = bounds[1][axis].max(number);
        }
    }
    bounds
}

/// Writes the values of each attribute for all Gaussians. All sizes are multiples of 4 bytes.
fn write_buffer(writer: &mut dyn Write, attributes: &[Attribute], splat: &Splat) -> std::io::Result<()> {
    let mut bytes = vec![];
    for attribute in attributes {
        for index in 0..splat.len() {
            bytes.clear();
            attribute.values.append(splat, index, &mut bytes);
            writer.write_all(&bytes)?;
        }
    }
    Ok(())
}
