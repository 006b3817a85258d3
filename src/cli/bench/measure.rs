//! Measurement of an operation: the times of its sections or spans over several runs, and the work recorded in them.

use crate::device::{DeviceEvent, Stopwatch};
use crate::error::Result;
use crate::model::Precision;
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::fmt::Debug;
use std::sync::{Arc, Mutex, MutexGuard};
use tch::{Device, Kind, Tensor, nn, no_grad};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber, subscriber};

/// Distribution of several measurements of the same operation, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct TimingStats {
    pub median: f64,
    #[serde(rename = "least")]
    pub min: f64,
    /// 75th percentile, which shows the influence of other load on the machine.
    pub upper_quartile: f64,
}

impl TimingStats {
    /// Computes the distribution of at least one measurement.
    pub fn from_milliseconds(mut milliseconds: Vec<f64>) -> Self {
        milliseconds.sort_by(f64::total_cmp);
        let at = |share: f64| milliseconds[((milliseconds.len() - 1) as f64 * share).round() as usize];
        TimingStats { median: at(0.5), min: at(0.), upper_quartile: at(0.75) }
    }
}

/// A section of a measured operation, with its time per view or per step.
#[derive(Debug, Serialize)]
pub struct Section {
    pub name: String,
    pub milliseconds: TimingStats,
}

/// Times of an operation's sections in every run, in the order in which the sections first ran.
#[derive(Default)]
pub struct Measured {
    runs: usize,
    sections: Vec<Recorded>,
}

struct Recorded {
    name: String,
    milliseconds: Vec<f64>,
    /// Work of the first run. Every run does the same.
    work: Work,
}

impl Measured {
    /// Adds one run with these sections, their times in milliseconds, and their work.
    pub fn add_run(&mut self, sections: impl IntoIterator<Item = (String, f64, Work)>) {
        self.runs += 1;
        for (name, milliseconds, work) in sections {
            let known = self.sections.iter().position(|section| section.name == name).unwrap_or_else(|| {
                self.sections.push(Recorded { name, milliseconds: vec![], work });
                self.sections.len() - 1
            });
            let section = &mut self.sections[known];
            section.milliseconds.resize(self.runs, 0.);
            section.milliseconds[self.runs - 1] += milliseconds;
        }
    }

    /// Adds the sections that `watch` recorded as one run.
    pub fn add_watch(&mut self, watch: &mut Stopwatch) -> Result<()> {
        self.add_timed(watch, HashMap::new())
    }

    fn add_timed(&mut self, watch: &mut Stopwatch, mut work: HashMap<&'static str, Work>) -> Result<()> {
        let sections = watch.sections()?.iter();
        self.add_run(sections.map(|(name, time)| {
            (name.to_string(), 1e3 * time.as_secs_f64(), work.remove(name).unwrap_or_default())
        }));
        Ok(())
    }

    /// Runs `pass` and adds the spans of this library on this thread as one run, timed by the clock of `device`. A span inside of another one
    /// is part of that.
    ///
    /// # Errors
    /// Returns the error of `pass`, or an error if a GPU is missing or fails.
    pub fn record<T>(&mut self, device: Device, pass: impl FnOnce() -> Result<T>) -> Result<T> {
        let state = Mutex::new(State { watch: Stopwatch::new(device), ..State::default() });
        let recorder = Arc::new(SpanRecorder { device, state });
        let result = subscriber::with_default(recorder.clone(), pass)?;
        let mut state = recorder.state();
        let work = std::mem::take(&mut state.work);
        self.add_timed(&mut state.watch, work)?;
        Ok(result)
    }

    /// Returns the distribution of the total time. Requires at least one run.
    pub fn total(&self) -> TimingStats {
        let run = |run: usize| self.sections.iter().map(|section| section.milliseconds[run]).sum();
        TimingStats::from_milliseconds((0..self.runs).map(run).collect())
    }

    /// Returns the distribution of each section.
    pub fn sections(self) -> Vec<Section> {
        let section = |recorded: Recorded| Section {
            name: recorded.name,
            milliseconds: TimingStats::from_milliseconds(recorded.milliseconds),
        };
        self.sections.into_iter().map(section).collect()
    }

    /// Returns each section with its work: GFLOP of its matrix products and of their backward pass (0 if gradients aren't recorded), GB of
    /// memory traffic if each element is moved once, and the throughput at the minimum time as a fraction of `peak_gflops`.
    pub fn parts(self, peak_gflops: f64) -> Vec<Value> {
        let part = |Recorded { name, milliseconds, work }: Recorded| {
            let milliseconds = TimingStats::from_milliseconds(milliseconds);
            json!({
                "name": name,
                "milliseconds": milliseconds,
                "gflop": 1e-9 * work.flops,
                "backward_gflop": 1e-9 * work.backward_flops,
                "gigabytes": 1e-9 * work.bytes,
                "share_of_peak": 1e-6 * work.flops / milliseconds.min / peak_gflops,
            })
        };
        self.sections.into_iter().map(part).collect()
    }
}

/// Number of products that measure the peak throughput of the machine.
const PRODUCTS: usize = 6;

/// Returns the throughput in GFLOP/s that other products are compared with: that of the fastest of some products of two square matrices,
/// multiplied in the same way as in the model's linear layers. Their sides are 2048 on the CPU and 8192 on a GPU.
///
/// # Errors
/// Returns an error if a GPU fails.
pub fn peak_gflops(precision: Precision, device: Device) -> Result<f64> {
    let side = if device == Device::Cpu { 2048 } else { 8192 };
    let matrix = Tensor::randn([side, side], (Kind::Float, device)).to_kind(precision.kind());
    let layer = nn::Linear { ws: matrix.shallow_clone(), bs: None };
    let mut fastest = f64::INFINITY;
    for _ in 0..PRODUCTS {
        let mut watch = Stopwatch::new(device);
        no_grad(|| watch.time("product", || drop(precision.linear(&layer, &matrix))));
        fastest = fastest.min(watch.sections()?[0].1.as_secs_f64());
    }
    Ok(2e-9 * (side as f64).powi(3) / fastest)
}

/// Subscriber that records the outermost spans of a thread.
struct SpanRecorder {
    device: Device,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    watch: Stopwatch,
    /// Work of the outermost spans and of the spans inside, by name.
    work: HashMap<&'static str, Work>,
    /// Names of all spans. The number of a span's `Id` is its position here, plus 1.
    names: Vec<&'static str>,
    /// Names of the spans that the thread is inside of, the outermost first.
    entered: Vec<&'static str>,
    /// Start of the outermost span.
    start: Option<Result<DeviceEvent>>,
}

/// Sums of the fields of `record_work` in the model.
#[derive(Default)]
pub struct Work {
    /// Floating-point operations of matrix products.
    flops: f64,
    /// Floating-point operations of the backward pass of these products.
    backward_flops: f64,
    /// Bytes of the inputs and outputs of these products, and of norms and sums.
    bytes: f64,
}

impl Visit for Work {
    fn record_i64(&mut self, field: &Field, value: i64) {
        match field.name() {
            "flops" => self.flops += value as f64,
            "backward_flops" => self.backward_flops += value as f64,
            "bytes" => self.bytes += value as f64,
            _ => (),
        }
    }

    fn record_debug(&mut self, _: &Field, _: &dyn Debug) {}
}

impl SpanRecorder {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no thread panics here")
    }
}

impl Subscriber for SpanRecorder {
    fn enabled(&self, metadata: &Metadata) -> bool {
        metadata.target().starts_with(env!("CARGO_CRATE_NAME"))
    }

    fn new_span(&self, span: &Attributes) -> Id {
        let mut state = self.state();
        state.names.push(span.metadata().name());
        Id::from_u64(state.names.len() as u64)
    }

    fn record(&self, _: &Id, _: &Record) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event) {
        let state = &mut *self.state();
        if let Some(span) = state.entered.first() {
            event.record(state.work.entry(span).or_default());
        }
    }

    fn enter(&self, id: &Id) {
        let mut state = self.state();
        if state.entered.is_empty() {
            state.start = Some(DeviceEvent::now(self.device));
        }
        let name = state.names[id.into_u64() as usize - 1];
        state.entered.push(name);
    }

    fn exit(&self, _: &Id) {
        let state = &mut *self.state();
        let name = state.entered.pop().expect("a span that was entered");
        if state.entered.is_empty()
            && let Some(start) = state.start.take()
        {
            state.watch.add_since(name, start);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing::{trace, trace_span};

    #[test]
    fn nested_spans_are_part_of_the_outer_span() {
        let record = |flops: i64| trace!(flops, backward_flops = 3, bytes = 30);
        let pass = || {
            record(7);
            trace_span!("outer").in_scope(|| {
                record(1);
                trace_span!("inner").in_scope(|| record(2));
            });
            trace_span!(target: "another_library", "other")
                .in_scope(|| trace!(target: "another_library", flops = 5));
            trace_span!("next").in_scope(|| 4)
        };
        let mut measured = Measured::default();
        assert_eq!(measured.record(Device::Cpu, || Ok(pass())).unwrap(), 4);
        let found: Vec<_> = measured
            .sections
            .iter()
            .map(|s| (s.name.as_str(), s.work.flops, s.work.backward_flops, s.work.bytes))
            .collect();
        assert_eq!(found, [("outer", 3., 6., 60.), ("next", 0., 0., 0.)]);
        // Nobody listens outside of `record`.
        assert_eq!(trace_span!("unrecorded").in_scope(|| 5), 5);
        assert_eq!(measured.sections.len(), 2);
    }
}
