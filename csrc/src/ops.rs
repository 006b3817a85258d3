//! Recording of the libtorch ops that a computation calls.

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("ops.h");

        /// Begins recording; see `csrc/ops.h`.
        fn start_recording_ops(outermost: bool);

        /// Ends recording and returns the ops; see `csrc/ops.h`.
        fn stop_recording_ops() -> Vec<String>;
    }
}

/// Runs `work` and returns its result and all libtorch ops that it ran on this thread, in order and by the names that `csrc/ops.h`
/// describes. These include ops called by other ops, and ops of backward passes on the CPU.
pub fn record_ops<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::start_recording_ops(false);
    let done = work();
    (done, ffi::stop_recording_ops())
}

/// Runs `work` and returns its result and the outermost libtorch ops that it ran on this thread, in order.
pub fn record_outermost_ops<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::start_recording_ops(true);
    let done = work();
    (done, ffi::stop_recording_ops())
}

/// Ops that return a view or allocate, or copy to another device. `reshape` and `flatten` copy a non-contiguous tensor, and those copies
/// aren't counted.
const VIEW_OPS: [&str; 24] = [
    "aten::alias",
    "aten::as_strided",
    "aten::chunk",
    "aten::detach",
    "aten::empty.memory_format",
    "aten::empty_like",
    "aten::expand",
    "aten::flatten.using_ints",
    "aten::narrow",
    "aten::new_empty_strided",
    "aten::permute",
    "aten::reshape",
    "aten::select.int",
    "aten::slice.Tensor",
    "aten::split.Tensor",
    "aten::squeeze.dim",
    "aten::t",
    "aten::to.device",
    "aten::transpose.int",
    "aten::unbind.int",
    "aten::unflatten.int",
    "aten::unsqueeze",
    "aten::view",
    "aten::view_as",
];

/// Ops for which the host waits: they return values to it, or their output sizes depend on values.
pub const WAITING: [&str; 7] = [
    "aten::_local_scalar_dense",
    "aten::equal",
    "aten::nonzero",
    "aten::masked_select",
    "aten::_unique2",
    "aten::linalg_pinv",
    "aten::repeat_interleave.Tensor",
];

/// Returns how many tensors `ops` send to a device, including the device on which they already are.
///
/// # Panics
/// Panics if one of the ops waits for a GPU.
pub fn count_device_copies(ops: &[String]) -> usize {
    let waits = ops.iter().find(|op| WAITING.contains(&op.as_str()));
    assert!(waits.is_none(), "{waits:?} waits");
    ops.iter().filter(|op| *op == "aten::to.device").count()
}

/// Returns the number of `ops` that compute something. On a GPU each is one kernel launch, or a few.
pub fn computing(ops: &[String]) -> usize {
    ops.iter().filter(|op| !VIEW_OPS.contains(&op.as_str())).count()
}

/// Returns `ops` without those of our own float32 linear layers, which compute a product in blocks on any of libtorch's threads.
pub fn without_own_linear_layers(mut ops: Vec<String>) -> Vec<String> {
    ops.retain(|op| !["aten::copy_", "aten::linear", "mkldnn::_linear_pointwise"].contains(&op.as_str()));
    ops
}
