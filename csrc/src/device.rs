//! GPU events, copies to a GPU, and memory statistics. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`. A GPU is
//! given by its CUDA device index.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("device.h");

        /// Event in a GPU's stream; see `csrc/device.h`.
        type CudaEvent;

        /// Records an event in a GPU's current stream; see `csrc/device.h`.
        fn record_event(gpu: i32) -> Result<UniquePtr<CudaEvent>>;

        /// Returns the milliseconds between two events; see `csrc/device.h`.
        fn milliseconds_since(self: &CudaEvent, earlier: &CudaEvent) -> Result<f64>;

        /// Copies on a GPU that may still be in progress; see `csrc/device.h`.
        type PendingCopies;

        /// Returns the copied tensors; see `csrc/device.h`.
        fn take_tensors(self: &PendingCopies, out: &mut [usize]) -> Result<()>;

        /// Stream for copies to a GPU; see `csrc/device.h`.
        type CopyStream;

        /// Creates a stream for copies; see `csrc/device.h`.
        fn copy_stream(gpu: i32) -> Result<UniquePtr<CopyStream>>;

        /// Starts copying tensors to the GPU; see `csrc/device.h`.
        ///
        /// # Safety
        /// `tensors` must be addresses of live tensors.
        unsafe fn copy(self: &CopyStream, tensors: &[usize]) -> Result<UniquePtr<PendingCopies>>;

        /// Allocates a tensor in page-locked memory; see `csrc/device.h`.
        fn empty_pinned_bytes(shape: &[i64], out: &mut [usize]) -> Result<()>;

        /// Returns the peak of a GPU's tensor memory in bytes; see `csrc/device.h`.
        fn max_memory_allocated(gpu: i32) -> Result<u64>;

        /// Resets the peak of a GPU's tensor memory; see `csrc/device.h`.
        fn reset_peak_memory_stats(gpu: i32) -> Result<()>;

        /// Disables TF32 in convolutions; see `csrc/device.h`.
        fn disable_tf32();
    }
}

// SAFETY: libtorch's streams and events are not bound to a thread.
unsafe impl Send for CudaEvent {}
// SAFETY: as above, and tensors may be sent between threads.
unsafe impl Send for PendingCopies {}
// SAFETY: as above.
unsafe impl Send for CopyStream {}
