//! Processes that train together. Tensors cross the border as addresses of `at::Tensor`, which is what tch's `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("ranks.h");

        /// See `csrc/ranks.h`.
        type Store;

        /// See `csrc/ranks.h`.
        fn connect(
            host: &str,
            port: u16,
            serves: bool,
            prefix: &str,
            seconds: i64,
        ) -> Result<UniquePtr<Store>>;

        /// See `csrc/ranks.h`.
        fn another(self: &Store) -> Result<UniquePtr<Store>>;

        /// See `csrc/ranks.h`.
        fn add(self: &Store, key: &str, amount: i64) -> Result<i64>;

        /// See `csrc/ranks.h`.
        fn has_gloo() -> bool;

        /// See `csrc/ranks.h`.
        fn has_nccl() -> bool;

        /// See `csrc/ranks.h`.
        type Group;

        /// See `csrc/ranks.h`.
        fn gloo(store: &Store, rank: i32, ranks: i32, seconds: i64) -> Result<UniquePtr<Group>>;

        /// See `csrc/ranks.h`.
        fn nccl(store: &Store, rank: i32, ranks: i32, seconds: i64) -> Result<UniquePtr<Group>>;

        /// See `csrc/ranks.h`.
        ///
        /// # Safety
        /// The address of a live tensor that nothing else reads or writes meanwhile.
        unsafe fn all_reduce(self: &Group, tensor: usize) -> Result<()>;

        /// See `csrc/ranks.h`.
        ///
        /// # Safety
        /// The address of a live tensor that nothing else reads or writes meanwhile.
        unsafe fn broadcast(self: &Group, tensor: usize, from: i32) -> Result<()>;

        /// See `csrc/ranks.h`.
        ///
        /// # Safety
        /// The address of a live tensor.
        unsafe fn all_gather(self: &Group, tensor: usize, out: &mut [usize]) -> Result<()>;

        /// See `csrc/ranks.h`.
        fn shut_down(self: &Group) -> Result<()>;

        /// See `csrc/ranks.h`.
        type Buckets;

        /// See `csrc/ranks.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn buckets(group: &Group, parameters: &[usize], bytes: i64) -> Result<UniquePtr<Buckets>>;

        /// See `csrc/ranks.h`.
        fn begin(self: &Buckets);

        /// See `csrc/ranks.h`.
        fn finish(self: &Buckets) -> Result<usize>;
    }
}

// SAFETY: c10d's stores take calls from any thread.
unsafe impl Send for Store {}
// SAFETY: as above, one call after the other.
unsafe impl Sync for Store {}
// SAFETY: c10d's groups belong to no thread.
unsafe impl Send for Group {}
// SAFETY: what they share is parameters, which go from thread to thread.
unsafe impl Send for Buckets {}
