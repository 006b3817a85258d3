//! By what the C++ side knows tensors.

use tch::Tensor;

/// A tensor's, as long as it lives.
pub(super) fn address(t: &Tensor) -> usize {
    t.as_ptr() as usize
}

/// Those of several.
pub(super) fn addresses<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> Vec<usize> {
    tensors.into_iter().map(address).collect()
}
