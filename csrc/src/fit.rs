//! What fitting pictures to photos needs beside drawing them. Tensors cross the border as addresses of `at::Tensor`, which is what
//! tch's `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// A step of Adam on one tensor. Tensors are addresses of at::Tensor (tch's C_tensor) that the call borrows.
    struct AdamArguments {
        /// What is updated.
        value: usize,
        /// Its gradient.
        gradient: usize,
        /// Running mean of the gradient.
        first: usize,
        /// Running mean of its square.
        second: usize,
        /// The learning rate over 1 − β₁ᵗ.
        rate: f64,
        /// √(1 − β₂ᵗ).
        root: f64,
        /// Of the value, taken away.
        decay: f64,
        /// How much of `first` stays.
        beta1: f64,
        /// How much of `second` stays.
        beta2: f64,
        /// Added to the root of `second`.
        epsilon: f64,
    }

    unsafe extern "C++" {
        include!("fit.h");

        /// See `csrc/fit.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn photometric(
            picture: usize,
            photo: usize,
            absolute: f64,
            similar: f64,
            out: &mut [usize],
        ) -> Result<()>;

        /// See `csrc/fit.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn depth_smoothness(
            depths: usize,
            photos: usize,
            factor: f64,
            out: &mut [usize],
        ) -> Result<()>;

        /// See `csrc/fit.h`.
        ///
        /// # Safety
        /// The arguments hold addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn adam(of: &AdamArguments) -> Result<()>;
    }
}
