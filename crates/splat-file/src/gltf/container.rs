//! Containers of glTF: the chunks of a `.glb`, and the buffers, which are a chunk, a file or a data URI.

use super::json::Gltf;
use super::recognizes_glb;
use crate::{Error, Result};
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use base64::{Engine, alphabet};
use globalsplat_files::parent_of;
use std::borrow::Cow;
use std::cell::OnceCell;
use std::fs;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

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
    ///
    /// # Errors
    /// Returns an error for another version, or an extension that is required but unknown, or if the file is damaged or truncated.
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
    ///
    /// # Errors
    /// Returns an error if there is no such view, or it is outside of its buffer, or the buffer can't be read.
    pub fn view(&self, index: usize) -> Result<(&[u8], Option<usize>)> {
        let count = self.gltf.buffer_views.len();
        let Some(view) = self.gltf.buffer_views.get(index) else {
            return Err(self.missing("buffer view", index, count));
        };
        let buffer = self.buffer(view.buffer)?;
        let bytes = buffer
            .get(view.byte_offset..)
            .and_then(|bytes| bytes.get(..view.byte_length))
            .ok_or_else(|| {
                let found = format!("{} bytes at {}", view.byte_length, view.byte_offset);
                let expected = format!("a part of buffer {}, which has {} bytes", view.buffer, buffer.len());
                Error::input(self.path, format!("buffer view {index}"), found, expected)
            })?;
        Ok((bytes, view.byte_stride))
    }

    /// Returns the error for an index without an element.
    pub fn missing(&self, what: &str, index: usize, count: usize) -> Error {
        Error::input(self.path, format!("{what} {index}"), "missing", format!("an index below {count}"))
    }

    fn buffer(&self, index: usize) -> Result<&[u8]> {
        let Some(cell) = self.buffers.get(index) else {
            return Err(self.missing("buffer", index, self.buffers.len()));
        };
        match cell.get() {
            Some(bytes) => Ok(bytes),
            None => {
                let bytes = self.read_buffer(index)?;
                Ok(cell.get_or_init(|| bytes))
            }
        }
    }

    fn read_buffer(&self, index: usize) -> Result<Cow<'a, [u8]>> {
        let buffer = &self.gltf.buffers[index];
        let field = format!("buffer {index}");
        let (path, bytes) = match &buffer.uri {
            None => {
                let bin = self.bin.filter(|_| index == 0).ok_or_else(|| {
                    Error::input(self.path, &field, "without a uri", "one, or the binary chunk of a .glb")
                })?;
                (self.path.to_owned(), Cow::Borrowed(bin))
            }
            Some(uri) => match uri.strip_prefix("data:") {
                Some(data) => {
                    let bytes = data.split_once(";base64,").and_then(|(_, text)| BASE64.decode(text).ok());
                    let bytes = bytes.ok_or_else(|| {
                        Error::input(self.path, &field, "another or a damaged data URI", "one in base64")
                    })?;
                    (self.path.to_owned(), Cow::Owned(bytes))
                }
                None => {
                    let file = self.relative_path(&field, uri)?;
                    let bytes = read_file(&file, buffer.byte_length)?;
                    (file, Cow::Owned(bytes))
                }
            },
        };
        if bytes.len() < buffer.byte_length {
            let found = format!("cut short: {} bytes", bytes.len());
            return Err(Error::input(path, field, found, format!("{} bytes", buffer.byte_length)));
        }
        Ok(match bytes {
            Cow::Borrowed(bytes) => Cow::Borrowed(&bytes[..buffer.byte_length]),
            Cow::Owned(mut bytes) => {
                bytes.truncate(buffer.byte_length);
                Cow::Owned(bytes)
            }
        })
    }

    /// Returns the path of the file that a URI refers to.
    fn relative_path(&self, field: &str, uri: &str) -> Result<PathBuf> {
        // A colon after the first slash, or in percent-encoding, is part of a name.
        let is_url = uri.split_once(':').is_some_and(|(scheme, _)| !scheme.contains('/'));
        let name = decode_percent(uri).filter(|name| {
            let is_absolute = name.starts_with(['/', '\\'])
                || Path::new(name).components().any(|part| matches!(part, Component::Prefix(_)));
            !(name.is_empty() || is_url || is_absolute || name.contains('\0'))
        });
        match name {
            Some(name) => Ok(parent_of(self.path).join(name)),
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
    let word = |bytes: &[u8], at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|byte| bytes[at + byte]));
    if bytes.len() < HEADER {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the header", found, format!("{HEADER} bytes")));
    }
    let (version, length) = (word(bytes, 4), word(bytes, 8));
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
            Some((header, contents.split_at_checked(word(header, 0) as usize)?))
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

/// Decodes the percent-encoded bytes of a URI, or returns `None` if they aren't UTF-8.
fn decode_percent(uri: &str) -> Option<String> {
    let mut bytes = vec![];
    let mut rest = uri.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let digits = after.get(..2).filter(|_| byte == b'%');
        let code = digits.and_then(|digits| {
            let value = |digit: u8| char::from(digit).to_digit(16);
            Some(value(digits[0])? * 16 + value(digits[1])?)
        });
        bytes.push(code.map_or(byte, |code| code as u8));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8(bytes).ok()
}

/// Encodes a file name as a URI.
pub fn encode_percent(name: &str) -> String {
    let encode = |byte: u8| match byte {
        b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => char::from(byte).to_string(),
        _ => format!("%{byte:02X}"),
    };
    name.bytes().map(encode).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_encoded_and_decoded() {
        for name in ["a.bin", "my room (2).bin", "100%25.bin", "große Höhle.bin", "a:b?#&.bin"] {
            let uri = encode_percent(name);
            assert!(uri.is_ascii() && !uri.contains([' ', ':', '?', '#']), "{uri}");
            assert_eq!(decode_percent(&uri).as_deref(), Some(name));
        }
        assert_eq!(decode_percent("a%zz%2").as_deref(), Some("a%zz%2"));
        assert_eq!(decode_percent("%ff"), None);
    }
}
