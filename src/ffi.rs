//! Tensors that the C++ side allocates and the Rust side owns.

use tch::Tensor;

/// Returns the tensor at `address`, and takes ownership of it.
///
/// # Safety
/// `address` must be that of a new `C_tensor` that nothing else owns.
pub(crate) unsafe fn take_tensor(address: usize) -> Tensor {
    // SAFETY: guaranteed by the caller.
    unsafe { Tensor::from_ptr(address as *mut torch_sys::C_tensor) }
}

/// Returns the N tensors at `addresses`, and takes ownership of them.
///
/// # Safety
/// Every address must be that of a different, new `C_tensor` that nothing else owns.
///
/// # Panics
/// Panics if there aren't N addresses.
pub(crate) unsafe fn take_tensors<const N: usize>(addresses: Vec<usize>) -> [Tensor; N] {
    let addresses: [usize; N] = addresses.try_into().expect("N tensors");
    // SAFETY: guaranteed by the caller.
    addresses.map(|address| unsafe { take_tensor(address) })
}
