//! What the process runs on: GPU events, copies to a GPU, memory statistics, features of the processor, threads, and records of what libtorch
//! runs. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`. A GPU is given by its CUDA device index.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// CPU instructions for bf16 matrix products.
    #[derive(Debug)]
    enum Bf16Support {
        /// No instructions: bf16 products are slower than float32 products.
        None,
        /// Vector instructions (avx512_bf16, or FEAT_BF16 of ARM64): bf16 products are about twice as fast as float32 products.
        Vectors,
        /// Tile instructions (AMX): bf16 products are many times as fast as float32 products.
        Tiles,
    }

    /// Op that libtorch ran.
    #[derive(Debug)]
    struct RecordedOp {
        /// Full name, as in `aten::add.Tensor`. An op that moves a tensor to a device, including the device on which it already is, is
        /// `aten::to.device`.
        name: String,
        /// `true` if no other op called it.
        is_outermost: bool,
    }

    unsafe extern "C++" {
        include!("runtime.h");

        /// Event in a GPU's stream; see `csrc/runtime.h`.
        type CudaEvent;

        /// Records an event in a GPU's current stream; see `csrc/runtime.h`.
        fn record_event(gpu: i32) -> Result<UniquePtr<CudaEvent>>;

        /// Returns the milliseconds between two events; see `csrc/runtime.h`.
        fn milliseconds_since(self: &CudaEvent, earlier: &CudaEvent) -> Result<f64>;

        /// Copies on a GPU that may still be in progress; see `csrc/runtime.h`.
        type PendingCopies;

        /// Returns the copied tensors; see `csrc/runtime.h`.
        fn take_tensors(self: &PendingCopies) -> Result<Vec<usize>>;

        /// Stream for copies to a GPU; see `csrc/runtime.h`.
        type CopyStream;

        /// Creates a stream for copies; see `csrc/runtime.h`.
        fn copy_stream(gpu: i32) -> Result<UniquePtr<CopyStream>>;

        /// Starts copying tensors to the GPU; see `csrc/runtime.h`.
        ///
        /// # Safety
        /// `tensors` must be addresses of live tensors.
        unsafe fn copy(self: &CopyStream, tensors: &[usize]) -> Result<UniquePtr<PendingCopies>>;

        /// Allocates a tensor in page-locked memory; see `csrc/runtime.h`.
        fn empty_pinned_bytes(shape: &[i64]) -> Result<usize>;

        /// Returns the peak of a GPU's tensor memory in bytes; see `csrc/runtime.h`.
        fn max_memory_allocated(gpu: i32) -> Result<u64>;

        /// Resets the peak of a GPU's tensor memory; see `csrc/runtime.h`.
        fn reset_peak_memory_stats(gpu: i32) -> Result<()>;

        /// Disables TF32 in convolutions; see `csrc/runtime.h`.
        fn disable_tf32();

        /// Returns the CPU's bf16 instructions that libtorch detects, or `None` if `GLOBALSPLAT_SIMD` disables them.
        fn cpu_bf16_support() -> Bf16Support;

        /// Returns the instruction set of libtorch's own kernels, such as "AVX2".
        fn libtorch_simd_level() -> String;

        /// Returns `true` if the current GPU has bf16 instructions.
        fn gpu_has_bf16() -> bool;

        /// Makes this thread treat denormal numbers as 0; see `csrc/runtime.h`.
        fn flush_denormals();

        /// Begins recording; see `csrc/runtime.h`.
        fn start_recording_ops();

        /// Ends recording and returns the ops; see `csrc/runtime.h`.
        fn stop_recording_ops() -> Vec<RecordedOp>;

        /// Begins counting the bytes of tensors; see `csrc/runtime.h`.
        fn start_counting_tensor_bytes();

        /// Ends counting and returns the peak; see `csrc/runtime.h`.
        fn stop_counting_tensor_bytes() -> u64;

        /// Returns the number of threads of our own kernels; see `csrc/runtime.h`.
        fn get_num_threads() -> i32;

        /// Sets the number of threads of our own kernels; see `csrc/runtime.h`.
        fn set_num_threads(count: i32);

        /// Returns the version of the libtorch whose headers this was compiled with.
        fn libtorch_version() -> String;

        /// Removes stack traces from libtorch's errors; see `csrc/runtime.h`.
        fn disable_stack_traces();
    }
}

// SAFETY: libtorch's streams and events are not bound to a thread.
unsafe impl Send for CudaEvent {}
// SAFETY: as above, and tensors may be sent between threads.
unsafe impl Send for PendingCopies {}
// SAFETY: as above.
unsafe impl Send for CopyStream {}

/// Runs `work` and returns its result and all libtorch ops that it ran on this thread, in order. These include ops called by other ops, and
/// ops of backward passes on the CPU.
pub fn record_ops<T>(work: impl FnOnce() -> T) -> (T, Vec<RecordedOp>) {
    ffi::start_recording_ops();
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
pub fn count_device_copies(ops: &[RecordedOp]) -> usize {
    let waits = ops.iter().find(|op| WAITING.contains(&op.name.as_str()));
    assert!(waits.is_none(), "{waits:?} waits");
    ops.iter().filter(|op| op.name == "aten::to.device").count()
}

/// Returns the number of outermost `ops` that compute something. On a GPU each is one kernel launch, or a few.
pub fn computing(ops: &[RecordedOp]) -> usize {
    ops.iter().filter(|op| op.is_outermost && !VIEW_OPS.contains(&op.name.as_str())).count()
}

/// Runs `work` and returns its result and the peak of the bytes that its tensors took on this thread, on the CPU.
pub fn peak_tensor_bytes<T>(work: impl FnOnce() -> T) -> (T, u64) {
    ffi::start_counting_tensor_bytes();
    let done = work();
    (done, ffi::stop_counting_tensor_bytes())
}
