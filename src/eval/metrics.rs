//! Picture metrics (spec 9.4), in float64 on values clamped to [0, 1].

use crate::loss::{self, psnr_of_mse};
use tch::{Kind, Tensor};

fn prepare(picture: &Tensor) -> Tensor {
    picture.detach().to_device(tch::Device::Cpu).to_kind(Kind::Double).clamp(0., 1.)
}

/// Peak signal-to-noise ratio in dB of two pictures of one shape.
pub fn psnr(picture: &Tensor, truth: &Tensor) -> f64 {
    let mse = (prepare(picture) - prepare(truth)).square().mean(Kind::Double).double_value(&[]);
    psnr_of_mse(mse)
}

/// Structural similarity of two pictures [3, H, W], H and W at least 11.
pub fn ssim(picture: &Tensor, truth: &Tensor) -> f64 {
    loss::ssim(&prepare(picture), &prepare(truth)).double_value(&[])
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
