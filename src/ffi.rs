//! Tensors that the C++ side allocates and the Rust side owns.

use tch::Tensor;

/// Calls `op` and returns the tensors that it hands over to its caller. `op` writes one address per tensor, that of tch's `C_tensor`, to
/// the slice that it is given.
///
/// # Safety
/// If `op` succeeds, it must have written the address of a new tensor that nothing else owns to every element of the slice.
///
/// # Errors
/// Returns the exception of `op`.
pub(crate) unsafe fn take_outputs<const N: usize>(
    op: impl FnOnce(&mut [usize]) -> Result<(), cxx::Exception>,
) -> Result<[Tensor; N], cxx::Exception> {
    let mut out = [0usize; N];
    op(&mut out)?;
    // SAFETY: the caller guarantees that every address is that of a new tensor that nothing else owns.
    Ok(out.map(|p| unsafe { Tensor::from_ptr(p as *mut torch_sys::C_tensor) }))
}
