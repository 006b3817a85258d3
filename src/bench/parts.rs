//! Parts of a model's pass: the time, the floating-point operations and the memory traffic of each.

use super::TimingStats;
use super::spans::record_spans;
use crate::error::Result;
use serde::Serialize;
use tch::Device;

/// Statistics of a part of a pass.
#[derive(Debug, Serialize)]
pub struct Part {
    /// Name of the part.
    pub name: &'static str,
    /// Time of the part per pass.
    pub milliseconds: TimingStats,
    /// Floating-point operations of the part's matrix products, in GFLOP.
    pub gflop: f64,
    /// Floating-point operations of the backward pass of these products, in GFLOP; 0 if gradients aren't recorded.
    pub backward_gflop: f64,
    /// Memory traffic of the part's products, norms and sums in GB, if each element is moved once.
    pub gigabytes: f64,
    /// Throughput at the minimum time, as a fraction of that of a product of large matrices; 0 for a part without products.
    pub share_of_peak: f64,
}

/// Statistics of the parts over all watched passes.
#[derive(Default)]
pub(super) struct PartRecorder {
    parts: Vec<Sum>,
}

#[derive(Default)]
struct Sum {
    name: &'static str,
    milliseconds: Vec<f64>,
    flops: f64,
    backward_flops: f64,
    bytes: f64,
}

impl PartRecorder {
    /// Runs `pass` and adds the statistics of its parts, timed by the clock of `device`.
    ///
    /// # Errors
    /// Returns the error of `pass`, or an error if a GPU is missing or fails.
    pub fn record<T>(&mut self, device: Device, pass: impl FnOnce() -> Result<T>) -> Result<T> {
        let (result, spans) = record_spans(device, pass);
        let result = result?;
        let mut sums: Vec<Sum> = vec![];
        for span in spans {
            let elapsed = span.elapsed?;
            let known = sums.iter().position(|sum| sum.name == span.name).unwrap_or_else(|| {
                sums.push(Sum { name: span.name, milliseconds: vec![0.], ..Default::default() });
                sums.len() - 1
            });
            sums[known].milliseconds[0] += 1e3 * elapsed.as_secs_f64();
            sums[known].flops += span.flops;
            sums[known].backward_flops += span.backward_flops;
            sums[known].bytes += span.bytes;
        }
        match self.parts.is_empty() {
            true => self.parts = sums,
            // Every pass has the same parts.
            false => self
                .parts
                .iter_mut()
                .zip(sums)
                .for_each(|(all, one)| all.milliseconds.extend(one.milliseconds)),
        }
        Ok(result)
    }

    /// Returns the statistics. `peak_gflops` is the throughput of a product of large matrices, which [`Part::share_of_peak`] refers to.
    pub fn into_stats(self, peak_gflops: f64) -> Vec<Part> {
        let part = |sum: Sum| {
            let milliseconds = TimingStats::from_milliseconds(sum.milliseconds);
            let share_of_peak = 1e-6 * sum.flops / milliseconds.min / peak_gflops;
            let [gflop, backward_gflop, gigabytes] =
                [sum.flops, sum.backward_flops, sum.bytes].map(|of| 1e-9 * of);
            Part { name: sum.name, milliseconds, gflop, backward_gflop, gigabytes, share_of_peak }
        };
        self.parts.into_iter().map(part).collect()
    }
}
