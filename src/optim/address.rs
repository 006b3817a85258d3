//! Addresses by which the C++ side refers to tensors.

use tch::Tensor;

/// Returns the address of a tensor. It is valid as long as the tensor lives.
pub(super) fn address(t: &Tensor) -> usize {
    t.as_ptr() as usize
}

/// Returns the addresses of several tensors.
pub(super) fn addresses<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> Vec<usize> {
    tensors.into_iter().map(address).collect()
}
