//! How much memory tensors take.

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("tensor_memory.h");

        /// See `csrc/tensor_memory.h`.
        fn count_tensor_bytes();

        /// See `csrc/tensor_memory.h`.
        fn most_tensor_bytes() -> u64;
    }
}

/// What `work` gives, and the bytes that tensors which it made on this thread, on the CPU, took at the most at a time.
pub fn tensor_bytes_of<T>(work: impl FnOnce() -> T) -> (T, u64) {
    ffi::count_tensor_bytes();
    let done = work();
    (done, ffi::most_tensor_bytes())
}
