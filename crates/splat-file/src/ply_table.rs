//! Tables of a PLY: its header, which describes the elements and their properties, and the numbers of selected properties, among any other
//! elements and properties (spec 10.9).

use crate::numbers::Scalar;
use crate::{Error, Result};
use std::path::Path;

/// Encoding of numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
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
    name: String,
    /// Number of rows, as the file claims.
    pub count: usize,
    pub properties: Vec<Property>,
}

impl Element {
    pub fn property(&self, name: &str) -> Option<&Property> {
        self.index_of(name).map(|index| &self.properties[index])
    }

    /// Returns the index of the property `name`. If there is none, that of the property with the prefix of CloudCompare's PLYs, `scalar_`,
    /// of 3dgsconverter's, `scal_`, or of both.
    fn index_of(&self, name: &str) -> Option<usize> {
        let names = || self.properties.iter().map(|property| &*property.name);
        let own = |full: &str| full.trim_start_matches("scalar_").trim_start_matches("scal_") == name;
        names().position(|full| full == name).or_else(|| names().position(own))
    }
}

pub struct Header {
    /// Number of bytes up to the first row.
    length: usize,
    encoding: Encoding,
    elements: Vec<Element>,
    /// `true` if a comment says that the splat is antialiased.
    pub antialiased: bool,
}

impl Header {
    /// Returns `true` if `bytes` begin like a PLY.
    pub fn begins(bytes: &[u8]) -> bool {
        bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
    }

    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let error = |field: String, found: &str, expected: &str| Error::input(path, field, found, expected);
        if !Self::begins(bytes) {
            return Err(error("the file".into(), "no PLY", "a PLY of a 3D Gaussian splat"));
        }
        let (mut length, mut encoding, mut antialiased) = (0, None, false);
        let mut elements: Vec<Element> = vec![];
        for line in bytes.split_inclusive(|&byte| byte == b'\n') {
            length += line.len();
            let text = String::from_utf8_lossy(line);
            let words: Vec<&str> = text.split_whitespace().collect();
            match words.as_slice() {
                ["end_header"] if line.ends_with(b"\n") => {
                    let missing = || error("the line format".into(), "missing", "how numbers are written");
                    let encoding = encoding.ok_or_else(missing)?;
                    return Ok(Header { length, encoding, elements, antialiased });
                }
                ["format", name, ..] => {
                    encoding = Some(match *name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => {
                            let expected = "ascii, binary_little_endian or binary_big_endian";
                            return Err(error("the format".into(), name, expected));
                        }
                    });
                }
                ["element", name, count] => {
                    let Ok(count) = count.parse() else {
                        let field = format!("the number of rows of the element {name}");
                        return Err(error(field, count, "a whole number"));
                    };
                    elements.push(Element { name: name.to_string(), count, properties: vec![] });
                }
                ["property", kind @ .., name] => {
                    let Some(element) = elements.last_mut() else {
                        let field = format!("the property {name}");
                        return Err(error(field, "without an element", "a line element before it"));
                    };
                    let kind = parse_kind(path, kind, name)?;
                    element.properties.push(Property { name: name.to_string(), kind });
                }
                // The first form is that of Brush, gsplat and nerfstudio, the second one Postshot's. The last comment counts.
                ["comment", comment @ ..] => {
                    let comment = comment.concat().to_ascii_lowercase();
                    match comment.strip_prefix("splatrendermode:") {
                        Some(mode) => antialiased = mode == "mip",
                        None if comment == "antialiased1" => antialiased = true,
                        None if comment == "antialiased0" => antialiased = false,
                        None => {}
                    }
                }
                _ => {}
            }
        }
        Err(error("the header".into(), "without its end", "a line end_header"))
    }

    /// Returns the lines at the beginning of a written header, up to the first element.
    pub fn first_lines(antialiased: bool) -> String {
        let comment = if antialiased { "comment SplatRenderMode: mip\n" } else { "" };
        format!("ply\nformat binary_little_endian 1.0\n{comment}")
    }

    pub fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == name)
    }

    /// Returns the numbers of the properties `names` of an element, row by row, each converted by `convert`. They must be of type `scalar`, if
    /// it is given. Other elements and properties are skipped. `bytes` are the contents of the file at `path`, which end with the elements.
    pub fn columns<T>(
        &self,
        path: &Path,
        bytes: &[u8],
        element: &str,
        names: &[String],
        scalar: Option<Scalar>,
        convert: impl Fn(f64) -> T,
    ) -> Result<Vec<T>> {
        let mut body = Body { path, rest: &bytes[self.length..], encoding: self.encoding };
        let Some(index) = self.elements.iter().position(|own| own.name == element) else {
            return Err(Error::input(path, format!("the element {element}"), "missing", "the Gaussians"));
        };
        let element = &self.elements[index];
        self.elements[..index].iter().try_for_each(|before| body.skip_rows(before))?;
        // Index in `names` of each property of the element.
        let mut places: Vec<Option<usize>> = vec![None; element.properties.len()];
        for (place, name) in names.iter().enumerate() {
            let refuse = |found: &str, expected: &str| {
                Err(Error::input(path, format!("property {name}"), found, expected))
            };
            let at = element.index_of(name);
            match at.map(|at| element.properties[at].kind) {
                None => return refuse("missing", "one of a 3D Gaussian splat's properties"),
                Some(Kind::List(..)) => return refuse("a list", "numbers"),
                Some(Kind::Number(found)) if scalar.is_some_and(|scalar| scalar != found) => {
                    return refuse(
                        "of another type",
                        if scalar == Some(Scalar::U8) { "uchar" } else { "uint" },
                    );
                }
                Some(Kind::Number(_)) => {}
            }
            at.into_iter().for_each(|at| places[at] = Some(place));
        }
        let mut values = vec![];
        let mut row = vec![0.; names.len()];
        body.read_rows(element, |property, number| {
            if let Some(place) = places[property] {
                row[place] = number;
            }
            if property + 1 == places.len() {
                values.extend(row.iter().map(|&number| convert(number)));
            }
        })?;
        self.elements[index + 1..].iter().try_for_each(|after| body.skip_rows(after))?;
        if !body.rest.iter().all(is_blank) {
            let size = bytes.len() - body.rest.len();
            let expected = format!("{size}, where the header's elements end");
            return Err(Error::input(path, "the size", format!("{} bytes", bytes.len()), expected));
        }
        Ok(values)
    }
}

fn parse_kind(path: &Path, words: &[&str], name: &str) -> Result<Kind> {
    let field = || format!("the type of {name}");
    let scalar = |word: &str| {
        Ok(match word {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return Err(Error::input(path, field(), word, "a PLY number type")),
        })
    };
    match words {
        [word] => Ok(Kind::Number(scalar(word)?)),
        ["list", count, item] => Ok(Kind::List(scalar(count)?, scalar(item)?)),
        _ => {
            let found = format!("{:?}", words.join(" "));
            Err(Error::input(path, field(), found, "a number type, or a list of one"))
        }
    }
}

/// Returns `true` for white space, and for NUL, with which programs pad files.
fn is_blank(byte: &u8) -> bool {
    byte.is_ascii_whitespace() || *byte == 0
}

/// The part of the file that is still to be read.
struct Body<'a> {
    path: &'a Path,
    rest: &'a [u8],
    encoding: Encoding,
}

impl Body<'_> {
    /// Reads the rows of an element. Calls `visit` with the index of each property and its number, which is its length for a list.
    fn read_rows(&mut self, element: &Element, mut visit: impl FnMut(usize, f64)) -> Result<()> {
        if element.properties.is_empty() {
            return Ok(()); // however many rows there are
        }
        let path = self.path;
        for row in 0..element.count {
            for (index, Property { name, kind }) in element.properties.iter().enumerate() {
                let refuse = |found: String| {
                    let field = format!("{name} in row {row} of {}", element.name);
                    Error::input(path, field, found, format!("numbers in {} rows", element.count))
                };
                let (Kind::Number(scalar) | Kind::List(scalar, _)) = *kind;
                let number = self.number(scalar).map_err(refuse)?;
                if let Kind::List(_, item) = *kind {
                    if number < 0. || number.fract() != 0. {
                        return Err(refuse(format!("a list of the length {number}")));
                    }
                    for _ in 0..number as u64 {
                        self.number(item).map_err(refuse)?;
                    }
                }
                visit(index, number);
            }
        }
        Ok(())
    }

    /// Skips the rows of an element: at once if their size is fixed and the bytes are there.
    fn skip_rows(&mut self, element: &Element) -> Result<()> {
        let size_of = |property: &Property| match property.kind {
            Kind::Number(scalar) if self.encoding != Encoding::Ascii => Some(scalar.size()),
            _ => None,
        };
        let width: Option<usize> = element.properties.iter().map(size_of).sum();
        match width.and_then(|width| self.rest.get(width.checked_mul(element.count)?..)) {
            Some(rest) => self.rest = rest,
            None => self.read_rows(element, |_, _| ())?,
        }
        Ok(())
    }

    /// Reads a number, or returns what is there instead.
    fn number(&mut self, scalar: Scalar) -> Result<f64, String> {
        if self.encoding == Encoding::Ascii {
            let text = self.rest.trim_ascii_start();
            let length = text.iter().position(is_blank).unwrap_or(text.len());
            let (word, rest) = text.split_at(length);
            if word.is_empty() {
                return Err("cut short".into());
            }
            self.rest = rest;
            let found = || format!("{:?}", String::from_utf8_lossy(&word[..word.len().min(20)]));
            return std::str::from_utf8(word).ok().and_then(|word| word.parse().ok()).ok_or_else(found);
        }
        let (number, rest) = self.rest.split_at_checked(scalar.size()).ok_or("cut short")?;
        self.rest = rest;
        if self.encoding == Encoding::LittleEndian {
            return Ok(scalar.read(number));
        }
        let reversed: Vec<u8> = number.iter().rev().copied().collect();
        Ok(scalar.read(&reversed))
    }
}
