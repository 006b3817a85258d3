//! Numbers of accessors.

use super::container::{Document, quoted};
use super::json::Accessor;
use crate::{Error, Result};

/// Types of components that an attribute may have, besides float.
#[derive(Clone, Copy, PartialEq)]
pub enum Components {
    /// Normalized bytes and shorts with a sign.
    NormalizedSigned,
    /// Normalized bytes and shorts without a sign.
    NormalizedUnsigned,
    /// Normalized bytes and shorts.
    Normalized,
    /// Bytes and shorts.
    Any,
}

impl Components {
    fn allow(self, scalar: Scalar, normalized: bool) -> bool {
        let is_signed = matches!(scalar, Scalar::I8 | Scalar::I16);
        scalar == Scalar::F32
            || match self {
                Components::NormalizedSigned => normalized && is_signed,
                Components::NormalizedUnsigned => normalized && !is_signed,
                Components::Normalized => normalized,
                Components::Any => true,
            }
    }

    fn names(self) -> &'static str {
        match self {
            Components::NormalizedSigned => "float (5126), or normalized byte (5120) or short (5122)",
            Components::NormalizedUnsigned => {
                "float (5126), or normalized unsigned byte (5121) or unsigned short (5123)"
            }
            Components::Normalized => {
                "float (5126), or normalized numbers of one or two bytes (5120 to 5123)"
            }
            Components::Any => "float (5126), or numbers of one or two bytes (5120 to 5123)",
        }
    }
}

/// Type of a component.
#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl Scalar {
    fn from_code(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Scalar::I8,
            5121 => Scalar::U8,
            5122 => Scalar::I16,
            5123 => Scalar::U16,
            5126 => Scalar::F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::F32 => 4,
        }
    }

    /// Returns the number in `bytes`, which has the length [`Scalar::size`].
    fn number(self, bytes: &[u8], normalized: bool) -> f32 {
        let (number, max) = match self {
            Scalar::F32 => return f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
            Scalar::I8 => (f64::from(i8::from_le_bytes([bytes[0]])), f64::from(i8::MAX)),
            Scalar::U8 => (f64::from(bytes[0]), f64::from(u8::MAX)),
            Scalar::I16 => (f64::from(i16::from_le_bytes([bytes[0], bytes[1]])), f64::from(i16::MAX)),
            Scalar::U16 => (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])), f64::from(u16::MAX)),
        };
        if normalized { (number / max).max(-1.) as f32 } else { number as f32 }
    }
}

impl Document<'_> {
    /// Returns accessor `index`, that of the attribute `name`.
    ///
    /// # Errors
    /// Returns an error if there is no such accessor.
    pub fn accessor(&self, index: usize, name: &str) -> Result<&Accessor> {
        let accessors = &self.gltf.accessors;
        let missing = || self.missing(&format!("the accessor of {name},"), index, accessors.len());
        accessors.get(index).ok_or_else(missing)
    }

    /// Reads accessor `index`, that of the attribute `name`, whose elements have `N` numbers.
    ///
    /// # Errors
    /// Returns an error if there is no such accessor, or it has other types or a number of elements other than `count`, or is sparse, or
    /// exceeds its buffer view.
    pub fn numbers<const N: usize>(
        &self,
        index: usize,
        name: &str,
        count: usize,
        components: Components,
    ) -> Result<Vec<[f32; N]>> {
        let accessor = self.accessor(index, name)?;
        let error = |field: &str, found: String, expected: &str| {
            Error::input(self.path, format!("{field} of accessor {index} ({name})"), found, expected)
        };
        let shape = if N == 1 { "SCALAR".to_string() } else { format!("VEC{N}") };
        if accessor.shape != shape {
            return Err(error("the type", quoted(&accessor.shape), &shape));
        }
        let scalar = Scalar::from_code(accessor.component_type)
            .filter(|&scalar| components.allow(scalar, accessor.normalized));
        let Some(scalar) = scalar else {
            let normalized = if accessor.normalized { ", normalized" } else { "" };
            let found = format!("{}{normalized}", accessor.component_type);
            return Err(error("the component type", found, components.names()));
        };
        if accessor.count != count {
            let expected = format!("{count}, as many as positions");
            return Err(error("the number of elements", accessor.count.to_string(), &expected));
        }
        if accessor.sparse.is_some() {
            return Err(error("the storage", "sparse".into(), "all elements in a buffer view"));
        }
        let Some(view) = accessor.buffer_view else {
            return Err(error("the buffer view", "missing".into(), "one"));
        };
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
        let element = |index: usize| -> [f32; N] {
            let bytes = &bytes[accessor.byte_offset + index * stride..];
            std::array::from_fn(|part| {
                scalar.number(&bytes[part * scalar.size()..][..scalar.size()], accessor.normalized)
            })
        };
        Ok((0..count).map(element).collect())
    }
}
