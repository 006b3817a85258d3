//! Losses and optimizer steps that fit rendered images to photos. Tensors are passed as addresses of `at::Tensor`, which is tch's
//! `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
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
        rate: f64,
        /// Bias correction of the second moment, √(1 − β₂ᵗ).
        root: f64,
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
        include!("fit.h");

        /// Computes the photometric loss; see `csrc/fit.h`.
        ///
        /// # Safety
        /// `picture` and `photo` must be addresses of live tensors.
        unsafe fn photometric(
            picture: usize,
            photo: usize,
            l1_weight: f64,
            ssim_weight: f64,
            out: &mut [usize],
        ) -> Result<()>;

        /// Computes the depth smoothness loss; see `csrc/fit.h`.
        ///
        /// # Safety
        /// `depths` and `photos` must be addresses of live tensors.
        unsafe fn depth_smoothness(
            depths: usize,
            photos: usize,
            factor: f64,
            out: &mut [usize],
        ) -> Result<()>;

        /// Runs a step of Adam; see `csrc/fit.h`.
        ///
        /// # Safety
        /// The arguments must hold addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn adam(of: &AdamArguments) -> Result<()>;
    }
}
