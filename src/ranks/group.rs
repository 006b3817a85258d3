//! Collectives of all ranks, by c10d. Every rank calls them in the same order.

use super::dist_env::DistributedEnv;
use crate::error::{Error, Result};
use crate::ffi::take_outputs;
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use tch::{Device, Tensor};

/// Timeout of a collective, in seconds: 20 days, in practice as long as the processes live. [`super::Watchdog`] notices a rank that is
/// gone. The collective waits for a rank that has more to do, writes to a slow disk, or waits for free space on a full one. The timeout in
/// milliseconds fits into 32 bits.
pub(super) const COLLECTIVE_TIMEOUT_SECONDS: i64 = 20 * 24 * 60 * 60;

/// Process group of all ranks, as seen by one of them.
pub struct ProcessGroup {
    /// C++ implementation, or `None` if the group has only one rank.
    inner: Option<UniquePtr<ffi::ProcessGroup>>,
    rank: usize,
    ranks: usize,
    local_world_size: usize,
    /// Device that collectives run on.
    device: Device,
}

impl fmt::Debug for ProcessGroup {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "ProcessGroup(rank {} of {} on {:?})", self.rank, self.ranks, self.device)
    }
}

/// Returns the error for a failed collective. The cause is almost always that another rank is gone.
pub(super) fn distributed_error(why: cxx::Exception) -> Error {
    Error::Distributed { message: why.what().lines().next().unwrap_or_default().to_string() }
}

/// Backends that this build has for communication between ranks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Backends {
    /// Gloo, for CPUs.
    pub gloo: bool,
    /// NCCL, for GPUs.
    pub nccl: bool,
}

impl Backends {
    /// Returns the backends whose headers were available when the program was built.
    pub fn built_in() -> Self {
        Backends { gloo: ffi::has_gloo(), nccl: ffi::has_nccl() }
    }
}

impl ProcessGroup {
    /// Returns the group of a process that runs alone.
    pub fn single() -> Self {
        ProcessGroup { inner: None, rank: 0, ranks: 1, local_world_size: 1, device: Device::Cpu }
    }

    /// Joins the group of all ranks at `store`, for collectives on `device`: by Gloo on CPUs, by NCCL on GPUs.
    ///
    /// # Errors
    /// Returns an error if the build lacks this backend, or if other ranks don't join.
    pub fn join(dist_env: &DistributedEnv, store: &ffi::Store, device: Device) -> Result<Self> {
        ProcessGroup::join_with_timeout(dist_env, store, device, COLLECTIVE_TIMEOUT_SECONDS)
    }

    /// Joins a group like [`ProcessGroup::join`], with a timeout of `seconds` for collectives.
    pub(super) fn join_with_timeout(
        dist_env: &DistributedEnv,
        store: &ffi::Store,
        device: Device,
        seconds: i64,
    ) -> Result<Self> {
        let without = |what: &str, install: &str| {
            Error::request(format!(
                "this program was built without {what}, which {} processes need: {install}, then `touch csrc/build.rs` and build \
                 again",
                dist_env.ranks
            ))
        };
        let (rank, ranks) = (dist_env.rank as i32, dist_env.ranks as i32);
        let Backends { gloo, nccl } = Backends::built_in();
        let inner = match device {
            Device::Cuda(_) if !nccl => {
                let install = "install what requirements.txt pins beside libtorch's wheel";
                return Err(without("NCCL", install));
            }
            Device::Cuda(_) => ffi::new_nccl_group(store, rank, ranks, seconds),
            _ if !gloo => {
                return Err(without(
                    "Gloo",
                    "install its headers (Debian and Ubuntu: apt install libgloo-dev)",
                ));
            }
            _ => ffi::new_gloo_group(store, rank, ranks, seconds),
        };
        let inner = Some(inner.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            Error::failed(format!("rank {rank} of {ranks} can't join the process group: {why}"))
        })?);
        Ok(ProcessGroup {
            inner,
            rank: dist_env.rank,
            ranks: dist_env.ranks,
            local_world_size: dist_env.local_world_size,
            device,
        })
    }

    /// Returns the number of this rank, from 0.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// Returns the number of ranks.
    pub fn world_size(&self) -> usize {
        self.ranks
    }

    /// Returns the number of ranks on this machine.
    pub fn local_world_size(&self) -> usize {
        self.local_world_size
    }

    /// Returns `true` if this is the first rank, which writes files and prints messages.
    pub fn is_main_process(&self) -> bool {
        self.rank == 0
    }

    pub(super) fn inner(&self) -> Option<&ffi::ProcessGroup> {
        self.inner.as_deref()
    }

    /// Shuts the group down after the last collective, if there was no error. All ranks call this.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn leave(&self) -> Result<()> {
        self.inner.as_ref().map_or(Ok(()), |inner| inner.shut_down().map_err(distributed_error))
    }

    /// Replaces `tensor` by its sum over all ranks, in place (an all-reduce). It has the same shape and kind on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn all_reduce(&self, tensor: &Tensor) -> Result<()> {
        match &self.inner {
            // SAFETY: the tensor is alive, and the caller doesn't use it during the call.
            Some(inner) => unsafe { inner.all_reduce(tensor.as_ptr() as usize) }.map_err(distributed_error),
            None => Ok(()),
        }
    }

    /// Replaces `tensor` by that of rank `from`, in place (a broadcast). It has the same shape and kind on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn broadcast(&self, from: usize, tensor: &Tensor) -> Result<()> {
        match &self.inner {
            // SAFETY: the tensor is alive, and the caller doesn't use it during the call.
            Some(inner) => {
                unsafe { inner.broadcast(tensor.as_ptr() as usize, from as i32) }.map_err(distributed_error)
            }
            None => Ok(()),
        }
    }

    /// Returns the values that all ranks pass, in the order of the ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn all_gather_object<T: Serialize + DeserializeOwned>(&self, value: T) -> Result<Vec<T>> {
        if self.inner.is_none() {
            return Ok(vec![value]);
        }
        let bytes = rmp_serde::to_vec_named(&value).expect("a serializable value");
        let lengths = self.all_gather(&Tensor::from_slice(&[bytes.len() as i64]))?;
        let lengths = Vec::<i64>::try_from(lengths.view(-1)).expect("whole numbers");
        let longest = *lengths.iter().max().expect("a rank") as usize;
        let padded = [bytes.as_slice(), &vec![0; longest - bytes.len()]].concat();
        let all =
            Vec::<u8>::try_from(self.all_gather(&Tensor::from_slice(&padded))?.view(-1)).expect("bytes");
        let value = lengths.iter().enumerate().map(|(rank, &length)| {
            let bytes = &all[rank * longest..][..length as usize];
            rmp_serde::from_slice(bytes)
                .map_err(Error::failed_with_context(format_args!("can't decode the value of rank {rank}")))
        });
        value.collect()
    }

    /// Returns the value that the first rank passes. The other ranks pass `None`.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn broadcast_object<T: Serialize + DeserializeOwned>(&self, value: Option<T>) -> Result<T> {
        // The value itself may be `None`, so every rank sends a list, which is empty on ranks that send no value.
        let value = self.all_gather_object(Vec::from_iter(value))?.into_iter().flatten().next();
        value.ok_or_else(|| Error::failed("rank 0 sent no value"))
    }

    /// Returns the tensors of all ranks, stacked along a new first dimension, on the CPU.
    fn all_gather(&self, tensor: &Tensor) -> Result<Tensor> {
        let inner = self.inner.as_deref().expect("other ranks");
        let tensor = tensor.to_device(self.device);
        // SAFETY: the tensor is alive, and on success the C++ side has stored a new tensor at `out`.
        let [all] = unsafe { take_outputs(|out| inner.all_gather(tensor.as_ptr() as usize, out)) }
            .map_err(distributed_error)?;
        Ok(all.to_device(Device::Cpu))
    }
}
