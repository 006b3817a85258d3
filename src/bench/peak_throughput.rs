//! Peak throughput of a device: a product of large square matrices, which all other products are compared with.

use crate::device::Stopwatch;
use crate::error::Result;
use crate::model::Precision;
use tch::{Device, Kind, Tensor, nn, no_grad};

/// Two square matrices, multiplied in the same way as in the model's linear layers.
pub(super) struct PeakThroughput {
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

    /// Returns the throughput in GFLOP/s of a product that takes `milliseconds`.
    pub fn gflops(&self, milliseconds: f64) -> f64 {
        2e-6 * (self.matrix.size()[0] as f64).powi(3) / milliseconds
    }
}
