//! Tensors that the C++ side allocates and the Rust side owns.

use tch::Tensor;

/// Calls `op` and returns the N tensors that it allocates, like [`take_output_list`].
///
/// # Safety
/// As for [`take_output_list`].
///
/// # Errors
/// Returns the C++ exception that `op` throws.
pub(crate) unsafe fn take_outputs<const N: usize>(
    op: impl FnOnce(&mut [usize]) -> Result<(), cxx::Exception>,
) -> Result<[Tensor; N], cxx::Exception> {
    // SAFETY: the caller guarantees what `take_output_list` requires.
    let outputs = unsafe { take_output_list(N, op) }?;
    Ok(outputs.try_into().expect("N tensors"))
}

/// Calls `op` and returns the `count` tensors that it allocates. `op` writes the address of one `C_tensor` per tensor to the slice that it
/// receives, and the caller takes ownership of them.
///
/// # Safety
/// If `op` returns `Ok`, every element of the slice must be the address of a different, new `C_tensor` that nothing else owns.
///
/// # Errors
/// Returns the C++ exception that `op` throws.
pub(crate) unsafe fn take_output_list(
    count: usize,
    op: impl FnOnce(&mut [usize]) -> Result<(), cxx::Exception>,
) -> Result<Vec<Tensor>, cxx::Exception> {
    let mut out = vec![0usize; count];
    op(&mut out)?;
    // SAFETY: the caller guarantees that every element is the address of a new `C_tensor` that nothing else owns.
    Ok(out.into_iter().map(|p| unsafe { Tensor::from_ptr(p as *mut torch_sys::C_tensor) }).collect())
}
