//! The rendering loss's first half: ‖I − Î‖² per element (spec 7.2).

use tch::{Kind, Tensor};

/// Mean over all elements; a scalar.
pub fn mse(rendered: &Tensor, truth: &Tensor) -> Tensor {
    (rendered - truth).square().mean(None::<Kind>)
}

/// Errors below it count as it, so that equal pictures have a PSNR: 100 dB.
const MIN_MSE: f64 = 1e-10;

/// Peak signal-to-noise ratio in dB of pictures in [0, 1] that are off by `mse`; of NaN it is NaN.
pub fn psnr_of_mse(mse: f64) -> f64 {
    // f64::max would take NaN for the smallest error of all.
    let mse = if mse < MIN_MSE { MIN_MSE } else { mse };
    -10. * mse.log10()
}
