//! Location of a tensor in a file.

use crate::{Dtype, Id, Storages, Value, Values};
use half::f16;
use std::ops::Range;

/// Type, layout and location of a tensor in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Type of the elements.
    pub dtype: Dtype,
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// Distance in elements between neighbours along each dimension.
    pub strides: Vec<usize>,
    /// Byte range in the file, from the first element to the last.
    pub bytes: Range<usize>,
}

impl Array {
    /// Locates `tensor`, one of `values`, in its file. Whatever the file claims, the array lies inside the tensor's storage, has at most
    /// eight dimensions, and has no more elements than the storage.
    ///
    /// # Errors
    /// Returns a description of the problem, phrased to follow the name of the tensor: "reaches beyond its data of 64 bytes".
    pub fn locate(values: &Values, storages: &Storages, tensor: &Value) -> Result<Self, String> {
        let &Value::Tensor { storage, offset, size, stride } = tensor else {
            return Err(format!("has {}, expected a tensor", tensor.type_name()));
        };
        let plain = || "is no plain tensor".to_string();
        let &Value::Storage { dtype, key } = values.get(storage) else { return Err(plain()) };
        let storage = storages.get(key);
        let storage = storage.ok_or_else(|| format!("asks for data/{key}, which is missing"))?;
        let offset = number(values, offset).ok_or_else(plain)?;
        let shape = numbers(values, size).ok_or_else(plain)?;
        let strides = numbers(values, stride).ok_or_else(plain)?;
        if shape.len() != strides.len() {
            return Err(plain());
        }
        let beyond = || format!("reaches beyond its data of {} bytes", storage.len());
        let (count, span) = extent(&shape, &strides).ok_or_else(beyond)?;
        if count > span {
            return Err(plain());
        }
        let range = || {
            let start = offset.checked_mul(dtype.bitsize() / 8)?;
            let end = start.checked_add(span.checked_mul(dtype.bitsize() / 8)?)?;
            (end <= storage.len()).then(|| storage.start + start..storage.start + end)
        };
        Ok(Array { dtype, bytes: range().ok_or_else(beyond)?, shape, strides })
    }

    /// Returns `true` if the elements are real floating-point numbers.
    pub fn is_float(&self) -> bool {
        matches!(self.dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64)
    }

    /// Returns `true` if the elements are contiguous, in row-major order.
    pub fn is_contiguous(&self) -> bool {
        let strides = self.strides.iter().zip(row_major(&self.shape));
        self.bytes.is_empty()
            || self.shape.iter().zip(strides).all(|(&size, (&stride, dense))| size == 1 || stride == dense)
    }

    /// Returns the elements as float32, in row-major order. `file` is the contents of the array's file. Values are rounded to the nearest
    /// float32, as in PyTorch's `tensor.float()`.
    ///
    /// # Errors
    /// Returns a description of the problem, phrased to follow the name of the tensor, if the elements aren't real floating-point numbers
    /// or the array reaches beyond `file`.
    pub fn to_f32(&self, file: &[u8]) -> Result<Vec<f32>, String> {
        let bytes = file.get(self.bytes.clone()).ok_or("reaches beyond its file")?;
        let values: Vec<f32> = match self.dtype {
            Dtype::F16 => decode(bytes, |bytes| f16::from_le_bytes(bytes).to_f32()),
            // Unlike half's conversion, this keeps the bits of signaling NaN.
            Dtype::BF16 => decode(bytes, |bytes| f32::from_bits(u32::from(u16::from_le_bytes(bytes)) << 16)),
            Dtype::F32 => decode(bytes, f32::from_le_bytes),
            Dtype::F64 => decode(bytes, |bytes| f64::from_le_bytes(bytes) as f32),
            other => return Err(format!("has elements of type {other}, expected F16, BF16, F32 or F64")),
        };
        if self.is_contiguous() {
            return Ok(values);
        }
        let mut indices = vec![0];
        for (&size, &stride) in self.shape.iter().zip(&self.strides) {
            let index = |start: usize, i: usize| start.saturating_add(stride.saturating_mul(i));
            indices = indices.iter().flat_map(|&start| (0..size).map(move |i| index(start, i))).collect();
        }
        let value = |index: usize| values.get(index).copied().ok_or("reaches beyond its data".to_string());
        indices.into_iter().map(value).collect()
    }
}

/// Returns the strides of a contiguous tensor, last dimension fastest. The strides of a tensor without elements are meaningless; a stride
/// whose product overflows is 1.
pub fn row_major(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1usize; shape.len()];
    for i in (1..shape.len()).rev() {
        strides[i - 1] = strides[i].checked_mul(shape[i].max(1)).unwrap_or(1);
    }
    strides
}

/// Decodes elements of `N` bytes.
fn decode<const N: usize>(bytes: &[u8], value: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|&element| value(element)).collect()
}

/// Returns the number of elements of a tensor, and the number of elements of memory from its first to its last, or `None` on overflow.
fn extent(shape: &[usize], strides: &[usize]) -> Option<(usize, usize)> {
    let count = shape.iter().try_fold(1usize, |count, &size| count.checked_mul(size))?;
    if count == 0 {
        return Some((0, 0));
    }
    let span = shape
        .iter()
        .zip(strides)
        .try_fold(1usize, |span, (&size, &stride)| span.checked_add((size - 1).checked_mul(stride)?))?;
    Some((count, span))
}

fn number(values: &Values, id: Id) -> Option<usize> {
    values.get(id).as_int().and_then(|number| usize::try_from(number).ok())
}

fn numbers(values: &Values, tuple: Id) -> Option<Vec<usize>> {
    /// Maximum number of dimensions, which weights don't reach. The limit keeps the size of the result in proportion to the length of the
    /// pickle.
    const MAX_DIMENSIONS: usize = 8;
    match values.get(tuple) {
        Value::Tuple(items) if items.len() <= MAX_DIMENSIONS => {
            items.iter().map(|&item| number(values, item)).collect()
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_converted_in_row_major_order() {
        let numbers = [0.5f32, 1., 2., 3., 4., 5.].map(f32::to_le_bytes).concat();
        let file = [b"head", numbers.as_slice()].concat();
        let array = |shape: &[usize], strides: &[usize], bytes| {
            Array { dtype: Dtype::F32, shape: shape.into(), strides: strides.into(), bytes }.to_f32(&file)
        };
        assert_eq!(array(&[2, 3], &[3, 1], 4..28).unwrap(), [0.5, 1., 2., 3., 4., 5.]);
        assert_eq!(array(&[3, 2], &[1, 3], 4..28).unwrap(), [0.5, 3., 1., 4., 2., 5.]);
        assert_eq!(array(&[3], &[2], 8..28).unwrap(), [1., 3., 5.]);
        assert_eq!(array(&[], &[], 12..16).unwrap(), [2.]);
        assert_eq!(array(&[4, 0], &[1, 1], 4..4).unwrap(), [0f32; 0]);
        assert_eq!(array(&[2], &[9], 4..28).unwrap_err(), "reaches beyond its data");
        assert_eq!(array(&[2], &[usize::MAX], 4..28).unwrap_err(), "reaches beyond its data");
        assert_eq!(array(&[2], &[1], 24..32).unwrap_err(), "reaches beyond its file");
    }

    #[test]
    fn steps_of_a_tensor_without_elements_do_not_overflow() {
        assert_eq!(row_major(&[2, 3, 5]), [15, 5, 1]);
        assert_eq!(row_major(&[0, 3, 5]), [15, 5, 1]);
        assert_eq!(row_major(&[0, usize::MAX, 2]), [1, 2, 1]);
    }
}
