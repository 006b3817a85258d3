//! What an optimizer does to all of its tensors at once. Tensors cross the border as addresses of `at::Tensor`, which is what tch's
//! `C_tensor` is.

pub use ffi::*;

// Clippy doesn't see the sections on safety inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    /// What a step of AdamW does to all of its tensors alike.
    struct AdamWNumbers {
        /// This one counted, from 1.
        steps: i64,
        /// How far it goes, about.
        learning_rate: f64,
        /// Of the value, taken away, times the learning rate.
        weight_decay: f64,
        /// How much of the first moment stays.
        beta1: f64,
        /// How much of the second moment stays.
        beta2: f64,
        /// Added to the root of the second moment.
        epsilon: f64,
    }

    /// What a step of Muon does to all of its matrices alike.
    struct MuonNumbers {
        /// So many lie on one another in each, of the same height.
        parts: i64,
        /// How far it goes, about.
        learning_rate: f64,
        /// Of the value, taken away, times the learning rate.
        weight_decay: f64,
        /// How much of the running mean stays.
        beta: f64,
    }

    unsafe extern "C++" {
        include!("optim.h");

        /// See `csrc/optim.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn norm(tensors: &[usize], out: &mut [usize]) -> Result<()>;

        /// See `csrc/optim.h`.
        ///
        /// # Safety
        /// Addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn scale(tensors: &[usize], factor: f64) -> Result<()>;

        /// See `csrc/optim.h`.
        ///
        /// # Safety
        /// Addresses of live tensors.
        unsafe fn forget_gradients(tensors: &[usize]) -> Result<()>;

        /// See `csrc/optim.h`.
        ///
        /// # Safety
        /// Addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn fused_adamw(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            second: &[usize],
            of: &AdamWNumbers,
        ) -> Result<()>;

        /// See `csrc/optim.h`.
        ///
        /// # Safety
        /// Addresses of live tensors that nothing else reads or writes meanwhile.
        unsafe fn muon(
            values: &[usize],
            gradients: &[usize],
            first: &[usize],
            of: &MuonNumbers,
        ) -> Result<()>;
    }
}
