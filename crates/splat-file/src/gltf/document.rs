//! Files of glTF: the JSON, as far as splats need it; the chunks of a `.glb`; and the buffers, which are a chunk, a file or a data URI.

use super::recognizes_glb;
use crate::numbers::u32_at;
use crate::{Error, Result};
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use base64::{Engine, alphabet};
use glam::{DMat4, DQuat, DVec3};
use globalsplat_files::parent_of;
use percent_encoding::percent_decode_str;
use serde::Deserialize;
use std::borrow::Cow;
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub struct Gltf {
    asset: Asset,
    extensions_required: Vec<String>,
    pub scene: Option<usize>,
    pub scenes: Vec<Scene>,
    pub nodes: Vec<Node>,
    pub meshes: Vec<Mesh>,
    pub accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: Vec<Buffer>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Asset {
    version: String,
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
    pub extensions: PrimitiveExtensions,
}

#[derive(Default, Deserialize)]
pub struct PrimitiveExtensions {
    #[serde(rename = "KHR_gaussian_splatting")]
    pub splatting: Option<Splatting>,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub struct Splatting {
    pub kernel: Option<String>,
    pub color_space: Option<String>,
    pub extensions: SplattingExtensions,
}

#[derive(Default, Deserialize)]
pub struct SplattingExtensions {
    #[serde(rename = "KHR_gaussian_splatting_compression_spz_2")]
    pub spz: Option<Spz>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Spz {
    pub buffer_view: usize,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Accessor {
    pub buffer_view: Option<usize>,
    #[serde(default)]
    pub byte_offset: usize,
    pub component_type: u32,
    #[serde(default)]
    pub normalized: bool,
    pub count: usize,
    /// Number of components: SCALAR, VEC2, VEC3, …
    #[serde(rename = "type")]
    pub shape: String,
    pub sparse: Option<serde::de::IgnoredAny>,
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

/// Base64 with the standard alphabet, whose padding may be absent.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);
/// Version of glTF, and of the container `.glb`.
const VERSION: &str = "2.0";
const GLB_VERSION: u32 = 2;
/// Size in bytes of the header of a `.glb`, and of each chunk's header.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;
/// Types of chunks.
const JSON: [u8; 4] = *b"JSON";
const BIN: [u8; 4] = *b"BIN\0";
/// Extensions that a file may require: those whose contents are read, and those that don't concern Gaussians.
const KNOWN: [&str; 4] =
    [super::EXTENSION, super::SPZ_EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"];

/// Parsed file with its buffers, which are read when they are used.
pub struct Document<'a> {
    pub path: &'a Path,
    pub gltf: Gltf,
    /// Size of the file in bytes.
    length: usize,
    /// Contents of the binary chunk.
    bin: Option<&'a [u8]>,
    buffers: Vec<OnceCell<Cow<'a, [u8]>>>,
}

impl<'a> Document<'a> {
    /// Parses the file at `path`, a `.glb` or a `.gltf`.
    pub fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        let (json, bin) = if recognizes_glb(bytes) { chunks(path, bytes)? } else { (bytes, None) };
        let gltf: Gltf = serde_json::from_slice(json)
            .map_err(|why| Error::input(path, "the JSON", format!("invalid: {why}"), "glTF 2.0"))?;
        let version = &gltf.asset.version;
        if !version.starts_with("2.") {
            return Err(Error::input(path, "the version", quoted(version), VERSION));
        }
        if let Some(unknown) = gltf.extensions_required.iter().find(|name| !KNOWN.contains(&name.as_str())) {
            let expected = format!("{} or none", KNOWN.join(", "));
            return Err(Error::input(path, "a required extension", quoted(unknown), expected));
        }
        let buffers = gltf.buffers.iter().map(|_| OnceCell::new()).collect();
        Ok(Document { path, gltf, length: bytes.len(), bin, buffers })
    }

    /// Returns the size in bytes of the file and of the buffers that have been read from other files.
    pub fn size(&self) -> usize {
        let buffers = self.buffers.iter().filter_map(|buffer| match buffer.get() {
            Some(Cow::Owned(bytes)) => Some(bytes.len()),
            _ => None,
        });
        self.length.saturating_add(buffers.sum())
    }

    /// Returns the bytes of a buffer view, and its stride if it has one.
    pub fn view(&self, index: usize) -> Result<(&[u8], Option<usize>)> {
        let view = self.get(&self.gltf.buffer_views, "buffer view", index)?;
        let buffer = self.buffer(view.buffer)?;
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

    fn buffer(&self, index: usize) -> Result<&[u8]> {
        let cell = self.get(&self.buffers, "buffer", index)?;
        match cell.get() {
            Some(bytes) => Ok(bytes),
            None => {
                let bytes = self.read_buffer(index)?;
                Ok(cell.get_or_init(|| bytes))
            }
        }
    }

    fn read_buffer(&self, index: usize) -> Result<Cow<'a, [u8]>> {
        let Buffer { uri, byte_length } = &self.gltf.buffers[index];
        let field = format!("buffer {index}");
        let error = |found: &str, expected: &str| Error::input(self.path, &field, found, expected);
        let mut path = self.path.to_owned();
        let mut bytes = match uri.as_deref().map(|uri| (uri, uri.strip_prefix("data:"))) {
            None => {
                let bin = self.bin.filter(|_| index == 0);
                Cow::Borrowed(
                    bin.ok_or_else(|| error("without a uri", "one, or the binary chunk of a .glb"))?,
                )
            }
            Some((_, Some(data))) => {
                let bytes = data.split_once(";base64,").and_then(|(_, text)| BASE64.decode(text).ok());
                Cow::Owned(bytes.ok_or_else(|| error("another or a damaged data URI", "one in base64"))?)
            }
            Some((uri, None)) => {
                path = self.relative_path(&field, uri)?;
                Cow::Owned(read_file(&path, *byte_length)?)
            }
        };
        if bytes.len() < *byte_length {
            let found = format!("cut short: {} bytes", bytes.len());
            return Err(Error::input(path, field, found, format!("{byte_length} bytes")));
        }
        match &mut bytes {
            Cow::Borrowed(bytes) => *bytes = &bytes[..*byte_length],
            Cow::Owned(bytes) => bytes.truncate(*byte_length),
        }
        Ok(bytes)
    }

    /// Returns the path of the file that a URI refers to.
    fn relative_path(&self, field: &str, uri: &str) -> Result<PathBuf> {
        // A colon after the first slash, or in percent-encoding, is part of a name.
        let is_url = uri.split_once(':').is_some_and(|(scheme, _)| !scheme.contains('/'));
        let name = percent_decode_str(uri).decode_utf8().ok().filter(|name| {
            let is_absolute = name.starts_with(['/', '\\'])
                || Path::new(&**name).components().any(|part| matches!(part, Component::Prefix(_)));
            !(name.is_empty() || is_url || is_absolute || name.contains('\0'))
        });
        match name {
            Some(name) => Ok(parent_of(self.path).join(&*name)),
            None => {
                let expected = "a data URI, or a path relative to the file's folder";
                Err(Error::input(self.path, format!("the uri of {field}"), quoted(uri), expected))
            }
        }
    }
}

/// Returns the beginning of a text from a file, in quotes and on one line.
pub fn quoted(text: &str) -> String {
    format!("{:?}", text.chars().take(60).collect::<String>())
}

/// Returns the JSON and the binary chunk of a `.glb`.
fn chunks<'a>(path: &Path, bytes: &'a [u8]) -> Result<(&'a [u8], Option<&'a [u8]>)> {
    if bytes.len() < HEADER {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the header", found, format!("{HEADER} bytes")));
    }
    let (version, length) = (u32_at(bytes, 4), u32_at(bytes, 8));
    if version != GLB_VERSION {
        return Err(Error::input(path, "the version of the .glb", version, GLB_VERSION.to_string()));
    }
    let Some(mut rest) = usize::try_from(length).ok().and_then(|length| bytes.get(HEADER..length)) else {
        let expected = format!("{HEADER} to {}, the size of the file", bytes.len());
        return Err(Error::input(path, "the length in the header", length, expected));
    };
    let (mut json, mut bin) = (None, None);
    while !rest.is_empty() {
        let chunk = rest.split_at_checked(CHUNK_HEADER).and_then(|(header, contents)| {
            Some((header, contents.split_at_checked(u32_at(header, 0) as usize)?))
        });
        let Some((header, (contents, after))) = chunk else {
            let found = format!("cut short: {} bytes", rest.len());
            return Err(Error::input(path, "a chunk", found, "its header and as many bytes as it says"));
        };
        if json.is_none() {
            if header[4..] != JSON {
                let found = format!("of type {:?}", String::from_utf8_lossy(&header[4..]));
                return Err(Error::input(path, "the first chunk", found, "of type \"JSON\""));
            }
            json = Some(contents);
        } else if header[4..] == BIN {
            bin = bin.or(Some(contents));
        }
        rest = after;
    }
    match json {
        Some(json) => Ok((json, bin)),
        None => Err(Error::input(path, "the JSON chunk", "missing", "one after the header")),
    }
}

/// Reads at most `length` bytes of the regular file at `path`.
fn read_file(path: &Path, length: usize) -> Result<Vec<u8>> {
    let is_file = fs::metadata(path).map_err(Error::read(path))?.is_file();
    if !is_file {
        return Err(Error::input(path, "the buffer", "no regular file", "one"));
    }
    let mut bytes = vec![];
    let file = fs::File::open(path).map_err(Error::read(path))?;
    file.take(length as u64).read_to_end(&mut bytes).map_err(Error::read(path))?;
    Ok(bytes)
}
