//! Measurement of the time that sections of some work take, and of the age of the process.

use super::DeviceEvent;
use crate::error::Result;
use std::time::Duration;
use tch::Device;

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
        match (start, DeviceEvent::now(self.device)) {
            (Ok(DeviceEvent::Host(start)), Ok(DeviceEvent::Host(end))) => self.add(section, end - start),
            (start, end) => self.pending.push((section, start, end)),
        }
        result
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::Upload;
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
