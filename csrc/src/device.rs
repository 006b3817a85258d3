//! What a GPU does beside its work. Tensors cross the border as addresses of `at::Tensor`, which is what tch's `C_tensor` is. A GPU is
//! CUDA's, by its number.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("device.h");

        /// See `csrc/device.h`.
        type Mark;

        /// See `csrc/device.h`.
        fn mark(gpu: i32) -> Result<UniquePtr<Mark>>;

        /// See `csrc/device.h`.
        fn since(self: &Mark, earlier: &Mark) -> Result<f64>;

        /// See `csrc/device.h`.
        type Copies;

        /// See `csrc/device.h`.
        fn hand_over(self: &Copies, out: &mut [usize]) -> Result<()>;

        /// See `csrc/device.h`.
        type CopyStream;

        /// See `csrc/device.h`.
        fn copy_stream(gpu: i32) -> Result<UniquePtr<CopyStream>>;

        /// See `csrc/device.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn copy(self: &CopyStream, tensors: &[usize]) -> Result<UniquePtr<Copies>>;

        /// See `csrc/device.h`.
        fn page_locked_bytes(shape: &[i64], out: &mut [usize]) -> Result<()>;

        /// See `csrc/device.h`.
        fn peak_bytes(gpu: i32) -> Result<u64>;

        /// See `csrc/device.h`.
        fn forget_peak_bytes(gpu: i32) -> Result<()>;

        /// See `csrc/device.h`.
        fn leave_out_tf32();
    }
}

// SAFETY: libtorch's streams and events belong to no thread.
unsafe impl Send for Mark {}
// SAFETY: as above, and tensors go from thread to thread.
unsafe impl Send for Copies {}
// SAFETY: as above.
unsafe impl Send for CopyStream {}
