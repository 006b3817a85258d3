//! Benchmarks. They are run by `globalsplat bench`, never by tests, and return the JSON objects that the command prints.

mod model;
mod raster;
mod refine;
mod spans;
mod train;

pub use model::bench_model;
pub use raster::{bench_raster, synthetic_gaussians};
pub use refine::bench_refine;
pub use train::bench_train;

use crate::device::Stopwatch;
use crate::error::Result;
use crate::model::Precision;
use serde::Serialize;
use spans::record_spans;
use std::borrow::Cow;
use tch::{Device, Kind, Tensor, nn, no_grad};

/// Distribution of several measurements of the same operation, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize)]
struct TimingStats {
    median: f64,
    #[serde(rename = "least")]
    min: f64,
    /// 75th percentile, which shows the influence of other load on the machine.
    upper_quartile: f64,
}

impl TimingStats {
    /// Computes the distribution of at least one measurement.
    fn from_milliseconds(mut milliseconds: Vec<f64>) -> Self {
        milliseconds.sort_by(f64::total_cmp);
        let at = |share: f64| milliseconds[((milliseconds.len() - 1) as f64 * share).round() as usize];
        TimingStats { median: at(0.5), min: at(0.), upper_quartile: at(0.75) }
    }
}

/// A section of a measured operation, with its time per view or per step.
#[derive(Debug, Serialize)]
struct Section {
    name: Cow<'static, str>,
    milliseconds: TimingStats,
}

/// Times in milliseconds of each run of an operation, in total and by section.
#[derive(Debug, Default)]
struct Measured {
    whole: Vec<f64>,
    sections: Vec<(Cow<'static, str>, Vec<f64>)>,
}

impl Measured {
    /// Adds the times that `watch` recorded for one run.
    fn add(&mut self, watch: &mut Stopwatch) -> Result<()> {
        let times = watch.sections()?.iter().map(|(name, time)| (*name, 1e3 * time.as_secs_f64()));
        self.whole.push(times.clone().map(|(_, milliseconds)| milliseconds).sum());
        times.for_each(|(name, milliseconds)| self.add_section(name.into(), milliseconds));
        Ok(())
    }

    /// Adds the time of a single section.
    fn add_section(&mut self, name: Cow<'static, str>, milliseconds: f64) {
        match self.sections.iter_mut().find(|(known, _)| *known == name) {
            Some((_, all)) => all.push(milliseconds),
            None => self.sections.push((name, vec![milliseconds])),
        }
    }

    /// Returns the distribution of the total time. Requires at least one run.
    fn total(&self) -> TimingStats {
        TimingStats::from_milliseconds(self.whole.clone())
    }

    /// Returns the distribution of each section, in the order in which the sections were first added.
    fn sections(self) -> Vec<Section> {
        let section = |(name, all)| Section { name, milliseconds: TimingStats::from_milliseconds(all) };
        self.sections.into_iter().map(section).collect()
    }
}

/// Statistics of a part of a model's pass.
#[derive(Debug, Serialize)]
struct Part {
    name: &'static str,
    milliseconds: TimingStats,
    /// Floating-point operations of the part's matrix products, in GFLOP.
    gflop: f64,
    /// Floating-point operations of the backward pass of these products, in GFLOP; 0 if gradients aren't recorded.
    backward_gflop: f64,
    /// Memory traffic of the part's products, norms and sums in GB, if each element is moved once.
    gigabytes: f64,
    /// Throughput at the minimum time, as a fraction of that of a product of large matrices; 0 for a part without products.
    share_of_peak: f64,
}

/// Statistics of the parts over all recorded passes.
#[derive(Default)]
struct PartRecorder {
    parts: Vec<PartSum>,
}

#[derive(Default)]
struct PartSum {
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
    fn record<T>(&mut self, device: Device, pass: impl FnOnce() -> Result<T>) -> Result<T> {
        let (result, spans) = record_spans(device, pass);
        let result = result?;
        let mut sums: Vec<PartSum> = vec![];
        for span in spans {
            let elapsed = span.elapsed?;
            let known = sums.iter().position(|sum| sum.name == span.name).unwrap_or_else(|| {
                sums.push(PartSum { name: span.name, milliseconds: vec![0.], ..Default::default() });
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
            false => {
                let known = self.parts.iter_mut().zip(sums);
                known.for_each(|(all, one)| all.milliseconds.extend(one.milliseconds));
            }
        }
        Ok(result)
    }

    /// Returns the statistics. `peak_gflops` is the throughput of a product of large matrices, which [`Part::share_of_peak`] refers to.
    fn into_stats(self, peak_gflops: f64) -> Vec<Part> {
        let part = |sum: PartSum| {
            let milliseconds = TimingStats::from_milliseconds(sum.milliseconds);
            let share_of_peak = 1e-6 * sum.flops / milliseconds.min / peak_gflops;
            let [gflop, backward_gflop, gigabytes] =
                [sum.flops, sum.backward_flops, sum.bytes].map(|of| 1e-9 * of);
            Part { name: sum.name, milliseconds, gflop, backward_gflop, gigabytes, share_of_peak }
        };
        self.parts.into_iter().map(part).collect()
    }
}

/// Two square matrices, multiplied in the same way as in the model's linear layers: the throughput that other products are compared with.
struct PeakThroughput {
    matrix: Tensor,
    layer: nn::Linear,
    precision: Precision,
}

impl PeakThroughput {
    /// Creates random matrices in `precision` on `device`, with sides of 2048 on the CPU and 8192 on a GPU.
    fn new(precision: Precision, device: Device) -> Self {
        let side = if device == Device::Cpu { 2048 } else { 8192 };
        let matrix = Tensor::randn([side, side], (Kind::Float, device)).to_kind(precision.kind());
        let layer = nn::Linear { ws: matrix.shallow_clone(), bs: None };
        PeakThroughput { matrix, layer, precision }
    }

    /// Returns the time of one product, in milliseconds.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    fn time(&self) -> Result<f64> {
        let mut watch = Stopwatch::new(self.matrix.device());
        no_grad(|| watch.time("product", || drop(self.precision.linear(&self.layer, &self.matrix))));
        Ok(1e3 * watch.sections()?[0].1.as_secs_f64())
    }

    /// Returns the throughput in GFLOP/s of the fastest of some products, by their times in milliseconds.
    fn gflops(&self, milliseconds: Vec<f64>) -> f64 {
        2e-6 * (self.matrix.size()[0] as f64).powi(3) / TimingStats::from_milliseconds(milliseconds).min
    }
}
