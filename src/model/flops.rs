//! Numbers of floating-point operations and bytes, recorded in the `tracing` spans of a pass.

use tch::Tensor;
use tracing::trace;

/// Records work in the current span, as a `tracing` event: `flops` floating-point operations of matrix products in the forward pass,
/// `backward_flops` in the backward pass (0 if no gradient is needed), and the `bytes` of `tensors`, the inputs and outputs.
pub(super) fn record_flops(flops: i64, backward_flops: i64, tensors: &[&Tensor]) {
    trace!(flops, backward_flops, bytes = bytes(tensors));
}

fn bytes(tensors: &[&Tensor]) -> i64 {
    tensors.iter().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum::<usize>() as i64
}
