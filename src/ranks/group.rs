//! What all ranks do together: c10d's collectives, in the same order on each of them.

use super::place::Place;
use crate::error::{Error, Result};
use crate::render::handed_over;
use cxx::UniquePtr;
use globalsplat_csrc::ranks as ffi;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use tch::{Device, Tensor};

/// How long a collective waits for the other ranks: 20 days, practically as long as they live. One that is gone is noticed by
/// [`super::Watch`]; one that has more to do, writes to a slow disk or waits for room on a full one is waited for. In milliseconds it
/// fits 32 bits.
pub(super) const PATIENCE_SECONDS: i64 = 20 * 24 * 60 * 60;

/// All ranks, as one of them knows them.
pub struct Group {
    /// None for a rank that is alone.
    inner: Option<UniquePtr<ffi::Group>>,
    rank: usize,
    ranks: usize,
    local_ranks: usize,
    /// Where collectives work.
    device: Device,
}

impl fmt::Debug for Group {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "Group({} of {} on {:?})", self.rank, self.ranks, self.device)
    }
}

/// What a collective failed with: almost always another rank, which is gone.
fn lost(why: cxx::Exception) -> Error {
    Error::Ranks(why.what().lines().next().unwrap_or_default().to_string())
}

/// By what ranks can work together in this build.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Backends {
    /// On CPUs.
    pub gloo: bool,
    /// On GPUs.
    pub nccl: bool,
}

impl Backends {
    /// Those whose headers were there when the program was built.
    pub fn built_in() -> Self {
        Backends { gloo: ffi::has_gloo(), nccl: ffi::has_nccl() }
    }
}

impl Group {
    /// Of a process that has no others.
    pub fn alone() -> Self {
        Group { inner: None, rank: 0, ranks: 1, local_ranks: 1, device: Device::Cpu }
    }

    /// Meets the others at `store`, to work on `device`: by Gloo on CPUs, by NCCL on GPUs.
    ///
    /// # Errors
    /// A build without that, or others that don't come.
    pub fn join(place: &Place, store: &ffi::Store, device: Device) -> Result<Self> {
        Group::join_with_timeout(place, store, device, PATIENCE_SECONDS)
    }

    /// As [`Group::join`]; collectives wait `seconds` for the others.
    pub(super) fn join_with_timeout(
        place: &Place,
        store: &ffi::Store,
        device: Device,
        seconds: i64,
    ) -> Result<Self> {
        let without = |what: &str, install: &str| {
            Error::Request(format!(
                "this program was built without {what}, which {} processes need: {install}, then `touch csrc/build.rs` and build \
                 again",
                place.ranks
            ))
        };
        let (rank, ranks) = (place.rank as i32, place.ranks as i32);
        let Backends { gloo, nccl } = Backends::built_in();
        let inner = match device {
            Device::Cuda(_) if !nccl => {
                let install = "install what requirements.txt pins beside libtorch's wheel";
                return Err(without("NCCL", install));
            }
            Device::Cuda(_) => ffi::nccl(store, rank, ranks, seconds),
            _ if !gloo => {
                return Err(without(
                    "Gloo",
                    "install its headers (Debian and Ubuntu: apt install libgloo-dev)",
                ));
            }
            _ => ffi::gloo(store, rank, ranks, seconds),
        };
        let inner = Some(inner.map_err(|e| {
            let why = e.what().lines().next().unwrap_or_default().to_string();
            Error::Failed(format!("rank {rank} of {ranks} can't meet the others: {why}"))
        })?);
        Ok(Group { inner, rank: place.rank, ranks: place.ranks, local_ranks: place.local_ranks, device })
    }

    /// From 0.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// How many there are.
    pub fn ranks(&self) -> usize {
        self.ranks
    }

    /// How many there are on this machine.
    pub fn local_ranks(&self) -> usize {
        self.local_ranks
    }

    /// Whether this is the rank that writes and speaks.
    pub fn is_first(&self) -> bool {
        self.rank == 0
    }

    pub(super) fn inner(&self) -> Option<&ffi::Group> {
        self.inner.as_deref()
    }

    /// After all that ranks do together, where all went well.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn leave(&self) -> Result<()> {
        self.inner.as_ref().map_or(Ok(()), |inner| inner.shut_down().map_err(lost))
    }

    /// Puts the sum over all ranks in place of `tensor`, which has the same shape and kind everywhere.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn sum(&self, tensor: &Tensor) -> Result<()> {
        match &self.inner {
            // SAFETY: the tensor lives, and its holder waits.
            Some(inner) => unsafe { inner.all_reduce(tensor.as_ptr() as usize) }.map_err(lost),
            None => Ok(()),
        }
    }

    /// Puts what rank `from` has in place of `tensor`, which has the same shape and kind everywhere.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn copy_from(&self, from: usize, tensor: &Tensor) -> Result<()> {
        match &self.inner {
            // SAFETY: the tensor lives, and its holder waits.
            Some(inner) => unsafe { inner.broadcast(tensor.as_ptr() as usize, from as i32) }.map_err(lost),
            None => Ok(()),
        }
    }

    /// What every rank says, in their order.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn gather<T: Serialize + DeserializeOwned>(&self, said: T) -> Result<Vec<T>> {
        if self.inner.is_none() {
            return Ok(vec![said]);
        }
        let bytes = rmp_serde::to_vec_named(&said).expect("what is said can be written down");
        let lengths = self.all_gather(&Tensor::from_slice(&[bytes.len() as i64]))?;
        let lengths = Vec::<i64>::try_from(lengths.view(-1)).expect("whole numbers");
        let longest = *lengths.iter().max().expect("a rank") as usize;
        let padded = [bytes.as_slice(), &vec![0; longest - bytes.len()]].concat();
        let all =
            Vec::<u8>::try_from(self.all_gather(&Tensor::from_slice(&padded))?.view(-1)).expect("bytes");
        let said = lengths.iter().enumerate().map(|(rank, &length)| {
            let bytes = &all[rank * longest..][..length as usize];
            rmp_serde::from_slice(bytes)
                .map_err(|e| Error::Failed(format!("rank {rank} isn't understood: {e}")))
        });
        said.collect()
    }

    /// What the first rank says; the others have nothing to say.
    ///
    /// # Errors
    /// Another rank that is gone.
    pub fn from_first<T: Serialize + DeserializeOwned>(&self, said: Option<T>) -> Result<T> {
        // A list, as what is said may itself be nothing.
        let said = self.gather(Vec::from_iter(said))?.into_iter().flatten().next();
        said.ok_or_else(|| Error::Failed("the first rank said nothing".into()))
    }

    /// What every rank has, along a new first dimension, on the CPU.
    fn all_gather(&self, tensor: &Tensor) -> Result<Tensor> {
        let inner = self.inner.as_deref().expect("other ranks");
        let tensor = tensor.to_device(self.device);
        // SAFETY: the tensor lives, and on success the C++ side has put a new one there.
        let [all] =
            unsafe { handed_over(|out| inner.all_gather(tensor.as_ptr() as usize, out)) }.map_err(lost)?;
        Ok(all.to_device(Device::Cpu))
    }
}
