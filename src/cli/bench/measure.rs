//! Measurement of an operation: the times of its sections or spans over several runs, and the work recorded in them.

use crate::device::{DeviceEvent, Stopwatch};
use crate::error::Result;
use crate::model::Precision;
use serde::Serialize;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::fmt::Debug;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;
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
    pub name: Cow<'static, str>,
    pub milliseconds: TimingStats,
}

/// Times of an operation's sections in every run, in the order in which the sections first ran.
#[derive(Default)]
pub struct Measured {
    runs: usize,
    sections: Vec<Recorded>,
}

struct Recorded {
    name: Cow<'static, str>,
    milliseconds: Vec<f64>,
    /// Work of the first run. Every run does the same.
    work: Work,
}

impl Measured {
    /// Adds one run with these sections. A name that occurs several times counts with the sum of its times.
    pub fn add_run(&mut self, sections: impl IntoIterator<Item = (Cow<'static, str>, f64, Work)>) {
        self.runs += 1;
        for (name, milliseconds, work) in sections {
            let known = self.sections.iter().position(|section| section.name == name).unwrap_or_else(|| {
                self.sections.push(Recorded { name, milliseconds: vec![], work: Work::default() });
                self.sections.len() - 1
            });
            let section = &mut self.sections[known];
            section.milliseconds.resize(self.runs, 0.);
            section.milliseconds[self.runs - 1] += milliseconds;
            if self.runs == 1 {
                section.work.flops += work.flops;
                section.work.backward_flops += work.backward_flops;
                section.work.bytes += work.bytes;
            }
        }
    }

    /// Adds the sections that `watch` recorded as one run.
    pub fn add_watch(&mut self, watch: &mut Stopwatch) -> Result<()> {
        let sections = watch.sections()?.iter();
        self.add_run(
            sections.map(|(name, time)| ((*name).into(), 1e3 * time.as_secs_f64(), Work::default())),
        );
        Ok(())
    }

    /// Runs `pass` and adds its spans as one run, timed by the clock of `device`.
    ///
    /// # Errors
    /// Returns the error of `pass`, or an error if a GPU is missing or fails.
    pub fn record<T>(&mut self, device: Device, pass: impl FnOnce() -> Result<T>) -> Result<T> {
        let (result, spans) = record_spans(device, pass);
        let result = result?;
        let spans = spans
            .into_iter()
            .map(|span| Ok((span.name.into(), 1e3 * span.elapsed?.as_secs_f64(), span.work)));
        self.add_run(spans.collect::<Result<Vec<_>>>()?);
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

/// Two square matrices, multiplied in the same way as in the model's linear layers: the throughput that other products are compared with.
pub struct PeakThroughput {
    matrix: Tensor,
    layer: nn::Linear,
    precision: Precision,
}

impl PeakThroughput {
    /// Creates random matrices in `precision` on `device`, with sides of 2048 on the CPU and 8192 on a GPU.
    pub fn new(precision: Precision, device: Device) -> Self {
        let side = if device == Device::Cpu { 2048 } else { 8192 };
        let matrix = Tensor::randn([side, side], (Kind::Float, device)).to_kind(precision.kind());
        let layer = nn::Linear { ws: matrix.shallow_clone(), bs: None };
        PeakThroughput { matrix, layer, precision }
    }

    /// Returns the time of one product, in milliseconds.
    ///
    /// # Errors
    /// Returns an error if a GPU fails.
    pub fn time(&self) -> Result<f64> {
        let mut watch = Stopwatch::new(self.matrix.device());
        no_grad(|| watch.time("product", || drop(self.precision.linear(&self.layer, &self.matrix))));
        Ok(1e3 * watch.sections()?[0].1.as_secs_f64())
    }

    /// Returns the throughput in GFLOP/s of the fastest of some products, by their times in milliseconds.
    pub fn gflops(&self, milliseconds: Vec<f64>) -> f64 {
        2e-6 * (self.matrix.size()[0] as f64).powi(3) / TimingStats::from_milliseconds(milliseconds).min
    }
}

/// One execution of a span that isn't inside of another span.
struct RecordedSpan {
    name: &'static str,
    elapsed: Result<Duration>,
    /// Work of the span and of the spans inside.
    work: Work,
}

/// Runs `pass` and returns the spans of this library that it runs on this thread, in their order, timed by the clock of `device`.
fn record_spans<T>(device: Device, pass: impl FnOnce() -> T) -> (T, Vec<RecordedSpan>) {
    let recorder = Arc::new(SpanRecorder { device, state: Mutex::default() });
    let result = subscriber::with_default(recorder.clone(), pass);
    let spans = std::mem::take(&mut recorder.state().left);
    let finish = |(span, end): (EnteredSpan, Result<DeviceEvent>)| RecordedSpan {
        elapsed: span.start.and_then(|start| end?.since(&start)),
        name: span.name,
        work: span.work,
    };
    (result, spans.into_iter().map(finish).collect())
}

/// Subscriber that records the outermost spans of a thread.
struct SpanRecorder {
    device: Device,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Names of all spans. The number of a span's `Id` is its position here, plus 1.
    names: Vec<&'static str>,
    /// Number of spans that the thread is inside of.
    depth: usize,
    /// Outermost span that the thread is inside of.
    entered: Option<EnteredSpan>,
    /// Outermost spans that the thread has left, with their ends, which the device has perhaps not reached yet.
    left: Vec<(EnteredSpan, Result<DeviceEvent>)>,
}

struct EnteredSpan {
    name: &'static str,
    start: Result<DeviceEvent>,
    work: Work,
}

/// Sums of the fields of `record_flops` in the model.
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
        if let Some(span) = &mut self.state().entered {
            event.record(&mut span.work);
        }
    }

    fn enter(&self, id: &Id) {
        let mut state = self.state();
        state.depth += 1;
        if state.depth == 1 {
            let name = state.names[id.into_u64() as usize - 1];
            let start = DeviceEvent::now(self.device);
            state.entered = Some(EnteredSpan { name, start, work: Work::default() });
        }
    }

    fn exit(&self, _: &Id) {
        let end = DeviceEvent::now(self.device);
        let mut state = self.state();
        state.depth -= 1;
        if state.depth == 0
            && let Some(span) = state.entered.take()
        {
            state.left.push((span, end));
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
        let (result, spans) = record_spans(Device::Cpu, pass);
        assert_eq!(result, 4);
        let found: Vec<_> =
            spans.iter().map(|s| (s.name, s.work.flops, s.work.backward_flops, s.work.bytes)).collect();
        assert_eq!(found, [("outer", 3., 6., 60.), ("next", 0., 0., 0.)]);
        assert!(spans.iter().all(|span| span.elapsed.is_ok()));
        // Nobody listens outside of `record_spans`.
        assert_eq!(trace_span!("unrecorded").in_scope(|| 5), 5);
        assert_eq!(record_spans(Device::Cpu, || ()).1.len(), 0);
    }
}
