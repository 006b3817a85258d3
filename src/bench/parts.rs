//! Parts of a model's pass: the time, the floating-point operations and the memory traffic of each.

use super::TimingStats;
use crate::device::DeviceEvent;
use crate::model::{Event, told};
use serde::Serialize;
use std::cell::RefCell;
use std::rc::Rc;
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

/// One execution of a part in one pass.
struct Piece {
    name: &'static str,
    begins: DeviceEvent,
    ends: Option<DeviceEvent>,
    flops: f64,
    backward_flops: f64,
    bytes: f64,
}

/// Statistics of the parts over all watched passes.
#[derive(Default)]
pub(super) struct Parts {
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

impl Parts {
    /// Runs `pass` and adds the statistics of its parts, timed by the clock of `device`.
    pub fn watch<T>(&mut self, device: Device, pass: impl FnOnce() -> T) -> T {
        let pieces = Rc::new(RefCell::new(Vec::<Piece>::new()));
        let heard = pieces.clone();
        let listener = move |event| {
            let mut pieces = heard.borrow_mut();
            match (event, pieces.last_mut()) {
                (Event::Begins(name), _) => {
                    let begins = DeviceEvent::now(device);
                    pieces.push(Piece { name, begins, ends: None, flops: 0., backward_flops: 0., bytes: 0. });
                }
                (Event::Ends, Some(piece)) => piece.ends = Some(DeviceEvent::now(device)),
                (Event::Flops { flops, backward_flops, bytes }, Some(piece)) => {
                    piece.flops += flops;
                    piece.backward_flops += backward_flops;
                    piece.bytes += bytes;
                }
                (_, None) => unreachable!("a part begins before all else"),
            }
        };
        let result = told(listener, pass);
        let mut sums: Vec<Sum> = vec![];
        for piece in pieces.take() {
            let elapsed = piece.ends.expect("a part that is over").since(&piece.begins);
            let known = sums.iter().position(|sum| sum.name == piece.name).unwrap_or_else(|| {
                sums.push(Sum { name: piece.name, milliseconds: vec![0.], ..Default::default() });
                sums.len() - 1
            });
            sums[known].milliseconds[0] += 1e3 * elapsed.as_secs_f64();
            sums[known].flops += piece.flops;
            sums[known].backward_flops += piece.backward_flops;
            sums[known].bytes += piece.bytes;
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
        result
    }

    /// Returns the statistics. `peak_gflops` is the throughput of a product of large matrices, which [`Part::share_of_peak`] refers to.
    pub fn told(self, peak_gflops: f64) -> Vec<Part> {
        let part = |sum: Sum| {
            let milliseconds = TimingStats::from_milliseconds(sum.milliseconds);
            let share_of_peak = 1e-6 * sum.flops / milliseconds.least / peak_gflops;
            let [gflop, backward_gflop, gigabytes] =
                [sum.flops, sum.backward_flops, sum.bytes].map(|of| 1e-9 * of);
            Part { name: sum.name, milliseconds, gflop, backward_gflop, gigabytes, share_of_peak }
        };
        self.parts.into_iter().map(part).collect()
    }
}
