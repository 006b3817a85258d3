//! The ops on tensors besides the rasterizer: attention, linear layers, image losses, depth search, optimizers. Tensors are passed as addresses
//! of `at::Tensor`, which is tch's `C_tensor`.
//!
//! # Safety
//! Every unsafe function requires that all addresses are those of live tensors, or 0 for an optional one. Nothing else may read or write the
//! tensors that an optimizer updates meanwhile.

pub use ffi::*;

// The safety section of the module holds for all functions.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// Photo that is compared with the one whose depths are searched.
    struct PhotoToCompare {
        /// Address of the gray values, [h, w].
        gray: usize,
        /// Address of the weights of the pixels, [h, w]; 0 if every pixel counts.
        weight: usize,
        /// Matrix of three rows that maps (column, row, 1, inverse depth) of the photo whose depths are searched to (column · z, row · z, z)
        /// of this one, row by row.
        to_pixels: [f32; 12],
    }

    /// Parameters of an AdamW step that all tensors share.
    struct AdamWOptions {
        /// Number of this step, counted from 1.
        steps: i64,
        /// Learning rate: about the size of the step.
        learning_rate: f64,
        /// Weight decay: the fraction of the value that is subtracted, times the learning rate.
        weight_decay: f64,
        /// Decay rate of the first moment.
        beta1: f64,
        /// Decay rate of the second moment.
        beta2: f64,
        /// Constant added to the square root of the second moment.
        epsilon: f64,
    }

    /// Parameters of a Muon step that all matrices share.
    struct MuonOptions {
        /// Number of equally high matrices stacked vertically in each tensor.
        parts: i64,
        /// Learning rate: about the size of the step.
        learning_rate: f64,
        /// Weight decay: the fraction of the value that is subtracted, times the learning rate.
        weight_decay: f64,
        /// Decay rate of the running mean of the gradient.
        beta: f64,
    }

    /// Arguments of a step of Adam on one tensor. Tensors are addresses of `at::Tensor` (tch's `C_tensor`) that the call borrows.
    struct AdamArguments {
        /// Tensor to update.
        value: usize,
        /// Gradient of the value.
        gradient: usize,
        /// Running mean of the gradient.
        first: usize,
        /// Running mean of the squared gradient.
        second: usize,
        /// Learning rate divided by 1 − β₁ᵗ.
        step_size: f64,
        /// Bias correction of the second moment, √(1 − β₂ᵗ).
        bias_correction2_sqrt: f64,
        /// Fraction of the value that is subtracted.
        decay: f64,
        /// Decay rate of `first`.
        beta1: f64,
        /// Decay rate of `second`.
        beta2: f64,
        /// Constant added to the square root of `second`.
        epsilon: f64,
    }

    unsafe extern "C++" {
        include!("tensor_ops.h");

        /// Returns `true` if `attention` supports heads of this width and kind; see `csrc/tensor_ops.h`.
        fn supports_attention(width: i64, is_bf16: bool) -> Result<bool>;

        /// Computes attention; see `csrc/tensor_ops.h`.
        unsafe fn attention(q: usize, k: usize, v: usize, heads: i64) -> Result<usize>;

        /// Applies a linear layer; see `csrc/tensor_ops.h`.
        unsafe fn linear(xs: usize, weights: usize, bias: usize) -> Result<usize>;

        /// Computes the photometric loss; see `csrc/tensor_ops.h`.
        unsafe fn photometric(
            picture: usize,
            photo: usize,
            l1_weight: f64,
            ssim_weight: f64,
        ) -> Result<usize>;

        /// Computes the depth smoothness loss; see `csrc/tensor_ops.h`.
        unsafe fn depth_smoothness(depths: usize, photos: usize, factor: f64) -> Result<usize>;

        /// Searches for the depths of a photo; see `csrc/tensor_ops.h`.
        unsafe fn search_depths(
            gray: usize,
            weight: usize,
            others: &[PhotoToCompare],
            step: f32,
            planes: i32,
            semi_global: bool,
        ) -> Result<Vec<usize>>;

        /// Computes the norm of all elements of all tensors; see `csrc/tensor_ops.h`.
        unsafe fn norm(tensors: &[usize]) -> Result<usize>;

        /// Multiplies tensors by `factor` in place; see `csrc/tensor_ops.h`.
        unsafe fn scale(tensors: &[usize], factor: f64) -> Result<()>;

        /// Resets gradients to undefined; see `csrc/tensor_ops.h`.
        unsafe fn zero_grad(tensors: &[usize]) -> Result<()>;

        /// Runs a step of AdamW; see `csrc/tensor_ops.h`.
        unsafe fn fused_adamw(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            second: &[usize],
            of: &AdamWOptions,
        ) -> Result<()>;

        /// Runs a step of Muon; see `csrc/tensor_ops.h`.
        unsafe fn muon(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            of: &MuonOptions,
        ) -> Result<()>;

        /// Runs a step of Adam; see `csrc/tensor_ops.h`.
        unsafe fn adam(of: &AdamArguments) -> Result<()>;
    }
}
