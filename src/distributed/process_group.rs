//! Collectives of all ranks, by c10d. Every rank calls them in the same order.

use super::env::Rendezvous;
use crate::error::{Error, Result};
use cxx::UniquePtr;
use globalsplat_csrc::distributed as ffi;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use tch::{Device, Tensor, no_grad};

/// Timeout of a collective, in seconds. It also covers waiting for a rank that has more scenes to evaluate, so it is longer than c10d's
/// default of half an hour.
const COLLECTIVE_TIMEOUT_SECONDS: i64 = 2 * 60 * 60;
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

/// Failed communication with the other processes, almost always because one of them has ended.
#[derive(Debug, thiserror::Error)]
#[error("distributed communication failed ({0}); restart the processes to resume from the last checkpoint")]
struct CommunicationError(String);

fn distributed_error(why: cxx::Exception) -> Error {
    Error::external(CommunicationError(why.what().lines().next().unwrap_or_default().to_string()))
}

/// Returns `true` if `error` is that of a failed communication with the other processes.
pub fn is_communication_error(error: &Error) -> bool {
    matches!(error, Error::Failed { source: Some(source), .. } if source.is::<CommunicationError>())
}

impl ProcessGroup {
    /// Returns the group of a process that runs alone.
    pub fn single() -> Self {
        ProcessGroup { inner: None, rank: 0, ranks: 1, local_world_size: 1, device: Device::Cpu }
    }

    /// Joins the group of all ranks that meet at `rendezvous`, for collectives on `device`: by Gloo on CPUs, by NCCL on GPUs.
    ///
    /// # Errors
    /// Returns an error if the build lacks this backend, or if other ranks don't join.
    pub fn join(rendezvous: &Rendezvous, device: Device) -> Result<Self> {
        let Rendezvous { store, env } = rendezvous;
        let without = |what: &str, install: &str| {
            Error::request(format!(
                "this program was built without {what}, which {} processes need: {install}, then `touch csrc/build.rs` and build \
                 again",
                env.ranks
            ))
        };
        let (rank, ranks) = (env.rank as i32, env.ranks as i32);
        let is_on_gpus = device.is_cuda();
        if is_on_gpus && !ffi::has_nccl() {
            return Err(without("NCCL", "install what requirements.txt pins beside libtorch's wheel"));
        } else if !is_on_gpus && !ffi::has_gloo() {
            return Err(without("Gloo", "install its headers (Debian and Ubuntu: apt install libgloo-dev)"));
        }
        let inner = ffi::new_group(is_on_gpus, store, rank, ranks, COLLECTIVE_TIMEOUT_SECONDS);
        let inner = Some(inner.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            Error::failed(format!("rank {rank} of {ranks} can't join the process group: {why}"))
        })?);
        Ok(ProcessGroup {
            inner,
            rank: env.rank,
            ranks: env.ranks,
            local_world_size: env.local_world_size,
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

    /// Calls a function of the C++ implementation, if there are several ranks.
    fn call(&self, function: impl FnOnce(&ffi::ProcessGroup) -> Result<(), cxx::Exception>) -> Result<()> {
        self.inner.as_ref().map_or(Ok(()), |inner| function(inner).map_err(distributed_error))
    }

    /// Shuts the group down after the last collective, if there was no error. All ranks call this.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn shutdown(&self) -> Result<()> {
        self.call(ffi::ProcessGroup::shutdown)
    }

    /// Replaces `tensor` by its sum over all ranks, in place (an all-reduce). It has the same shape and kind on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn all_reduce(&self, tensor: &Tensor) -> Result<()> {
        // SAFETY: the tensor is alive, and the caller doesn't use it during the call.
        self.call(|group| unsafe { group.all_reduce(tensor.as_ptr() as usize) })
    }

    /// Replaces the gradients of `parameters` by their sums over all ranks, in one message. A gradient that a rank lacks counts as 0. Returns
    /// the number of gradients of this rank, which must be the same on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn all_reduce_gradients(&self, parameters: &[Tensor]) -> Result<usize> {
        let gradients: Vec<Tensor> = parameters.iter().map(Tensor::grad).collect();
        let count = gradients.iter().filter(|gradient| gradient.defined()).count();
        if self.inner.is_none() {
            return Ok(count);
        }
        no_grad(|| {
            let flat =
                gradients.iter().zip(parameters).map(|(gradient, parameter)| match gradient.defined() {
                    true => gradient.reshape([-1]),
                    false => parameter.zeros_like().reshape([-1]),
                });
            let flat = Tensor::cat(&flat.collect::<Vec<_>>(), 0);
            self.all_reduce(&flat)?;
            let sizes: Vec<i64> = parameters.iter().map(|parameter| parameter.numel() as i64).collect();
            for (mut gradient, sum) in gradients.into_iter().zip(flat.split_with_sizes(sizes, 0)) {
                if gradient.defined() {
                    gradient.copy_(&sum.view_as(&gradient));
                }
            }
            Ok(count)
        })
    }

    /// Replaces `tensor` by that of the first rank, in place. It has the same shape and kind on all ranks.
    ///
    /// # Errors
    /// Returns an error if another rank is gone.
    pub fn broadcast(&self, tensor: &Tensor) -> Result<()> {
        // SAFETY: the tensor is alive, and the caller doesn't use it during the call.
        self.call(|group| unsafe { group.broadcast(tensor.as_ptr() as usize) })
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
        let lengths = Vec::<i64>::try_from(lengths.view(-1)).expect("an int64 for each rank");
        let longest = *lengths.iter().max().expect("a rank") as usize;
        let padded = [bytes.as_slice(), &vec![0; longest - bytes.len()]].concat();
        let all = self.all_gather(&Tensor::from_slice(&padded))?;
        let all = Vec::<u8>::try_from(all.view(-1)).expect("a row of bytes for each rank");
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

    /// Returns the whole numbers `[N]` of all ranks, stacked along a new first dimension, on the CPU: the sum of tensors that are 0 except in
    /// a rank's own row.
    fn all_gather(&self, numbers: &Tensor) -> Result<Tensor> {
        let rows = Tensor::zeros([self.ranks as i64, numbers.numel() as i64], (numbers.kind(), self.device));
        rows.get(self.rank as i64).copy_(numbers);
        self.all_reduce(&rows)?;
        Ok(rows.to_device(Device::Cpu))
    }
}
