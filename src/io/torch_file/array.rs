//! Location of a tensor in a file.

use super::Storages;
use super::value::{Id, Value, Values};
use std::ops::Range;
use tch::Kind;

/// Type, layout and location of a tensor in a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    pub dtype: Kind,
    pub size: Vec<usize>,
    /// Strides in elements.
    pub stride: Vec<usize>,
    /// Byte range in the file, from the first element to the last.
    pub bytes: Range<usize>,
}

impl Array {
    /// Locates `tensor` in its file. Whatever the file claims, the array lies inside the tensor's storage and has no more elements than the
    /// storage.
    ///
    /// # Errors
    /// Returns a description of the problem, phrased to follow the name of the tensor.
    pub fn of(values: &Values, storages: &Storages, tensor: &Value) -> Result<Self, String> {
        let &Value::Tensor { storage, offset, size, stride } = tensor else {
            return Err(format!("has {}, expected a tensor", tensor.name()));
        };
        let plain = || "is no plain tensor".to_string();
        let &Value::Storage { dtype, key } = values.get(storage) else { return Err(plain()) };
        let storage = storages.get(key);
        let storage = storage.ok_or_else(|| format!("asks for data/{key}, which is not there"))?;
        let offset = number(values, offset).ok_or_else(plain)?;
        let (size, stride) =
            (numbers(values, size).ok_or_else(plain)?, numbers(values, stride).ok_or_else(plain)?);
        if size.len() != stride.len() {
            return Err(plain());
        }
        let beyond = || format!("reaches beyond its data of {} bytes", storage.len());
        let (count, span) = extent(&size, &stride).ok_or_else(beyond)?;
        if count > span {
            return Err(plain());
        }
        let place = || {
            let start = offset.checked_mul(dtype.elt_size_in_bytes())?;
            let end = start.checked_add(span.checked_mul(dtype.elt_size_in_bytes())?)?;
            (end <= storage.len()).then(|| storage.start + start..storage.start + end)
        };
        Ok(Array { dtype, bytes: place().ok_or_else(beyond)?, size, stride })
    }

    /// Returns `true` if the elements are contiguous, in row-major order.
    pub fn is_contiguous(&self) -> bool {
        let steps = self.stride.iter().zip(row_major(&self.size));
        self.bytes.is_empty()
            || self.size.iter().zip(steps).all(|(&size, (&stride, dense))| size == 1 || stride == dense)
    }
}

/// Returns the strides of a contiguous tensor, last dimension fastest. The strides of a tensor without elements are meaningless; a stride
/// whose product overflows is 1.
pub(crate) fn row_major(size: &[usize]) -> Vec<usize> {
    let mut stride = vec![1usize; size.len()];
    for i in (1..size.len()).rev() {
        stride[i - 1] = stride[i].checked_mul(size[i].max(1)).unwrap_or(1);
    }
    stride
}

/// Returns the number of elements of a tensor, and the number of elements of memory from its first to its last, or `None` on overflow.
fn extent(size: &[usize], stride: &[usize]) -> Option<(usize, usize)> {
    let count = size.iter().try_fold(1usize, |count, &size| count.checked_mul(size))?;
    if count == 0 {
        return Some((0, 0));
    }
    let steps = size.iter().zip(stride);
    let span = steps
        .into_iter()
        .try_fold(1usize, |span, (&size, &stride)| span.checked_add((size - 1).checked_mul(stride)?))?;
    Some((count, span))
}

fn number(values: &Values, id: Id) -> Option<usize> {
    values.get(id).integer().and_then(|number| usize::try_from(number).ok())
}

fn numbers(values: &Values, tuple: Id) -> Option<Vec<usize>> {
    /// Maximum number of dimensions, which weights don't reach. The limit keeps the size of the result in proportion to the length of the
    /// pickle.
    const MOST: usize = 8;
    match values.get(tuple) {
        Value::Tuple(items) if items.len() <= MOST => {
            items.iter().map(|&item| number(values, item)).collect()
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::row_major;

    #[test]
    fn steps_of_a_tensor_without_elements_do_not_overflow() {
        assert_eq!(row_major(&[2, 3, 5]), [15, 5, 1]);
        assert_eq!(row_major(&[0, 3, 5]), [15, 5, 1]);
        assert_eq!(row_major(&[0, usize::MAX, 2]), [1, 2, 1]);
    }
}
