//! Devices: asynchronous copies from the host to a GPU on a stream of their own, events that time the GPU's work, and memory use. On the
//! CPU the same calls run synchronously.

mod memory;
mod stopwatch;

pub(crate) use memory::{
    peak_device_memory_bytes, peak_memory_bytes_on, reset_peak_memory, resident_memory_bytes,
};
pub use memory::{peak_memory_bytes, total_memory_bytes};
pub use stopwatch::{Stopwatch, process_age};

use crate::error::Result;
use crate::ffi::take_outputs;
use cxx::UniquePtr;
use globalsplat_csrc::device as ffi;
use std::fmt;
use std::time::{Duration, Instant};
use tch::{Device, Kind, Tensor};

pub(crate) use ffi::disable_tf32;

/// Returns the CUDA device index, or `None` for a device that isn't a CUDA device.
fn gpu(device: Device) -> Option<i32> {
    match device {
        Device::Cuda(number) => Some(number as i32),
        _ => None,
    }
}

/// Event for timing the work of a device: on a GPU, it is reached when all work queued before it is done.
pub(crate) enum DeviceEvent {
    Host(Instant),
    Gpu(UniquePtr<ffi::CudaEvent>),
}

impl DeviceEvent {
    /// Records an event now, without waiting for the GPU.
    ///
    /// # Errors
    /// Returns an error if the GPU is missing or fails.
    pub fn now(device: Device) -> Result<Self> {
        Ok(match gpu(device) {
            Some(gpu) => DeviceEvent::Gpu(ffi::record_event(gpu)?),
            None => DeviceEvent::Host(Instant::now()),
        })
    }

    /// Returns the time elapsed since `earlier`, an event of the same device. Waits until the GPU has reached both events.
    ///
    /// # Errors
    /// Returns an error if the GPU's work has failed.
    ///
    /// # Panics
    /// Panics if the events are of different devices.
    pub fn since(&self, earlier: &DeviceEvent) -> Result<Duration> {
        Ok(match (self, earlier) {
            (DeviceEvent::Gpu(event), DeviceEvent::Gpu(earlier)) => {
                Duration::from_secs_f64(1e-3 * event.milliseconds_since(earlier)?.max(0.))
            }
            (DeviceEvent::Host(instant), DeviceEvent::Host(earlier)) => *instant - *earlier,
            _ => panic!("events of two devices"),
        })
    }
}

impl fmt::Debug for DeviceEvent {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("DeviceEvent")
    }
}

/// Copies tensors from the host to a device; copies to a GPU overlap with its work.
pub(crate) struct Upload {
    device: Device,
    stream: Option<UniquePtr<ffi::CopyStream>>,
}

impl Upload {
    /// Creates an upload to `device`, to be reused for all copies to it.
    ///
    /// # Errors
    /// Returns an error if the GPU is missing or fails.
    pub fn new(device: Device) -> Result<Self> {
        let stream = gpu(device).map(ffi::copy_stream).transpose()?;
        Ok(Upload { device, stream })
    }

    /// Returns the destination device.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Returns uninitialized bytes on the host, in page-locked memory if the device is a GPU, so that they are copied without
    /// an intermediate buffer.
    ///
    /// # Errors
    /// Returns an error if the system has no page-locked memory left.
    pub fn bytes(&self, shape: &[i64]) -> Result<Tensor> {
        if self.stream.is_none() {
            return Ok(Tensor::empty(shape, (Kind::Uint8, Device::Cpu)));
        }
        // SAFETY: on success the C++ side has stored a new tensor in `out`.
        let [bytes] = unsafe { take_outputs(|out| ffi::empty_pinned_bytes(shape, out)) }?;
        Ok(bytes)
    }

    /// Starts copying `tensors` from the host; the caller may drop them immediately.
    ///
    /// # Errors
    /// Returns an error if the GPU fails, or if memory runs out there or on the host.
    pub fn begin<const N: usize>(&self, tensors: [&Tensor; N]) -> Result<PendingCopy<N>> {
        Ok(match &self.stream {
            Some(stream) => {
                let addresses = tensors.map(|t| t.as_ptr() as usize);
                // SAFETY: the tensors outlive the call.
                PendingCopy::Gpu(unsafe { stream.copy(&addresses) }?)
            }
            None => PendingCopy::Done(tensors.map(|t| t.to_device(self.device))),
        })
    }
}

impl fmt::Debug for Upload {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Upload").field("device", &self.device).finish_non_exhaustive()
    }
}

/// Copy of tensors in progress.
pub(crate) enum PendingCopy<const N: usize> {
    Done([Tensor; N]),
    Gpu(UniquePtr<ffi::PendingCopies>),
}

impl<const N: usize> PendingCopy<N> {
    /// Returns the tensors on the device. Work queued on the device from now on waits for the copy; the host doesn't.
    ///
    /// # Errors
    /// Returns an error if the GPU fails.
    pub fn wait(self) -> Result<[Tensor; N]> {
        match self {
            PendingCopy::Done(tensors) => Ok(tensors),
            // SAFETY: on success the C++ side has stored new tensors in `out`.
            PendingCopy::Gpu(copies) => Ok(unsafe { take_outputs(|out| copies.take_tensors(out)) }?),
        }
    }
}

impl<const N: usize> fmt::Debug for PendingCopy<N> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("PendingCopy")
    }
}

/// Lock on libtorch's number of threads, which tests share. MKL splits a product among them, so the last bits of results depend on it.
#[cfg(test)]
pub(crate) mod num_threads {
    use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

    static LOCK: RwLock<()> = RwLock::new(());

    /// Guard of a test that compares the bits of several runs.
    pub fn keep() -> RwLockReadGuard<'static, ()> {
        LOCK.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Guard of a test that changes the number of threads.
    pub fn change() -> RwLockWriteGuard<'static, ()> {
        LOCK.write().unwrap_or_else(PoisonError::into_inner)
    }
}
