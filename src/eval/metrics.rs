//! Picture metrics (SPEC section 9), in float64 on values clamped to [0, 1].

use crate::loss::psnr_of_mse;
use tch::{Kind, Tensor};

/// SSIM's Gaussian window: 11×11, σ = 1.5.
const WINDOW: i64 = 11;
const SIGMA: f64 = 1.5;
/// (0.01 L)² and (0.03 L)² for the data range L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

fn prepare(picture: &Tensor) -> Tensor {
    picture.detach().to_device(tch::Device::Cpu).to_kind(Kind::Double).clamp(0., 1.)
}

/// Peak signal-to-noise ratio in dB of two pictures of one shape.
pub fn psnr(picture: &Tensor, truth: &Tensor) -> f64 {
    let mse = (prepare(picture) - prepare(truth)).square().mean(Kind::Double).double_value(&[]);
    psnr_of_mse(mse)
}

/// Structural similarity of two pictures [3, H, W], H and W at least 11: the mean over channels and over the pixels whose
/// window is inside, with sample covariances, as scikit-image's `structural_similarity` with Gaussian weights.
pub fn ssim(picture: &Tensor, truth: &Tensor) -> f64 {
    let (x, y) = (prepare(picture).unsqueeze(1), prepare(truth).unsqueeze(1)); // [3, 1, H, W]
    let offsets = Tensor::arange(WINDOW, (Kind::Double, x.device())) - ((WINDOW - 1) / 2) as f64;
    let weights = (offsets.square() / (-2. * SIGMA * SIGMA)).exp();
    let weights = &weights / weights.sum(Kind::Double);
    let blur = |t: &Tensor| {
        let column = weights.view([1, 1, WINDOW, 1]);
        let row = weights.view([1, 1, 1, WINDOW]);
        t.conv2d(&column, None::<&Tensor>, 1, 0, 1, 1).conv2d(&row, None::<&Tensor>, 1, 0, 1, 1)
    };
    let pixels = (WINDOW * WINDOW) as f64;
    let sample = pixels / (pixels - 1.);
    let (mx, my) = (blur(&x), blur(&y));
    let vx = (blur(&x.square()) - mx.square()) * sample;
    let vy = (blur(&y.square()) - my.square()) * sample;
    let vxy = (blur(&(&x * &y)) - &mx * &my) * sample;
    let numerator = (&mx * &my * 2. + C1) * (vxy * 2. + C2);
    let denominator = (mx.square() + my.square() + C1) * (vx + vy + C2);
    (numerator / denominator).mean(Kind::Double).double_value(&[])
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;

    #[test]
    fn a_known_error_has_a_known_psnr() {
        let a = Tensor::zeros([3, 16, 16], (Kind::Float, Device::Cpu));
        assert!((psnr(&(&a + 0.1), &a) - 20.).abs() < 1e-5);
        assert_eq!(psnr(&a, &a), 100.);
        assert!((psnr(&(&a - 3.), &(&a + 0.1)) - 20.).abs() < 1e-5); // clamped
        assert!(psnr(&(&a * f64::NAN), &a).is_nan());
    }

    #[test]
    fn equal_pictures_are_similar_and_noise_is_not() {
        let options = (Kind::Float, Device::Cpu);
        let a = Tensor::linspace(0., 1., 3 * 32 * 32, options).view([3, 32, 32]);
        assert!((ssim(&a, &a) - 1.).abs() < 1e-9);
        assert!(ssim(&(1. - &a), &a) < 0.5);
    }
}
