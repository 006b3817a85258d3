//! Communication among processes that train together. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.
//!
//! # Safety
//! Every unsafe function requires that all addresses are those of live tensors that nothing else reads or writes meanwhile.

pub use ffi::*;

// The safety section of the module holds for all functions.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("distributed.h");

        /// Key-value store that all processes share; see `csrc/distributed.h`.
        type Store;

        /// Connects to the store, or starts it; see `csrc/distributed.h`.
        fn connect(
            host: &str,
            port: u16,
            is_server: bool,
            prefix: &str,
            seconds: i64,
        ) -> Result<UniquePtr<Store>>;

        /// Adds to a number in the store and returns the sum; see `csrc/distributed.h`.
        fn add(self: &Store, key: &str, amount: i64) -> Result<i64>;

        /// Returns `true` if this build supports collectives on CPUs (Gloo).
        fn has_gloo() -> bool;

        /// Returns `true` if this build supports collectives on GPUs (NCCL).
        fn has_nccl() -> bool;

        /// Process group; see `csrc/distributed.h`.
        type ProcessGroup;

        /// Creates a process group for tensors on GPUs (NCCL) or on CPUs (Gloo); see `csrc/distributed.h`.
        fn new_group(
            is_on_gpus: bool,
            store: &Store,
            rank: i32,
            ranks: i32,
            seconds: i64,
        ) -> Result<UniquePtr<ProcessGroup>>;

        /// Replaces a tensor by its sum over all ranks; see `csrc/distributed.h`.
        unsafe fn all_reduce(self: &ProcessGroup, tensor: usize) -> Result<()>;

        /// Copies a tensor of the first rank to all ranks; see `csrc/distributed.h`.
        unsafe fn broadcast(self: &ProcessGroup, tensor: usize) -> Result<()>;

        /// Shuts the process group down in order; see `csrc/distributed.h`.
        fn shutdown(self: &ProcessGroup) -> Result<()>;
    }
}

// SAFETY: c10d's stores may be called from any thread.
unsafe impl Send for Store {}
// SAFETY: as above; concurrent calls are serialized.
unsafe impl Sync for Store {}
// SAFETY: c10d's process groups are not bound to a thread.
unsafe impl Send for ProcessGroup {}
