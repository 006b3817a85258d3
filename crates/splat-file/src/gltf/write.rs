//! Writes splats as glTF: one primitive with float32 attributes, and colors of bytes for programs that show points only.

use super::{COLOR_SPACE, EXTENSION, KERNEL, MAGIC, POINTS, rotation_to_gltf, sh_attribute};
use crate::axes::Axes;
use crate::splat::sh0_to_color;
use crate::{Error, Result, Splat, WriteOptions};
use globalsplat_files::{write_atomically, write_temporary};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
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
/// Characters of a file name that are encoded in a URI.
const ENCODED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// Returns the path of the buffer that [`write_gltf`] writes beside the `.gltf` at `path`.
pub(crate) fn buffer_file(path: &Path) -> PathBuf {
    path.with_extension("bin")
}

/// Writes a `.glb`.
pub(crate) fn write_glb(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let attributes = attributes(path, splat)?;
    let mut json = document(&attributes, splat.len(), None).to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let body: usize = attributes.iter().map(|attribute| attribute.bytes.len()).sum();
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
        write_buffer(writer, &attributes).map_err(Error::write(path))
    })
}

/// Writes a `.gltf`, and its buffer in the file of [`buffer_file`]. Both files are complete before either replaces an older one.
pub(crate) fn write_gltf(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let attributes = attributes(path, splat)?;
    let file = buffer_file(path);
    let Some(name) = file.file_name().and_then(|name| name.to_str()) else {
        return Err(Error::failed(format!("{}: the name of a .gltf must be UTF-8", path.display())));
    };
    let json = format!("{:#}\n", document(&attributes, splat.len(), Some(name)));
    let buffer =
        write_temporary(&file, |writer| write_buffer(writer, &attributes).map_err(Error::write(&file)))?;
    let gltf = write_temporary(path, |writer| writer.write_all(json.as_bytes()).map_err(Error::write(path)))?;
    buffer.persist()?;
    gltf.persist()
}

fn write_buffer(writer: &mut dyn Write, attributes: &[Attribute]) -> std::io::Result<()> {
    attributes.iter().try_for_each(|attribute| writer.write_all(&attribute.bytes))
}

/// Attribute of a primitive: its accessor, and the values of all Gaussians, whose size is a multiple of 4 bytes.
struct Attribute {
    name: String,
    shape: &'static str,
    component: u32,
    /// Minimum and maximum of each component, which only positions must have.
    bounds: Option<[[f32; 3]; 2]>,
    bytes: Vec<u8>,
}

impl Attribute {
    fn floats(name: String, shape: &'static str, numbers: impl Iterator<Item = f32>) -> Self {
        let bytes = numbers.flat_map(f32::to_le_bytes).collect();
        Attribute { name, shape, component: FLOAT, bounds: None, bytes }
    }
}

/// Returns the attributes in the order in which they are written.
fn attributes(path: &Path, splat: &Splat) -> Result<Vec<Attribute>> {
    if splat.is_empty() {
        let message = format!("{}: glTF holds one Gaussian at least, found 0", path.display());
        return Err(Error::failed(message));
    }
    let mut turned = splat.clone();
    Axes::LUF.convert_without_rotations(&mut turned);
    let extreme = |choose: fn(f32, f32) -> f32, first: f32| {
        turned.means.iter().fold([first; 3], |a, b| std::array::from_fn(|axis| choose(a[axis], b[axis])))
    };
    let all = || 0..splat.len();
    let rotation = |index: usize| {
        let [w, x, y, z] = rotation_to_gltf(unit_quaternion(splat, index));
        [x, y, z, w]
    };
    let byte = |number: f64| (number * 255.).round() as u8; // clamps to 0 and 255
    let color = |index: usize| {
        let [red, green, blue] = splat.sh_of(index)[0].map(|dc| byte(sh0_to_color(dc)));
        [red, green, blue, byte(splat.opacity(index).into())]
    };
    let own = |name: &str| format!("{EXTENSION}:{name}");
    let mut attributes = vec![
        Attribute {
            bounds: Some([extreme(f32::min, f32::INFINITY), extreme(f32::max, f32::NEG_INFINITY)]),
            ..Attribute::floats("POSITION".into(), "VEC3", turned.means.as_flattened().iter().copied())
        },
        Attribute {
            name: "COLOR_0".into(),
            shape: "VEC4",
            component: UNSIGNED_BYTE,
            bounds: None,
            bytes: all().flat_map(color).collect(),
        },
        Attribute::floats(own("ROTATION"), "VEC4", all().flat_map(rotation)),
        Attribute::floats(own("SCALE"), "VEC3", all().flat_map(|index| splat.scale(index))),
        Attribute::floats(own("OPACITY"), "SCALAR", all().map(|index| splat.opacity(index))),
    ];
    for basis in 0..splat.bases() {
        let degree = basis.isqrt();
        let name = sh_attribute(degree, basis - degree * degree);
        let numbers = all().flat_map(|index| turned.sh_of(index)[basis]);
        attributes.push(Attribute::floats(name, "VEC3", numbers));
    }
    Ok(attributes)
}

/// Returns the quaternion of Gaussian `index` with length 1. A quaternion that is unit length up to rounding is returned unchanged.
fn unit_quaternion(splat: &Splat, index: usize) -> [f32; 4] {
    let quaternion = splat.quaternions[index];
    let squared: f64 = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum();
    if (squared - 1.).abs() < UNIT_TOLERANCE { quaternion } else { splat.unit_quaternion(index) }
}

/// Returns the JSON for `count` Gaussians. The buffer is in the file `buffer` or, if there is none, in the binary chunk.
fn document(attributes: &[Attribute], count: usize, buffer: Option<&str>) -> Value {
    let (mut views, mut accessors, mut names) = (vec![], vec![], Map::new());
    let mut offset = 0;
    for (index, Attribute { name, shape, component, bounds, bytes }) in attributes.iter().enumerate() {
        views.push(
            json!({"buffer": 0, "byteOffset": offset, "byteLength": bytes.len(), "target": ARRAY_BUFFER}),
        );
        let mut accessor =
            json!({"bufferView": index, "componentType": component, "count": count, "type": shape});
        if let Some([min, max]) = bounds {
            accessor["min"] = json!(min);
            accessor["max"] = json!(max);
        }
        if *component == UNSIGNED_BYTE {
            accessor["normalized"] = json!(true);
        }
        accessors.push(accessor);
        names.insert(name.clone(), json!(index));
        offset += bytes.len();
    }
    let mut own_buffer = json!({"byteLength": offset});
    if let Some(name) = buffer {
        own_buffer["uri"] = json!(utf8_percent_encode(name, ENCODED).to_string());
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
