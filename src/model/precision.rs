//! Precision of matrix products (spec 1.3), and the products themselves, which record their floating-point operations.

use crate::ffi::take_tensor;
use globalsplat_csrc::runtime::{Bf16Support, cpu_bf16_support, gpu_has_bf16};
use globalsplat_csrc::tensor_ops::linear;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use tch::nn::Module;
use tch::{Device, Kind, Tensor, nn};
use tracing::{Span, trace};

/// Precision of the encoder's linear layers and attention, of the decoder's appearance head, and of the network of L_perc. Everything else
/// is always float32: weights and their gradients, norms, the mean value, accumulation within softmax and products, residual
/// streams; tokens and geometry heads, whose products are few and which determine positions; geometry and rendering; the differences of
/// features.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// float32, with 24 bits of mantissa.
    #[default]
    F32,
    /// bfloat16, with 8 bits of mantissa, as with torch's autocast: faster if the machine has instructions for it (AMX, tensor cores).
    Bf16,
}

impl Precision {
    /// Returns bf16 if `device` has instructions for bf16 products, and float32 otherwise.
    pub fn fastest_on(device: Device) -> Self {
        let has_bf16 = match device {
            Device::Cpu => cpu_bf16_support() != Bf16Support::None,
            Device::Cuda(_) => gpu_has_bf16(),
            _ => false,
        };
        if has_bf16 { Precision::Bf16 } else { Precision::F32 }
    }

    /// Returns the best precision for tokens of `width` elements: the fastest on `device` if the products are as large as the main model's,
    /// and float32 otherwise. Smaller models are fast anyway and read many small patches: the model that comes with the program loses a
    /// tenth of a dB in bf16.
    pub fn best_on(device: Device, width: i64) -> Self {
        const WIDE: i64 = 256;
        if width >= WIDE { Precision::fastest_on(device) } else { Precision::F32 }
    }

    /// Returns the kind of the operands of products.
    pub fn kind(self) -> Kind {
        match self {
            Precision::F32 => Kind::Float,
            Precision::Bf16 => Kind::BFloat16,
        }
    }

    /// Converts `t` to the kind of the operands of products.
    pub(super) fn operand(self, t: &Tensor) -> Tensor {
        match self {
            Precision::F32 => t.shallow_clone(),
            Precision::Bf16 => t.to_kind(self.kind()),
        }
    }

    /// Applies `layer` to `xs`. In bf16 the result is bf16, whatever the kind of `xs`.
    pub(crate) fn linear(self, layer: &nn::Linear, xs: &Tensor) -> Tensor {
        let bias = layer.bs.as_ref().map(|bias| self.operand(bias));
        product(&self.operand(xs), &self.operand(&layer.ws), bias.as_ref())
    }
}

/// Computes `xs` [.., k] · `weights`ᵀ [k, n] + `bias` [n]; on the CPU with the same bits for any number of threads.
fn product(xs: &Tensor, weights: &Tensor, bias: Option<&Tensor>) -> Tensor {
    let is_ours =
        xs.device() == Device::Cpu && xs.numel() > 0 && matches!(xs.kind(), Kind::Float | Kind::BFloat16);
    let out = match is_ours {
        true => {
            let address = |t: &Tensor| t.as_ptr() as usize;
            // SAFETY: the tensors outlive the call, which returns the address of a new one.
            let out = unsafe { linear(address(xs), address(weights), bias.map_or(0, address)) };
            unsafe { take_tensor(out.unwrap_or_else(|error| panic!("{error}"))) }
        }
        false => xs.linear(weights, bias),
    };
    let flops = 2 * (xs.numel() as i64) * weights.size()[0];
    record_work(flops, backward_flops(flops, [xs, weights], &out), &[xs, weights, &out]);
    out
}

/// Returns the backward operations of a product that takes `flops` operations forward: `flops` for each factor that needs a gradient, and 0
/// if `out` doesn't.
fn backward_flops(flops: i64, both: [&Tensor; 2], out: &Tensor) -> i64 {
    match out.requires_grad() {
        true => flops * both.iter().filter(|t| t.requires_grad()).count() as i64,
        false => 0,
    }
}

/// Records work in the current `tracing` span: `flops` floating-point operations of matrix products in the forward pass, `backward_flops` in
/// the backward pass (0 if no gradient is needed), and the bytes of `tensors`, the inputs and outputs.
pub(super) fn record_work(flops: i64, backward_flops: i64, tensors: &[&Tensor]) {
    let bytes = |t: &&Tensor| t.numel() * t.kind().elt_size_in_bytes();
    trace!(flops, backward_flops, bytes = tensors.iter().map(bytes).sum::<usize>() as i64);
}

/// Runs `op`, which has no matrix products, in `span`, and records the bytes of its inputs and of its output there.
pub(super) fn record_op(span: Span, inputs: &[&Tensor], op: impl FnOnce() -> Tensor) -> Tensor {
    span.in_scope(|| {
        let out = op();
        record_work(0, 0, inputs);
        record_work(0, 0, &[&out]);
        out
    })
}

/// Returns the ReLU of `layer` applied to `images`, [B, C, H, W].
pub(crate) fn convolve(layer: &nn::Conv2D, images: &Tensor) -> Tensor {
    let out = layer.forward(images).relu_();
    let flops = 2 * (out.numel() * layer.ws.numel()) as i64 / layer.ws.size()[0];
    record_work(flops, backward_flops(flops, [images, &layer.ws], &out), &[images, &layer.ws, &out]);
    out
}

/// Methods for convolutional networks without trainable weights.
impl Precision {
    /// Converts images [B, C, H, W] or kernels [O, I, k, k] for convolutions. In bf16 they become channels-last, the layout of tensor
    /// cores, and so are the results. In float32 the tensor is returned unchanged.
    pub(crate) fn images(self, xs: &Tensor) -> Tensor {
        match self {
            Precision::F32 => xs.shallow_clone(),
            Precision::Bf16 => {
                let channels_last = xs.to_kind(Kind::BFloat16).permute([0, 2, 3, 1]).contiguous();
                channels_last.permute([0, 3, 1, 2])
            }
        }
    }

    /// Converts a float32 layer, once, so that it takes the output of [`Precision::images`].
    pub(crate) fn convert(self, layer: &mut nn::Conv2D) {
        layer.ws = self.images(&layer.ws);
        if self == Precision::Bf16 {
            layer.bs = layer.bs.as_ref().map(|bias| bias.to_kind(Kind::BFloat16));
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Precision::F32 => "f32",
            Precision::Bf16 => "bf16",
        })
    }
}

impl FromStr for Precision {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "f32" => Ok(Precision::F32),
            "bf16" => Ok(Precision::Bf16),
            _ => Err(format!("{text} is no precision, expected f32 or bf16")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::num_threads;
    use tch::no_grad;

    /// Products have the same bits for any number of threads. The shapes have few and many rows and columns, in whole and partial blocks,
    /// because libraries split sums depending on each.
    #[test]
    fn products_have_the_same_bits_for_any_number_of_threads() {
        let _guard = num_threads::lock_exclusive();
        let numbers = |count: i64, phase: f64| {
            (Tensor::arange(count, (Kind::Double, Device::Cpu)).square() + phase).sin().to_kind(Kind::Float)
        };
        let threads = tch::get_num_threads();
        for [m, k, n] in [
            [1, 128, 128],
            [6, 12, 128],
            [256, 64, 64],
            [260, 1024, 256],
            [384, 128, 59],
            [100, 768, 1100],
            [2056, 512, 130],
            [4100, 192, 128],
        ] {
            for kind in [Kind::Float, Kind::BFloat16] {
                let xs = numbers(m * k, 0.).view([m, k]).to_kind(kind);
                let [weights, bias] =
                    [numbers(n * k, 1.).view([n, k]), numbers(n, 2.)].map(|t| t.to_kind(kind));
                let multiply = || no_grad(|| product(&xs, &weights, Some(&bias)));
                let expected = multiply();
                for count in [1, 2, 3, 7, 16] {
                    tch::set_num_threads(count);
                    assert!(
                        multiply().equal(&expected),
                        "[{m}, {k}] × [{k}, {n}], {kind:?}, {count} threads"
                    );
                }
                tch::set_num_threads(threads);
            }
        }
    }
}
