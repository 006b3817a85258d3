//! Rows of a PLY, among any other elements and properties (spec 10.9).

use crate::ply_header::{Element, Encoding, Header, Kind, Scalar};
use crate::{Error, Result};
use std::path::Path;

/// Returns the numbers of the properties `names` of an element, row by row, each converted by `convert`. Other elements and properties are
/// skipped.
///
/// # Errors
/// Returns an error if an element or a property is missing, a property is a list instead of a number, the file is truncated, or a text
/// isn't a number.
pub fn columns<T>(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    element: &str,
    names: &[String],
    convert: impl Fn(f64) -> T,
) -> Result<Vec<T>> {
    let mut body = Body { path, rest: &bytes[header.length..], encoding: header.encoding };
    for before in header.elements.iter().take_while(|before| before.name != element) {
        body.skip_element(before)?;
    }
    let Some(element) = header.element(element) else {
        return Err(Error::input(path, format!("the element {element}"), "missing", "the Gaussians"));
    };
    // Index in `names` of each property of the element.
    let mut places: Vec<Option<usize>> = vec![None; element.properties.len()];
    for (place, name) in names.iter().enumerate() {
        let at = element.properties.iter().position(|property| property.name == *name);
        match at.map(|at| (at, element.properties[at].kind)) {
            Some((at, Kind::Number(_))) => places[at] = Some(place),
            Some((_, Kind::List(..))) => {
                return Err(Error::input(path, format!("property {name}"), "a list", "numbers"));
            }
            None => {
                let expected = "one of a 3D Gaussian splat's properties";
                return Err(Error::input(path, format!("property {name}"), "missing", expected));
            }
        }
    }
    body.check_length(element)?;
    let mut values = Vec::with_capacity(element.count * names.len());
    let mut row_values = vec![0.; names.len()];
    for row in 0..element.count {
        for (property, place) in element.properties.iter().zip(&places) {
            match (property.kind, place) {
                (Kind::Number(scalar), Some(place)) => {
                    row_values[*place] = body.number(scalar, element, row, &property.name)?;
                }
                (kind, _) => body.skip_property(kind, element, row, &property.name)?,
            }
        }
        values.extend(row_values.iter().map(|&value| convert(value)));
    }
    Ok(values)
}

/// The part of the file that is still to be read.
struct Body<'a> {
    path: &'a Path,
    rest: &'a [u8],
    encoding: Encoding,
}

impl Body<'_> {
    /// Checks that the file is long enough for the rows that the header claims. No memory is allocated for them before this check.
    fn check_length(&self, element: &Element) -> Result<()> {
        let smallest = |kind: Kind| match (self.encoding, kind) {
            (Encoding::Ascii, _) => 2, // a digit and a separator
            (_, Kind::Number(scalar) | Kind::List(scalar, _)) => scalar.size(),
        };
        let row: usize = element.properties.iter().map(|property| smallest(property.kind)).sum();
        let needed = row as u128 * element.count as u128;
        // The separator after the last number may be missing.
        let there = self.rest.len() as u128 + u128::from(self.encoding == Encoding::Ascii);
        if there < needed {
            let found = format!("cut short: {} bytes of the element {}", self.rest.len(), element.name);
            let expected = format!("{needed} bytes at least for its {} rows", element.count);
            return Err(Error::input(self.path, "the body", found, expected));
        }
        Ok(())
    }

    fn skip_element(&mut self, element: &Element) -> Result<()> {
        self.check_length(element)?;
        if element.properties.is_empty() {
            return Ok(()); // however many rows there are
        }
        for row in 0..element.count {
            for property in &element.properties {
                self.skip_property(property.kind, element, row, &property.name)?;
            }
        }
        Ok(())
    }

    fn skip_property(&mut self, kind: Kind, element: &Element, row: usize, name: &str) -> Result<()> {
        match kind {
            Kind::Number(scalar) => self.number(scalar, element, row, name).map(drop),
            Kind::List(count, item) => {
                let items = self.number(count, element, row, name)?;
                if items < 0. || items.fract() != 0. {
                    let field = format!("the length of the list {name} in row {row} of {}", element.name);
                    return Err(Error::input(self.path, field, items, "a whole number"));
                }
                for _ in 0..items as u64 {
                    self.number(item, element, row, name)?;
                }
                Ok(())
            }
        }
    }

    /// Reads the next number. `element`, `row` and `name` are for the error message.
    fn number(&mut self, scalar: Scalar, element: &Element, row: usize, name: &str) -> Result<f64> {
        let cut_short = || {
            let found = format!("cut short: at {name} in row {row} of {}", element.name);
            Error::input(self.path, "the body", found, format!("{} rows", element.count))
        };
        if self.encoding == Encoding::Ascii {
            let text = self.rest.trim_ascii_start();
            let length = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
            let (word, rest) = text.split_at(length);
            if word.is_empty() {
                return Err(cut_short());
            }
            let parsed = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
            let Some(number) = parsed else {
                let found = String::from_utf8_lossy(&word[..word.len().min(20)]).into_owned();
                let field = format!("{name} in row {row} of {}", element.name);
                return Err(Error::input(self.path, field, format!("{found:?}"), "a number"));
            };
            self.rest = rest;
            return Ok(number);
        }
        let (number, rest) = self.rest.split_at_checked(scalar.size()).ok_or_else(cut_short)?;
        self.rest = rest;
        // Eight bytes hold any type, lowest byte first.
        let mut bytes = [0; 8];
        bytes[..number.len()].copy_from_slice(number);
        if self.encoding == Encoding::BigEndian {
            bytes[..number.len()].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match scalar {
            Scalar::I8 => f64::from(a as i8),
            Scalar::U8 => f64::from(a),
            Scalar::I16 => f64::from(i16::from_le_bytes([a, b])),
            Scalar::U16 => f64::from(u16::from_le_bytes([a, b])),
            Scalar::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Scalar::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Scalar::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Scalar::F64 => f64::from_le_bytes(bytes),
        })
    }
}
