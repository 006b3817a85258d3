//! Devices: asynchronous copies from the host to a GPU on a stream of their own, events that time the GPU's work, and memory use. On the
//! CPU the same calls run synchronously.

mod memory;

pub(crate) use memory::{
    peak_device_memory_bytes, peak_memory_bytes_on, reset_peak_memory, resident_memory_bytes,
};
pub use memory::{peak_memory_bytes, total_memory_bytes};

use crate::error::{Error, Result};
use crate::ffi::take_tensor;
use cxx::UniquePtr;
use globalsplat_csrc::runtime as ffi;
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
    pub fn now(device: Device) -> Result<Self> {
        Ok(match gpu(device) {
            Some(gpu) => DeviceEvent::Gpu(ffi::record_event(gpu).map_err(Error::external)?),
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
            (DeviceEvent::Gpu(event), DeviceEvent::Gpu(earlier)) => Duration::from_secs_f64(
                1e-3 * event.milliseconds_since(earlier).map_err(Error::external)?.max(0.),
            ),
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
        let stream = gpu(device).map(ffi::copy_stream).transpose().map_err(Error::external)?;
        Ok(Upload { device, stream })
    }

    /// Returns the destination device.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Returns uninitialized bytes on the host, in page-locked memory if the device is a GPU, so that they are copied without
    /// an intermediate buffer.
    pub fn bytes(&self, shape: &[i64]) -> Result<Tensor> {
        if self.stream.is_none() {
            return Ok(Tensor::empty(shape, (Kind::Uint8, Device::Cpu)));
        }
        // SAFETY: the C++ side returns the address of a new tensor.
        Ok(unsafe { take_tensor(ffi::empty_pinned_bytes(shape).map_err(Error::external)?) })
    }

    /// Starts copying `tensors` from the host; the caller may drop them immediately.
    pub fn begin(&self, tensors: &[Tensor]) -> Result<PendingCopy> {
        Ok(match &self.stream {
            Some(stream) => {
                let addresses: Vec<usize> = tensors.iter().map(|t| t.as_ptr() as usize).collect();
                // SAFETY: the tensors outlive the call.
                PendingCopy::Gpu(unsafe { stream.copy(&addresses) }.map_err(Error::external)?)
            }
            None => PendingCopy::Done(tensors.iter().map(|t| t.to_device(self.device)).collect()),
        })
    }
}

impl fmt::Debug for Upload {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Upload").field("device", &self.device).finish_non_exhaustive()
    }
}

/// Copy of tensors in progress.
pub(crate) enum PendingCopy {
    Done(Vec<Tensor>),
    Gpu(UniquePtr<ffi::PendingCopies>),
}

impl PendingCopy {
    /// Returns the tensors on the device. Work queued on the device from now on waits for the copy; the host doesn't.
    pub fn wait(self) -> Result<Vec<Tensor>> {
        match self {
            PendingCopy::Done(tensors) => Ok(tensors),
            PendingCopy::Gpu(copies) => {
                // SAFETY: the C++ side returns the addresses of new tensors.
                Ok(copies
                    .take_tensors()
                    .map_err(Error::external)?
                    .into_iter()
                    .map(|address| unsafe { take_tensor(address) })
                    .collect())
            }
        }
    }
}

impl fmt::Debug for PendingCopy {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("PendingCopy")
    }
}

/// Stopwatch that adds up the time of named sections of some work.
#[derive(Debug)]
pub struct Stopwatch {
    device: Device,
    sections: Vec<(&'static str, Duration)>,
    /// Starts and ends of sections on a GPU that are not added up yet. They are read only when the times are requested: reading them waits
    /// for the GPU.
    pending: Vec<(&'static str, Result<DeviceEvent>, Result<DeviceEvent>)>,
}

impl Default for Stopwatch {
    /// Returns a stopwatch on the host's clock. For work on a GPU, it measures the time to launch the work.
    fn default() -> Self {
        Stopwatch::new(Device::Cpu)
    }
}

impl Stopwatch {
    /// Returns a stopwatch on the clock of `device`. A section lasts from when the device has finished all earlier work to when it has
    /// finished the section.
    pub fn new(device: Device) -> Self {
        Stopwatch { device, sections: vec![], pending: vec![] }
    }

    /// Runs `work` and adds its time to `section`. [`Stopwatch::sections`] returns the error of a GPU that fails meanwhile.
    pub fn time<T>(&mut self, section: &'static str, work: impl FnOnce() -> T) -> T {
        let start = DeviceEvent::now(self.device);
        let result = work();
        self.add_since(section, start);
        result
    }

    /// Adds the time since `start` to `section`, like [`Stopwatch::time`].
    pub(crate) fn add_since(&mut self, section: &'static str, start: Result<DeviceEvent>) {
        match (start, DeviceEvent::now(self.device)) {
            (Ok(DeviceEvent::Host(start)), Ok(DeviceEvent::Host(end))) => self.add(section, end - start),
            (start, end) => self.pending.push((section, start, end)),
        }
    }

    /// Returns every section and its time, in the order in which they were first entered. Waits for a GPU to finish.
    ///
    /// # Errors
    /// Returns an error if the GPU is missing or its work has failed.
    pub fn sections(&mut self) -> Result<&[(&'static str, Duration)]> {
        for (section, start, end) in std::mem::take(&mut self.pending) {
            let elapsed = end?.since(&start?)?;
            self.add(section, elapsed);
        }
        Ok(&self.sections)
    }

    fn add(&mut self, section: &'static str, elapsed: Duration) {
        match self.sections.iter_mut().find(|(name, _)| *name == section) {
            Some((_, sum)) => *sum += elapsed,
            None => self.sections.push((section, elapsed)),
        }
    }
}

/// Returns the time since the system began to load the program, to a hundredth of a second. It includes the loading of libtorch, which is
/// large. Returns `None` on systems other than Linux.
pub fn process_age() -> Option<Duration> {
    // The start time is the 22nd field, in clock ticks since boot. Count the fields after the program's name, which may contain anything.
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let began: f64 = stat.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()?;
    let uptime = std::fs::read_to_string("/proc/uptime").ok()?;
    let now: f64 = uptime.split(' ').next()?.parse().ok()?;
    // SAFETY: `sysconf` only returns a number.
    let ticks = unsafe { libc::sysconf(libc::_SC_CLK_TCK) } as f64;
    Duration::try_from_secs_f64(now - began / ticks).ok()
}

/// Lock on libtorch's number of threads, which tests share. MKL splits a product among them, so the last bits of results depend on it.
#[cfg(test)]
pub(crate) mod num_threads {
    use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

    static LOCK: RwLock<()> = RwLock::new(());

    /// Guard of a test that compares the bits of several runs.
    pub fn lock_shared() -> RwLockReadGuard<'static, ()> {
        LOCK.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Guard of a test that changes the number of threads.
    pub fn lock_exclusive() -> RwLockWriteGuard<'static, ()> {
        LOCK.write().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::sleep;

    #[test]
    fn parts_of_a_section_are_added_up() {
        let mut stopwatch = Stopwatch::default();
        let nap = Duration::from_millis(2);
        for section in ["b", "a", "b"] {
            assert_eq!(stopwatch.time(section, || sleep(nap)), ());
        }
        let sections = stopwatch.sections().unwrap();
        assert_eq!(sections.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["b", "a"]);
        assert!(sections[0].1 >= 2 * nap && sections[1].1 >= nap, "{sections:?}");
    }

    /// A GPU that doesn't exist is an error, not a panic, and the work is done all the same.
    #[test]
    fn a_missing_gpu_is_an_error() {
        let missing = Device::Cuda(tch::Cuda::device_count() as usize);
        let mut stopwatch = Stopwatch::new(missing);
        assert_eq!(stopwatch.time("a", || 4), 4);
        assert!(stopwatch.sections().is_err());
        assert!(Upload::new(missing).is_err());
    }
}
