//! Recording of the `tracing` spans of a pass: the time that each takes on the device, and the work that is recorded in it.

use crate::device::DeviceEvent;
use crate::error::Result;
use std::fmt::Debug;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;
use tch::Device;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber, subscriber};

/// One execution of a span that isn't inside of another span.
#[derive(Debug)]
pub(super) struct RecordedSpan {
    pub name: &'static str,
    pub elapsed: Result<Duration>,
    /// Floating-point operations of matrix products, also in the spans inside.
    pub flops: f64,
    /// Floating-point operations of the backward pass of these products.
    pub backward_flops: f64,
    /// Bytes of the inputs and outputs of these products, and of norms and sums.
    pub bytes: f64,
}

/// Runs `pass` and returns the spans of this library that it runs on this thread, in their order, timed by the clock of `device`.
pub(super) fn record_spans<T>(device: Device, pass: impl FnOnce() -> T) -> (T, Vec<RecordedSpan>) {
    let recorder = Arc::new(SpanRecorder { device, state: Mutex::default() });
    let result = subscriber::with_default(recorder.clone(), pass);
    let spans = std::mem::take(&mut recorder.state().left);
    let finish = |(span, end): (EnteredSpan, Result<DeviceEvent>)| RecordedSpan {
        elapsed: span.start.and_then(|start| end?.since(&start)),
        name: span.name,
        flops: span.work.flops,
        backward_flops: span.work.backward_flops,
        bytes: span.work.bytes,
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
struct Work {
    flops: f64,
    backward_flops: f64,
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
        let found: Vec<_> = spans.iter().map(|s| (s.name, s.flops, s.backward_flops, s.bytes)).collect();
        assert_eq!(found, [("outer", 3., 6., 60.), ("next", 0., 0., 0.)]);
        assert!(spans.iter().all(|span| span.elapsed.is_ok()));
        // Nobody listens outside of `record_spans`.
        assert_eq!(trace_span!("unrecorded").in_scope(|| 5), 5);
        assert_eq!(record_spans(Device::Cpu, || ()).1.len(), 0);
    }
}
