//! Measurement of the memory that tensors take.

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("tensor_memory.h");

        /// Begins counting the bytes of tensors; see `csrc/tensor_memory.h`.
        fn start_counting_tensor_bytes();

        /// Ends counting and returns the peak; see `csrc/tensor_memory.h`.
        fn stop_counting_tensor_bytes() -> u64;
    }
}

/// Runs `work` and returns its result and the peak of the bytes that its tensors took on this thread, on the CPU.
pub fn peak_tensor_bytes<T>(work: impl FnOnce() -> T) -> (T, u64) {
    ffi::start_counting_tensor_bytes();
    let done = work();
    (done, ffi::stop_counting_tensor_bytes())
}
