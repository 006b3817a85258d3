//! Tensors that the C++ side makes.

use tch::Tensor;

/// The tensors that `op` leaves to its caller. Op puts their addresses, as of tch's `C_tensor`, in the places that it is given.
///
/// # Safety
/// Where `op` succeeds, it has put the address of a new tensor, which nobody else owns, in every place.
///
/// # Errors
/// Those of `op`.
pub(crate) unsafe fn handed_over<const N: usize>(
    op: impl FnOnce(&mut [usize]) -> Result<(), cxx::Exception>,
) -> Result<[Tensor; N], cxx::Exception> {
    let mut out = [0usize; N];
    op(&mut out)?;
    // SAFETY: the caller's promise.
    Ok(out.map(|p| unsafe { Tensor::from_ptr(p as *mut torch_sys::C_tensor) }))
}
