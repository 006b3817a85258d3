//! Where time goes.

use std::time::{Duration, Instant};
use tch::{Cuda, Device};

/// Adds up how long the parts of some work take, each under its name.
#[derive(Debug, Default)]
pub struct Stopwatch {
    sections: Vec<(&'static str, Duration)>,
    /// The GPU that is waited for before the hand is read.
    gpu: Option<i64>,
}

impl Stopwatch {
    /// For work on `device`, which is waited for at every section's end. [`Stopwatch::default`] doesn't wait: on a GPU it
    /// tells how long work took to hand out.
    pub fn waiting_for(device: Device) -> Self {
        let gpu = match device {
            Device::Cuda(index) => Some(index as i64),
            _ => None,
        };
        Stopwatch { sections: vec![], gpu }
    }

    /// Does `work` and counts its time to `section`.
    pub fn time<T>(&mut self, section: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        if let Some(index) = self.gpu {
            Cuda::synchronize(index);
        }
        let elapsed = start.elapsed();
        match self.sections.iter_mut().find(|(name, _)| *name == section) {
            Some((_, sum)) => *sum += elapsed,
            None => self.sections.push((section, elapsed)),
        }
        result
    }

    /// Every section and its time, in the order in which they were first entered.
    pub fn sections(&self) -> &[(&'static str, Duration)] {
        &self.sections
    }
}
