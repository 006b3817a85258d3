//! Which ops libtorch is asked for.

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("ops.h");

        /// See `csrc/ops.h`.
        fn note_ops(outermost: bool);

        /// See `csrc/ops.h`.
        fn noted_ops() -> Vec<String>;
    }
}

/// What `work` gives, and the ops that it had libtorch do on this thread, by the names that `csrc/ops.h` tells, in their order: those
/// inside of others, and of backward passes on the CPU, too.
pub fn ops_of<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::note_ops(false);
    let done = work();
    (done, ffi::noted_ops())
}

/// Runs `work` and returns its result and the outermost libtorch ops that it ran on this thread, in order.
pub fn outermost_ops_of<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    ffi::note_ops(true);
    let done = work();
    (done, ffi::noted_ops())
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

/// Ops whose answer the host waits for: numbers that it reads, and sizes that depend on values.
pub const WAITING: [&str; 7] = [
    "aten::_local_scalar_dense",
    "aten::equal",
    "aten::nonzero",
    "aten::masked_select",
    "aten::_unique2",
    "aten::linalg_pinv",
    "aten::repeat_interleave.Tensor",
];

/// Returns how many tensors `ops` send to a device, be it the one where they are.
///
/// # Panics
/// An op waits for a GPU.
pub fn moves(ops: &[String]) -> usize {
    let waits = ops.iter().find(|op| WAITING.contains(&op.as_str()));
    assert!(waits.is_none(), "{waits:?} waits");
    ops.iter().filter(|op| *op == "aten::to.device").count()
}

/// Returns how many of `ops` compute something. On a GPU each is a launch, or a few.
pub fn computing(ops: &[String]) -> usize {
    ops.iter().filter(|op| !VIEW_OPS.contains(&op.as_str())).count()
}

/// Returns `ops` without those of our own linear layers in float32, which take a product in blocks on any of libtorch's threads.
pub fn without_own_linear_layers(mut ops: Vec<String>) -> Vec<String> {
    ops.retain(|op| !["aten::copy_", "aten::linear", "mkldnn::_linear_pointwise"].contains(&op.as_str()));
    ops
}
