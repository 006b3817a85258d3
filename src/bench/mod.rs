//! Benchmarks. They are run by commands, never by tests.

mod attention;
mod loader;
mod model;
mod parts;
mod peak_throughput;
mod raster;
mod refine;
mod spans;
mod synth;
mod train;
mod video;

pub use attention::{AttentionReport, AttentionRow, bench_attention};
pub use loader::{LoaderReport, StageMilliseconds, bench_loader, synthetic_videos};
pub use model::{ModelReport, bench_model};
pub use parts::Part;
pub use raster::{RasterReport, bench_raster, synthetic_gaussians};
pub use refine::{RefineReport, bench_refine};
pub use synth::{SynthReport, bench_synth};
pub use train::{DistributedCost, TrainReport, bench_train};

use crate::device::Stopwatch;
use crate::error::Result;
use serde::Serialize;
use std::borrow::Cow;

/// Distribution of several measurements of the same operation, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct TimingStats {
    /// Median of the measurements.
    pub median: f64,
    /// Minimum of the measurements.
    #[serde(rename = "least")]
    pub min: f64,
    /// 75th percentile of the measurements, which shows the influence of other load on the machine.
    pub upper_quartile: f64,
}

/// A section of a measured operation.
#[derive(Debug, Serialize)]
pub struct Section {
    /// Name of the section.
    pub name: Cow<'static, str>,
    /// Time per view or per step.
    pub milliseconds: TimingStats,
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

    /// Returns the distributions of the total time and of each section. Requires at least one run.
    fn into_stats(mut self) -> (TimingStats, Vec<Section>) {
        (TimingStats::from_milliseconds(std::mem::take(&mut self.whole)), self.sections())
    }

    /// Returns the distribution of each section, in the order in which the sections were first added.
    fn sections(self) -> Vec<Section> {
        let section = |(name, all)| Section { name, milliseconds: TimingStats::from_milliseconds(all) };
        self.sections.into_iter().map(section).collect()
    }
}

impl TimingStats {
    /// Computes the distribution of at least one measurement.
    fn from_milliseconds(mut milliseconds: Vec<f64>) -> Self {
        milliseconds.sort_by(f64::total_cmp);
        let at = |share: f64| milliseconds[((milliseconds.len() - 1) as f64 * share).round() as usize];
        TimingStats { median: at(0.5), min: at(0.), upper_quartile: at(0.75) }
    }
}
