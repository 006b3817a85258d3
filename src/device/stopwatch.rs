//! Measurement of the time that sections of some work take.

use super::DeviceEvent;
use std::time::Duration;
use tch::Device;

/// Stopwatch that adds up the time of named sections of some work.
#[derive(Debug)]
pub struct Stopwatch {
    device: Device,
    sections: Vec<(&'static str, Duration)>,
    /// Starts and ends of sections that are not added up yet. A GPU's events are read only when the times are requested: reading them waits
    /// for the GPU.
    parts: Vec<(&'static str, DeviceEvent, DeviceEvent)>,
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
        Stopwatch { device, sections: vec![], parts: vec![] }
    }

    /// Runs `work` and adds its time to `section`.
    pub fn time<T>(&mut self, section: &'static str, work: impl FnOnce() -> T) -> T {
        let start = DeviceEvent::now(self.device);
        let result = work();
        self.parts.push((section, start, DeviceEvent::now(self.device)));
        if self.device == Device::Cpu {
            self.add_up();
        }
        result
    }

    /// Returns every section and its time, in the order in which they were first entered. Waits for a GPU to finish.
    pub fn sections(&mut self) -> &[(&'static str, Duration)] {
        self.add_up();
        &self.sections
    }

    fn add_up(&mut self) {
        for (section, start, end) in self.parts.drain(..) {
            let elapsed = end.since(&start);
            match self.sections.iter_mut().find(|(name, _)| *name == section) {
                Some((_, sum)) => *sum += elapsed,
                None => self.sections.push((section, elapsed)),
            }
        }
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
        let sections = stopwatch.sections();
        assert_eq!(sections.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["b", "a"]);
        assert!(sections[0].1 >= 2 * nap && sections[1].1 >= nap, "{sections:?}");
    }
}
