//! What the machine can do at best: a product of large square matrices, which all other products are measured by.

use crate::model::Precision;
use crate::optim::Stopwatch;
use tch::{Device, Kind, Tensor, nn, no_grad};

/// Two matrices to multiply, as the model's layers multiply theirs.
pub(super) struct Yardstick {
    matrix: Tensor,
    layer: nn::Linear,
    precision: Precision,
}

impl Yardstick {
    /// Of numbers in that precision, on that device.
    pub fn new(precision: Precision, device: Device) -> Self {
        let side = if device == Device::Cpu { 2048 } else { 8192 };
        let matrix = Tensor::randn([side, side], (Kind::Float, device)).to_kind(precision.kind());
        let layer = nn::Linear { ws: matrix.shallow_clone(), bs: None };
        Yardstick { matrix, layer, precision }
    }

    /// Milliseconds of one product.
    pub fn time(&self) -> f64 {
        let mut watch = Stopwatch::of(self.matrix.device());
        no_grad(|| watch.time("product", || drop(self.precision.linear(&self.layer, &self.matrix))));
        1e3 * watch.sections()[0].1.as_secs_f64()
    }

    /// 10⁹ floating-point operations a second of a product that takes so long.
    pub fn gflops(&self, milliseconds: f64) -> f64 {
        2e-6 * (self.matrix.size()[0] as f64).powi(3) / milliseconds
    }
}
