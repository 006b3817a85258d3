//! Gradient buckets, which are summed over all ranks while the backward pass is still running.

use super::group::{ProcessGroup, distributed_error};
use crate::error::Result;
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::fmt;
use tch::Tensor;

/// Maximum size of a bucket, in bytes: the bucket size of torch's DistributedDataParallel.
const MAX_BUCKET_BYTES: i64 = 25 << 20;
/// Minimum size of a bucket, in bytes. Smaller buckets take longer to start than to send.
const MIN_BUCKET_BYTES: i64 = 1 << 20;
/// Number of buckets of a small network, so that all but the last can be sent while the backward pass is running.
const MIN_BUCKETS: i64 = 8;

/// Buckets of a network's parameters.
pub struct Buckets {
    /// C++ implementation, or `None` if the group has only one rank.
    inner: Option<UniquePtr<ffi::Buckets>>,
}

impl fmt::Debug for Buckets {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Buckets")
    }
}

impl Buckets {
    /// Creates the buckets of `parameters`, leaf tensors of one kind on one device. They are approximately in the order in which the
    /// backward pass computes their gradients; the order must be the same on all ranks.
    ///
    /// # Panics
    /// Panics if the parameters differ in kind or device, or aren't leaves that require gradients.
    pub fn new(group: &ProcessGroup, parameters: &[Tensor]) -> Self {
        let bytes: usize = parameters.iter().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum();
        Buckets::with_bucket_bytes(
            group,
            parameters,
            (bytes as i64 / MIN_BUCKETS).clamp(MIN_BUCKET_BYTES, MAX_BUCKET_BYTES),
        )
    }

    pub(super) fn with_bucket_bytes(group: &ProcessGroup, parameters: &[Tensor], bytes: i64) -> Self {
        let addresses: Vec<usize> = parameters.iter().map(|t| t.as_ptr() as usize).collect();
        // SAFETY: the tensors outlive the call; the C++ side holds references of its own to what it keeps.
        let inner = group.inner().map(|group| unsafe { ffi::buckets(group, &addresses, bytes) });
        Buckets { inner: inner.transpose().expect("leaves of one kind") }
    }

    /// Marks the start of the last backward pass of a step. From now on it computes each parameter's gradient once, or not at all.
    pub fn begin(&self) {
        if let Some(inner) = &self.inner {
            inner.begin();
        }
    }

    /// Waits until the gradients are the sums over all ranks. Returns the number of gradients, which must be the same on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn finish(&self) -> Result<usize> {
        let Some(inner) = &self.inner else { return Ok(0) };
        inner.finish().map_err(distributed_error)
    }
}
