//! Writes splats as glTF: one primitive with float32 attributes, and colors of bytes for programs that show points only.

use super::{COLOR_SPACE, EXTENSION, KERNEL, MAGIC, POINTS, rotation_to_gltf, sh_attribute};
use crate::axes::Axes;
use crate::splat::{bounds, sh0_to_color};
use crate::{Error, Result, Splat, WriteOptions};
use globalsplat_files::{write_atomically, write_files};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde_json::{Map, Value, json};
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
    let (json, buffer) = encode(path, splat)?;
    let mut json = json.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + json.len() + 8 + buffer.len();
    let Ok(length) = u32::try_from(length) else {
        return Err(Error::failed(format!(
            "{}: a .glb holds less than 4 GiB, found {length} bytes, which a .gltf would hold",
            path.display()
        )));
    };
    let word = |length: usize| (length as u32).to_le_bytes();
    let header = [MAGIC, 2u32.to_le_bytes(), length.to_le_bytes(), word(json.len()), *b"JSON"];
    let buffer_header = [word(buffer.len()), *b"BIN\0"];
    write_atomically(path, |writer| {
        let mut parts = [header.as_flattened(), &json, buffer_header.as_flattened(), &buffer].into_iter();
        parts.try_for_each(|part| writer.write_all(part)).map_err(Error::write(path))
    })
}

/// Writes a `.gltf`, and its buffer in the file of [`buffer_file`]. Both files are complete before either replaces an older one.
pub(crate) fn write_gltf(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let (mut json, buffer) = encode(path, splat)?;
    let file = buffer_file(path);
    let Some(name) = file.file_name().and_then(|name| name.to_str()) else {
        return Err(Error::failed(format!("{}: the name of a .gltf must be UTF-8", path.display())));
    };
    json["buffers"][0]["uri"] = json!(utf8_percent_encode(name, ENCODED).to_string());
    let json = format!("{json:#}\n");
    write_files([(file.as_path(), &buffer[..]), (path, json.as_bytes())])
}

/// Returns the JSON and the buffer, which has the attributes one after the other. The size of each is a multiple of 4 bytes.
fn encode(path: &Path, splat: &Splat) -> Result<(Value, Vec<u8>)> {
    if splat.is_empty() {
        let message = format!("{}: glTF holds one Gaussian at least, found 0", path.display());
        return Err(Error::failed(message));
    }
    let (mut views, mut accessors, mut names, mut buffer) = (vec![], vec![], Map::new(), vec![]);
    let mut add = |name: String, component: u32, shape: &str, bytes: Vec<u8>| {
        names.insert(name, json!(views.len()));
        let accessor = json!({
            "bufferView": views.len(), "componentType": component, "count": splat.len(), "type": shape
        });
        accessors.push(accessor);
        let (offset, length) = (buffer.len(), bytes.len());
        views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": length, "target": ARRAY_BUFFER}));
        buffer.extend(bytes);
    };
    let floats = |numbers: &mut dyn Iterator<Item = f32>| numbers.flat_map(f32::to_le_bytes).collect();
    let mut turned = splat.clone();
    Axes::LUF.convert_without_rotations(&mut turned);
    let all = || 0..splat.len();
    add("POSITION".into(), FLOAT, "VEC3", floats(&mut turned.means.as_flattened().iter().copied()));
    let byte = |number: f64| (number * 255.).round() as u8; // clamps to 0 and 255
    let color = |index: usize| {
        let [red, green, blue] = splat.sh_of(index)[0].map(|dc| byte(sh0_to_color(dc)));
        [red, green, blue, byte(splat.opacity(index).into())]
    };
    add("COLOR_0".into(), UNSIGNED_BYTE, "VEC4", all().flat_map(color).collect());
    let rotation = |index: usize| {
        let [w, x, y, z] = rotation_to_gltf(unit_quaternion(splat, index));
        [x, y, z, w]
    };
    let own = |name: &str| format!("{EXTENSION}:{name}");
    add(own("ROTATION"), FLOAT, "VEC4", floats(&mut all().flat_map(rotation)));
    add(own("SCALE"), FLOAT, "VEC3", floats(&mut all().flat_map(|index| splat.scale(index))));
    add(own("OPACITY"), FLOAT, "SCALAR", floats(&mut all().map(|index| splat.opacity(index))));
    for basis in 0..splat.bases() {
        let degree = basis.isqrt();
        let numbers = floats(&mut all().flat_map(|index| turned.sh_of(index)[basis]));
        add(sh_attribute(degree, basis - degree * degree), FLOAT, "VEC3", numbers);
    }
    // Only positions must have bounds, and the colors are fractions.
    let [low, high] = bounds(&turned.means);
    accessors[0]["min"] = json!(low);
    accessors[0]["max"] = json!(high);
    accessors[1]["normalized"] = json!(true);
    let splatting = json!({
        "kernel": KERNEL,
        "colorSpace": COLOR_SPACE,
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    let primitive = json!({"attributes": names, "mode": POINTS, "extensions": {EXTENSION: splatting}});
    let json = json!({
        "asset": {"version": "2.0", "generator": "globalsplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": buffer.len()}],
    });
    Ok((json, buffer))
}

/// Returns the quaternion of Gaussian `index` with length 1. A quaternion that is unit length up to rounding is returned unchanged.
fn unit_quaternion(splat: &Splat, index: usize) -> [f32; 4] {
    let quaternion = splat.quaternions[index];
    let squared: f64 = quaternion.iter().map(|&part| f64::from(part).powi(2)).sum();
    if (squared - 1.).abs() < UNIT_TOLERANCE { quaternion } else { splat.unit_quaternion(index) }
}
