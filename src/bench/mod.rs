//! How fast things are: measured by commands that anyone can run, never by tests.

mod attention;
mod loader;
mod model;
mod parts;
mod raster;
mod refine;
mod synth;
mod train;
mod video;
mod yardstick;

pub use attention::{AttentionReport, AttentionRow, bench_attention};
pub use loader::{LoaderReport, StageMilliseconds, bench_loader, made_up_videos};
pub use model::{ModelReport, bench_model};
pub use parts::Part;
pub use raster::{RasterReport, bench_raster, made_up_scene};
pub use refine::{RefineReport, bench_refine};
pub use synth::{SynthReport, bench_synth};
pub use train::{Together, TrainReport, bench_train};

use crate::optim::Stopwatch;
use serde::Serialize;
use std::borrow::Cow;

/// Of several measurements of the same thing, in milliseconds: the middle one and how far the others lie apart.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Spread {
    /// Half of the measurements are below.
    pub median: f64,
    /// The fastest.
    pub least: f64,
    /// Three of four are below: what a busy machine makes of it.
    pub upper_quartile: f64,
}

/// A part of some work.
#[derive(Debug, Serialize)]
pub struct Section {
    /// What the part is called.
    pub name: Cow<'static, str>,
    /// Of a view, or of a step.
    pub milliseconds: Spread,
}

/// Milliseconds that work took, and its sections, each time that it was done.
#[derive(Debug, Default)]
struct Measured {
    whole: Vec<f64>,
    sections: Vec<(Cow<'static, str>, Vec<f64>)>,
}

impl Measured {
    /// What `watch` has seen of it this time.
    fn add(&mut self, watch: &mut Stopwatch) {
        let times = watch.sections().iter().map(|(name, time)| (*name, 1e3 * time.as_secs_f64()));
        self.whole.push(times.clone().map(|(_, milliseconds)| milliseconds).sum());
        times.for_each(|(name, milliseconds)| self.add_section(name.into(), milliseconds));
    }

    /// A section alone.
    fn add_section(&mut self, name: Cow<'static, str>, milliseconds: f64) {
        match self.sections.iter_mut().find(|(known, _)| *known == name) {
            Some((_, all)) => all.push(milliseconds),
            None => self.sections.push((name, vec![milliseconds])),
        }
    }

    /// Of at least one time.
    fn told(mut self) -> (Spread, Vec<Section>) {
        (Spread::of(std::mem::take(&mut self.whole)), self.sections())
    }

    /// The sections alone, in the order in which they were first added.
    fn sections(self) -> Vec<Section> {
        let section = |(name, all)| Section { name, milliseconds: Spread::of(all) };
        self.sections.into_iter().map(section).collect()
    }
}

impl Spread {
    /// Of at least one number.
    fn of(mut milliseconds: Vec<f64>) -> Self {
        milliseconds.sort_by(f64::total_cmp);
        let at = |share: f64| milliseconds[((milliseconds.len() - 1) as f64 * share).round() as usize];
        Spread { median: at(0.5), least: at(0.), upper_quartile: at(0.75) }
    }
}
