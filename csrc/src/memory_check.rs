//! Checks of available memory before calls into libraries that don't handle failed allocations.

pub use ffi::*;

#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("memory_check.h");

        /// Returns an error unless there is memory for generated code; see `csrc/memory_check.h`.
        fn ensure_memory_for_code(bytes: i64) -> Result<()>;
    }
}
