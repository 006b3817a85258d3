//! Header of a PLY: the encoding of its numbers, and its elements and properties (spec 10.9).

use crate::{Error, Result};
use std::path::Path;

/// Encoding of numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Type of a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scalar {
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

    /// Returns the size of a binary number in bytes.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }
}

/// Type of a property in a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    Number(Scalar),
    /// List: a number of the first type is the number of items of the second type that follow.
    List(Scalar, Scalar),
}

pub struct Property {
    pub name: String,
    pub kind: Kind,
}

/// Rows with the same properties.
pub struct Element {
    pub name: String,
    /// Number of rows, as the file claims.
    pub count: usize,
    pub properties: Vec<Property>,
}

impl Element {
    pub fn has(&self, name: &str) -> bool {
        self.properties.iter().any(|property| property.name == name)
    }

    /// Returns the number type of the property `name`, or `None` if it is a list or missing.
    pub fn scalar(&self, name: &str) -> Option<Scalar> {
        let property = self.properties.iter().find(|property| property.name == name)?;
        match property.kind {
            Kind::Number(scalar) => Some(scalar),
            Kind::List(..) => None,
        }
    }
}

pub struct Header {
    /// Number of bytes up to the first row.
    pub length: usize,
    pub encoding: Encoding,
    pub elements: Vec<Element>,
    /// `true` if a comment says that the splat is antialiased.
    pub antialiased: bool,
}

/// Comment of an antialiased splat, after the keyword, as Brush, gsplat and nerfstudio write it.
const ANTIALIASED: [&str; 2] = ["SplatRenderMode:", "mip"];

impl Header {
    /// Returns `true` if `bytes` begin like a PLY.
    pub fn begins(bytes: &[u8]) -> bool {
        bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
    }

    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        if !Self::begins(bytes) {
            return Err(Error::input(path, "the file", "no PLY", "a PLY of a 3D Gaussian splat"));
        }
        let (mut length, mut encoding, mut antialiased) = (0, None, false);
        let mut elements: Vec<Element> = vec![];
        for line in bytes.split_inclusive(|&byte| byte == b'\n') {
            length += line.len();
            let text = String::from_utf8_lossy(line);
            let words: Vec<&str> = text.split_whitespace().collect();
            match words.as_slice() {
                ["end_header"] if line.ends_with(b"\n") => {
                    let Some(encoding) = encoding else {
                        return Err(Error::input(
                            path,
                            "the line format",
                            "missing",
                            "how numbers are written",
                        ));
                    };
                    return Ok(Header { length, encoding, elements, antialiased });
                }
                ["format", name, ..] => encoding = Some(parse_encoding(path, name)?),
                ["element", name, count] => {
                    let Ok(count) = count.parse() else {
                        let field = format!("the number of rows of the element {name}");
                        return Err(Error::input(path, field, count, "a whole number"));
                    };
                    elements.push(Element { name: name.to_string(), count, properties: vec![] });
                }
                ["property", kind @ .., name] => {
                    let Some(element) = elements.last_mut() else {
                        let field = format!("the property {name}");
                        return Err(Error::input(
                            path,
                            field,
                            "without an element",
                            "a line element before it",
                        ));
                    };
                    let kind = parse_kind(path, kind, name)?;
                    element.properties.push(Property { name: name.to_string(), kind });
                }
                // Postshot writes `antialiased 1`.
                ["comment", comment @ ..] => {
                    antialiased |= comment == ANTIALIASED || comment == ["antialiased", "1"];
                }
                _ => {}
            }
        }
        Err(Error::input(path, "the header", "without its end", "a line end_header"))
    }

    /// Returns the lines at the beginning of a written header, up to the first element.
    pub fn first_lines(antialiased: bool) -> String {
        let comment =
            if antialiased { format!("comment {}\n", ANTIALIASED.join(" ")) } else { String::new() };
        format!("ply\nformat binary_little_endian 1.0\n{comment}")
    }

    pub fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == name)
    }
}

fn parse_encoding(path: &Path, name: &str) -> Result<Encoding> {
    match name {
        "ascii" => Ok(Encoding::Ascii),
        "binary_little_endian" => Ok(Encoding::LittleEndian),
        "binary_big_endian" => Ok(Encoding::BigEndian),
        _ => Err(Error::input(path, "the format", name, "ascii, binary_little_endian or binary_big_endian")),
    }
}

fn parse_kind(path: &Path, words: &[&str], name: &str) -> Result<Kind> {
    let scalar = |word: &str| {
        Scalar::parse(word)
            .ok_or_else(|| Error::input(path, format!("the type of {name}"), word, "a PLY number type"))
    };
    match words {
        [word] => Ok(Kind::Number(scalar(word)?)),
        ["list", count, item] => Ok(Kind::List(scalar(count)?, scalar(item)?)),
        _ => {
            let found = format!("{:?}", words.join(" "));
            Err(Error::input(path, format!("the type of {name}"), found, "a number type, or a list of one"))
        }
    }
}
