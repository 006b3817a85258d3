//! Optimizer steps on many tensors at once, or on one. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
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
        include!("optim.h");

        /// Computes the norm of all elements of all tensors; see `csrc/optim.h`.
        ///
        /// # Safety
        /// `tensors` must be addresses of live tensors.
        unsafe fn norm(tensors: &[usize], out: &mut [usize]) -> Result<()>;

        /// Multiplies tensors by `factor` in place; see `csrc/optim.h`.
        ///
        /// # Safety
        /// `tensors` must be addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn scale(tensors: &[usize], factor: f64) -> Result<()>;

        /// Resets gradients to undefined; see `csrc/optim.h`.
        ///
        /// # Safety
        /// `tensors` must be addresses of live tensors.
        unsafe fn zero_grad(tensors: &[usize]) -> Result<()>;

        /// Runs a step of AdamW; see `csrc/optim.h`.
        ///
        /// # Safety
        /// All addresses must be those of live tensors that nothing else reads or writes meanwhile.
        unsafe fn fused_adamw(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            second: &[usize],
            of: &AdamWOptions,
        ) -> Result<()>;

        /// Runs a step of Muon; see `csrc/optim.h`.
        ///
        /// # Safety
        /// All addresses must be those of live tensors that nothing else reads or writes meanwhile.
        unsafe fn muon(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            of: &MuonOptions,
        ) -> Result<()>;

        /// Runs a step of Adam; see `csrc/optim.h`.
        ///
        /// # Safety
        /// The arguments must hold addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn adam(of: &AdamArguments) -> Result<()>;
    }
}
