//! Where time goes.

use crate::device::Moment;
use std::time::Duration;
use tch::Device;

/// Adds up how long the parts of some work take, each under its name.
#[derive(Debug)]
pub struct Stopwatch {
    device: Device,
    sections: Vec<(&'static str, Duration)>,
    /// Their beginnings and ends. When a GPU came by them isn't asked before somebody wants to know: it would be waited for.
    parts: Vec<(&'static str, Moment, Moment)>,
}

impl Default for Stopwatch {
    /// By the host's clock: of work on a GPU it tells how long it took to hand out.
    fn default() -> Self {
        Stopwatch::of(Device::Cpu)
    }
}

impl Stopwatch {
    /// By the clock of `device`, from when it was done with what was given to it before a part to when it is done with the part.
    pub fn of(device: Device) -> Self {
        Stopwatch { device, sections: vec![], parts: vec![] }
    }

    /// Does `work` and counts its time to `section`.
    pub fn time<T>(&mut self, section: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Moment::now(self.device);
        let result = work();
        self.parts.push((section, start, Moment::now(self.device)));
        if self.device == Device::Cpu {
            self.add_up();
        }
        result
    }

    /// Every section and its time, in the order in which they were first entered. A GPU is waited for.
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
