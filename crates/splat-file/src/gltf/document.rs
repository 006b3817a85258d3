//! Files of glTF: the JSON, as far as splats need it; the chunks of a `.glb`; and the buffers, which are a chunk, a file or a data URI.

use super::{EXTENSION, SPZ_EXTENSION, recognizes_glb};
use crate::numbers::{Scalar, u32_at};
use crate::{Error, Result};
use base64::prelude::{BASE64_STANDARD, Engine};
use glam::{DMat4, DQuat, DVec3};
use globalsplat_files::{check_regular, parent_of};
use percent_encoding::percent_decode_str;
use serde::Deserialize;
use serde_json::Value;
use std::borrow::Cow;
use std::collections::btree_map::{BTreeMap, Entry};
use std::path::{Path, PathBuf};
use std::rc::Rc;

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub struct Gltf {
    asset: Value,
    extensions_required: Vec<String>,
    pub scene: usize,
    pub scenes: Vec<Scene>,
    pub nodes: Vec<Node>,
    pub meshes: Vec<Mesh>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: Vec<Buffer>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
pub struct Scene {
    pub nodes: Vec<usize>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
pub struct Node {
    pub children: Vec<usize>,
    pub mesh: Option<usize>,
    /// If it is present, the other transforms are absent.
    pub matrix: Option<DMat4>,
    pub translation: Option<DVec3>,
    pub rotation: Option<DQuat>,
    pub scale: Option<DVec3>,
}

#[derive(Deserialize)]
pub struct Mesh {
    pub primitives: Vec<Primitive>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
pub struct Primitive {
    pub attributes: BTreeMap<String, usize>,
    pub mode: Option<u32>,
    pub extensions: BTreeMap<String, Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    pub count: usize,
    /// Number of components: SCALAR, VEC2, VEC3, …
    #[serde(rename = "type")]
    shape: String,
    sparse: Option<serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    /// Relative path or data URI, or `None` for the binary chunk of a `.glb`.
    uri: Option<String>,
    byte_length: usize,
}

/// Version of the container `.glb`.
const GLB_VERSION: u32 = 2;
/// Size in bytes of the header of a `.glb`, and of each chunk's header.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;
/// Extensions that a file may require: those whose contents are read, and those that don't concern Gaussians.
const KNOWN: [&str; 4] = [EXTENSION, SPZ_EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"];

/// Parsed file with its buffers.
pub struct Document<'a> {
    pub path: &'a Path,
    pub gltf: Gltf,
    buffers: Vec<Rc<Cow<'a, [u8]>>>,
    /// Size in bytes of the file and of the buffers in other files.
    pub size: usize,
}

impl<'a> Document<'a> {
    /// Parses the file at `path`, a `.glb` or a `.gltf`, and reads its buffers.
    pub fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        let (json, bin) = if recognizes_glb(bytes) { chunks(path, bytes)? } else { (bytes, None) };
        let gltf: Gltf = serde_json::from_slice(json)
            .map_err(|why| Error::input(path, "the JSON", format!("invalid: {why}"), "glTF 2.0"))?;
        let version = gltf.asset["version"].as_str().unwrap_or_default();
        if !version.starts_with("2.") {
            return Err(Error::input(path, "the version", quoted(version), "2.0"));
        }
        if let Some(unknown) = gltf.extensions_required.iter().find(|name| !KNOWN.contains(&name.as_str())) {
            let expected = format!("{} or none", KNOWN.join(", "));
            return Err(Error::input(path, "a required extension", quoted(unknown), expected));
        }
        let mut files = BTreeMap::new();
        let read = |(index, buffer)| read_buffer(path, index, buffer, bin.filter(|_| index == 0), &mut files);
        let buffers = gltf.buffers.iter().enumerate().map(read).collect::<Result<Vec<_>>>()?;
        let size = bytes.len() + files.values().map(|contents| contents.len()).sum::<usize>();
        Ok(Document { path, gltf, buffers, size })
    }

    /// Returns `true` if the program that wrote the file wrote logarithms of scales: splat-transform before version 2.7.
    pub fn has_log_scales(&self) -> bool {
        let generator = self.gltf.asset["generator"].as_str().unwrap_or_default();
        let Some(version) = generator.strip_prefix("splat-transform ") else { return false };
        let mut numbers =
            version.trim_start_matches('v').split('.').map_while(|number| number.parse::<u32>().ok());
        numbers.next().zip(numbers.next()).is_some_and(|version| version < (2, 7))
    }

    /// Returns the bytes of a buffer view, and its stride if it has one.
    pub fn view(&self, index: usize) -> Result<(&[u8], Option<usize>)> {
        let view = self.get(&self.gltf.buffer_views, "buffer view", index)?;
        let buffer = self.get(&self.buffers, "buffer", view.buffer)?;
        let buffer = &buffer[..self.gltf.buffers[view.buffer].byte_length];
        let bytes = buffer.get(view.byte_offset..).and_then(|bytes| bytes.get(..view.byte_length));
        let bytes = bytes.ok_or_else(|| {
            let found = format!("{} bytes at {}", view.byte_length, view.byte_offset);
            let expected = format!("a part of buffer {}, which has {} bytes", view.buffer, buffer.len());
            Error::input(self.path, format!("buffer view {index}"), found, expected)
        })?;
        Ok((bytes, view.byte_stride))
    }

    /// Returns the element of `list` with this index; `what` names it in the error if there is none.
    pub fn get<'l, T>(&self, list: &'l [T], what: &str, index: usize) -> Result<&'l T> {
        list.get(index).ok_or_else(|| {
            let expected = format!("an index below {}", list.len());
            Error::input(self.path, format!("{what} {index}"), "missing", expected)
        })
    }

    /// Returns accessor `index`, that of the attribute `name`.
    pub fn accessor(&self, index: usize, name: &str) -> Result<&Accessor> {
        self.get(&self.gltf.accessors, &format!("the accessor of {name},"), index)
    }

    /// Reads accessor `index`, that of the attribute `name`, which must have `count` elements of `N` numbers.
    pub fn numbers<const N: usize>(&self, index: usize, name: &str, count: usize) -> Result<Vec<[f32; N]>> {
        let accessor = self.accessor(index, name)?;
        let error = |field: &str, found: String, expected: &str| {
            Error::input(self.path, format!("{field} of accessor {index} ({name})"), found, expected)
        };
        let shape = if N == 1 { "SCALAR".to_string() } else { format!("VEC{N}") };
        if accessor.shape != shape {
            return Err(error("the type", quoted(&accessor.shape), &shape));
        }
        // The largest number of a type is 1 if numbers are normalized.
        let (scalar, largest) = match accessor.component_type {
            5120 => (Scalar::I8, f64::from(i8::MAX)),
            5121 => (Scalar::U8, f64::from(u8::MAX)),
            5122 => (Scalar::I16, f64::from(i16::MAX)),
            5123 => (Scalar::U16, f64::from(u16::MAX)),
            5126 => (Scalar::F32, 1.),
            other => {
                let expected = "float (5126), or numbers of one or two bytes (5120 to 5123)";
                return Err(error("the component type", other.to_string(), expected));
            }
        };
        if accessor.count != count {
            let expected = format!("{count}, as many as positions");
            return Err(error("the number of elements", accessor.count.to_string(), &expected));
        }
        if accessor.sparse.is_some() {
            return Err(error("the storage", "sparse".into(), "all elements in a buffer view"));
        }
        let missing = || error("the buffer view", "missing".into(), "one");
        let view = accessor.buffer_view.ok_or_else(missing)?;
        let (bytes, stride) = self.view(view)?;
        let size = N * scalar.size();
        let stride = stride.unwrap_or(size);
        if stride < size {
            return Err(error("the stride", stride.to_string(), &format!("{size} bytes or more")));
        }
        let end =
            accessor.byte_offset as u128 + count.saturating_sub(1) as u128 * stride as u128 + size as u128;
        if count == 0 || end > bytes.len() as u128 {
            let found = format!("{count} elements, which end at byte {end}");
            let expected = format!("1 or more, within the {} bytes of buffer view {view}", bytes.len());
            return Err(error("the extent", found, &expected));
        }
        let is_fraction = accessor.normalized && scalar != Scalar::F32;
        let number = |bytes: &[u8]| match scalar.read(bytes) {
            number if is_fraction => (number / largest).max(-1.) as f32,
            number => number as f32,
        };
        let element = |index: usize| -> [f32; N] {
            let bytes = &bytes[accessor.byte_offset + index * stride..];
            std::array::from_fn(|part| number(&bytes[part * scalar.size()..]))
        };
        Ok((0..count).map(element).collect())
    }
}

/// Reads buffer `index` of the file at `path`, which is in the chunk `bin` if it has no URI. Its file is added to `files`, none of which is
/// read twice, though buffers may share it.
fn read_buffer<'a>(
    path: &Path,
    index: usize,
    buffer: &Buffer,
    bin: Option<&'a [u8]>,
    files: &mut BTreeMap<PathBuf, Rc<Cow<'a, [u8]>>>,
) -> Result<Rc<Cow<'a, [u8]>>> {
    let Buffer { uri, byte_length } = buffer;
    let error = |path: &Path, field: &str, found: &str, expected: &str| {
        Error::input(path, format!("{field} {index}"), found, expected)
    };
    let mut file = path.to_owned();
    let contents = match uri.as_deref() {
        None => {
            let missing = || error(path, "buffer", "without a uri", "one, or the binary chunk of a .glb");
            Rc::new(Cow::Borrowed(bin.ok_or_else(missing)?))
        }
        Some(uri) if uri.starts_with("data:") => {
            let bytes = uri.split_once(";base64,").and_then(|(_, text)| BASE64_STANDARD.decode(text).ok());
            let damaged = || error(path, "buffer", "another or a damaged data URI", "one in base64");
            Rc::new(Cow::Owned(bytes.ok_or_else(damaged)?))
        }
        Some(uri) => {
            let is_relative =
                |name: &Cow<str>| !(name.is_empty() || uri.contains("://") || Path::new(&**name).has_root());
            let expected = "a data URI, or a path relative to the file's folder";
            let name = percent_decode_str(uri).decode_utf8().ok().filter(is_relative);
            let name = name.ok_or_else(|| error(path, "the uri of buffer", &quoted(uri), expected))?;
            file = parent_of(path).join(&*name);
            check_regular(&file)?;
            match files.entry(file.canonicalize().map_err(Error::read(&file))?) {
                Entry::Occupied(read) => read.get().clone(),
                Entry::Vacant(new) => {
                    new.insert(Rc::new(Cow::Owned(std::fs::read(&file).map_err(Error::read(&file))?))).clone()
                }
            }
        }
    };
    if contents.len() < *byte_length {
        let found = format!("cut short: {} bytes", contents.len());
        return Err(error(&file, "buffer", &found, &format!("{byte_length} bytes")));
    }
    Ok(contents)
}

/// Returns the beginning of a text from a file, in quotes and on one line.
pub fn quoted(text: &str) -> String {
    format!("{:?}", text.chars().take(60).collect::<String>())
}

/// Returns the JSON and the binary chunk of a `.glb`: its first chunk, and its second one if it has that type.
fn chunks<'a>(path: &Path, bytes: &'a [u8]) -> Result<(&'a [u8], Option<&'a [u8]>)> {
    if bytes.len() < HEADER {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the header", found, format!("{HEADER} bytes")));
    }
    let (version, length) = (u32_at(bytes, 4), u32_at(bytes, 8));
    if version != GLB_VERSION {
        return Err(Error::input(path, "the version of the .glb", version, GLB_VERSION.to_string()));
    }
    let Some(chunks) = bytes.get(HEADER..length as usize) else {
        let expected = format!("{HEADER} to {}, the size of the file", bytes.len());
        return Err(Error::input(path, "the length in the header", length, expected));
    };
    // Type and contents of a chunk, and the bytes after it.
    let split = |bytes: &'a [u8]| {
        let chunk = bytes.split_at_checked(CHUNK_HEADER).and_then(|(header, contents)| {
            let (contents, rest) = contents.split_at_checked(u32_at(header, 0) as usize)?;
            Some((&header[4..], contents, rest))
        });
        chunk.ok_or_else(|| {
            let found = format!("cut short: {} bytes", bytes.len());
            Error::input(path, "a chunk", found, "its header and as many bytes as it says")
        })
    };
    let (kind, json, rest) = split(chunks)?;
    if kind != b"JSON" {
        let found = format!("of type {:?}", String::from_utf8_lossy(kind));
        return Err(Error::input(path, "the first chunk", found, "of type \"JSON\""));
    }
    let second = if rest.is_empty() { None } else { Some(split(rest)?) };
    Ok((json, second.filter(|(kind, ..)| *kind == b"BIN\0").map(|(_, bin, _)| bin)))
}
