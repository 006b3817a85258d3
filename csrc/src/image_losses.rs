//! Losses of rendered images and depths compared to photos. Tensors are passed as addresses of `at::Tensor`, which is tch's `C_tensor`.

pub use ffi::*;

// Clippy doesn't see the safety sections inside of a bridge.
#[allow(clippy::missing_safety_doc)]
#[cxx::bridge(namespace = "globalsplat")]
mod ffi {
    unsafe extern "C++" {
        include!("image_losses.h");

        /// Computes the photometric loss; see `csrc/image_losses.h`.
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

        /// Computes the depth smoothness loss; see `csrc/image_losses.h`.
        ///
        /// # Safety
        /// `depths` and `photos` must be addresses of live tensors.
        unsafe fn depth_smoothness(
            depths: usize,
            photos: usize,
            factor: f64,
            out: &mut [usize],
        ) -> Result<()>;
    }
}
