//! What a GPU does beside its work: copies from the host on a stream of their own, and marks that tell when it was where. On the CPU
//! the same calls do the same at once.

use crate::render::handed_over;
use cxx::UniquePtr;
use globalsplat_csrc::device as ffi;
use std::fmt;
use std::time::{Duration, Instant};
use tch::{Device, Kind, Tensor};

pub(crate) use ffi::leave_out_tf32;

/// CUDA's number of a device, if it is one of CUDA's.
fn gpu(device: Device) -> Option<i32> {
    match device {
        Device::Cuda(number) => Some(number as i32),
        _ => None,
    }
}

/// A moment in the work of a device: on a GPU, when it is done with what it was given until then.
pub(crate) enum Moment {
    Host(Instant),
    Gpu(UniquePtr<ffi::Mark>),
}

impl Moment {
    /// Now; a GPU isn't waited for.
    pub fn now(device: Device) -> Self {
        match gpu(device) {
            Some(gpu) => Moment::Gpu(ffi::mark(gpu).expect("a GPU that works")),
            None => Moment::Host(Instant::now()),
        }
    }

    /// The time since `earlier`, of the same device. A GPU is waited for until it has come by both.
    pub fn since(&self, earlier: &Moment) -> Duration {
        match (self, earlier) {
            (Moment::Gpu(mark), Moment::Gpu(earlier)) => {
                let milliseconds = mark.since(earlier).expect("a GPU that works");
                Duration::from_secs_f64(1e-3 * milliseconds.max(0.))
            }
            (Moment::Host(instant), Moment::Host(earlier)) => *instant - *earlier,
            _ => panic!("moments of two devices"),
        }
    }
}

impl fmt::Debug for Moment {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Moment")
    }
}

/// The way from the host to a device. To a GPU copies go while it works.
pub(crate) struct Upload {
    device: Device,
    stream: Option<UniquePtr<ffi::CopyStream>>,
}

impl Upload {
    /// To be kept for all copies to `device`.
    pub fn to(device: Device) -> Self {
        let stream = gpu(device).map(|gpu| ffi::copy_stream(gpu).expect("a GPU that works"));
        Upload { device, stream }
    }

    /// Where it leads.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Bytes of the host, zeros or anything else, in memory from which they are copied without another copy before.
    pub fn bytes(&self, shape: &[i64]) -> Tensor {
        if self.stream.is_none() {
            return Tensor::empty(shape, (Kind::Uint8, Device::Cpu));
        }
        // SAFETY: on success the C++ side has put a new tensor there.
        let done = unsafe { handed_over(|out| ffi::page_locked_bytes(shape, out)) };
        let [bytes] = done.expect("memory");
        bytes
    }

    /// Begins to copy `tensors` of the host, which may be dropped at once.
    pub fn begin<const N: usize>(&self, tensors: [&Tensor; N]) -> Uploading<N> {
        match &self.stream {
            Some(stream) => {
                let addresses = tensors.map(|t| t.as_ptr() as usize);
                // SAFETY: the tensors outlive the call.
                Uploading::Gpu(unsafe { stream.copy(&addresses) }.expect("memory"))
            }
            None => Uploading::Done(tensors.map(|t| t.to_device(self.device))),
        }
    }
}

impl fmt::Debug for Upload {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Upload").field("device", &self.device).finish_non_exhaustive()
    }
}

/// Tensors on their way.
pub(crate) enum Uploading<const N: usize> {
    Done([Tensor; N]),
    Gpu(UniquePtr<ffi::Copies>),
}

impl<const N: usize> Uploading<N> {
    /// The tensors on the device. What it is given from now on waits for them, the host doesn't.
    pub fn arrive(self) -> [Tensor; N] {
        match self {
            Uploading::Done(tensors) => tensors,
            Uploading::Gpu(copies) => {
                // SAFETY: on success the C++ side has put new tensors there.
                let done = unsafe { handed_over(|out| copies.hand_over(out)) };
                done.expect("a GPU that works")
            }
        }
    }
}

impl<const N: usize> fmt::Debug for Uploading<N> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Uploading")
    }
}
