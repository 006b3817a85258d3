//! Gradients that are added up over all ranks while the backward pass still goes on.

use super::group::Group;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use std::fmt;
use tch::Tensor;

/// Of a bucket at the most: as much as torch's DistributedDataParallel takes at a time.
const MOST_BYTES: i64 = 25 << 20;
/// At the least: less takes longer to begin than to send.
const LEAST_BYTES: i64 = 1 << 20;
/// Buckets of a small network, so that all but the last can leave while the backward pass goes on.
const FEW: i64 = 8;

/// The buckets of a network's parameters.
pub struct Buckets {
    /// None for a rank that is alone.
    inner: Option<UniquePtr<ffi::Buckets>>,
}

impl fmt::Debug for Buckets {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Buckets")
    }
}

impl Buckets {
    /// Of `parameters`, leaves of one kind on one device, in the order in which the backward pass gives their gradients, about.
    /// The order is the same on all ranks.
    ///
    /// # Panics
    /// Parameters that aren't alike, or no leaves.
    pub fn new(group: &Group, parameters: &[Tensor]) -> Self {
        let bytes: usize = parameters.iter().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum();
        Buckets::of_bytes(group, parameters, (bytes as i64 / FEW).clamp(LEAST_BYTES, MOST_BYTES))
    }

    pub(super) fn of_bytes(group: &Group, parameters: &[Tensor], bytes: i64) -> Self {
        let addresses: Vec<usize> = parameters.iter().map(|t| t.as_ptr() as usize).collect();
        // SAFETY: the tensors outlive the call; the C++ side keeps what they refer to.
        let inner = group.inner().map(|group| unsafe { ffi::buckets(group, &addresses, bytes) });
        Buckets { inner: inner.transpose().expect("leaves of one kind") }
    }

    /// What the backward pass gives from now on is the last of this step: each parameter's gradient comes once, or not at all.
    pub fn begin(&self) {
        if let Some(inner) = &self.inner {
            inner.begin();
        }
    }

    /// Waits until the gradients are the sums over all ranks. Returns how many there are; it must be the same everywhere.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn finish(&self) -> Result<usize> {
        let Some(inner) = &self.inner else { return Ok(0) };
        inner.finish().map_err(|e| Error::Ranks(e.what().lines().next().unwrap_or_default().to_string()))
    }
}
