//! Masks of photos in losses and scores (spec 7.9): a pixel that is masked out contributes nothing, and has no gradient.

use tch::{Kind, Tensor};

/// Minimum mean weight, so that the loss of photos without any pixel that counts is finite.
pub(super) const MIN_WEIGHT: f64 = 1e-6;

/// Returns w · `image` + (1 − w) · `photo` for the weights w of `mask`: the photo's own pixels where it is masked out, so that no difference
/// is seen there, either by windows that overlap the edge of the mask. Images are [.., C, H, W], of the kind of `image` in the result;
/// masks are [.., 1, H, W]. The result is exactly `image` where w = 1, and exactly `photo` where w = 0. Differentiable with respect to
/// `image`, with a gradient of exactly 0 where w = 0.
pub fn fill_masked(image: &Tensor, photo: &Tensor, mask: &Tensor) -> Tensor {
    photo.to_kind(image.kind()).lerp_tensor(image, &mask.to_kind(image.kind()))
}

/// Returns the mean weight of `mask`, a scalar above 0 that means over all pixels are divided by.
pub fn mean_weight(mask: &Tensor) -> Tensor {
    mask.mean(None::<Kind>).clamp_min(MIN_WEIGHT)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::{
        masked_depth_smoothness, masked_mse, masked_photometric,
    };
    use tch::Device;

    /// Returns images [2, 3, 24, 20] with a value of NaN-free noise, and a mask whose left half is 0, with a column of 0.25.
    fn masked_images(kind: Kind) -> (Tensor, Tensor, Tensor) {
        tch::manual_seed(5);
        let image = || Tensor::rand([2, 3, 24, 20], (kind, Device::Cpu));
        let mask = Tensor::ones([2, 1, 24, 20], (kind, Device::Cpu));
        let _ = mask.narrow(3, 0, 10).zero_();
        let _ = mask.narrow(3, 10, 1).fill_(0.25);
        (image(), image(), mask)
    }

    type MaskedLoss<'a> = &'a dyn Fn(&Tensor, &Tensor, &Tensor) -> Tensor;

    /// No loss depends on masked pixels of the rendered image, or has a gradient there, and every loss has one at the others.
    #[test]
    fn masked_pixels_have_no_gradient() {
        let depth = |image: &Tensor| image.select(1, 0);
        let losses: [(&str, MaskedLoss); 4] = [
            ("mse", &masked_mse),
            ("l1", &|image, photo, mask| masked_photometric(image, photo, mask, 1., 0.)),
            ("ssim", &|image, photo, mask| masked_photometric(image, photo, mask, 0., 1.)),
            ("smoothness", &|image, photo, mask| {
                masked_depth_smoothness(&depth(image), photo, &depth(mask), 1.)
            }),
        ];
        for (name, loss) in losses {
            let (image, photo, mask) = masked_images(Kind::Float);
            let run = |image: &Tensor| {
                let image = image.detach().set_requires_grad(true);
                let value = loss(&image, &photo, &mask);
                value.backward();
                (value.double_value(&[]), image.grad())
            };
            let (value, gradient) = run(&image);
            let masked = gradient.narrow(3, 0, 10).abs().max().double_value(&[]);
            assert_eq!(masked, 0., "{name}");
            let others = gradient.narrow(3, 12, 8).abs().max().double_value(&[]);
            assert!(others > 0., "{name}");
            let changed = image.copy();
            let _ = changed.narrow(3, 0, 10).fill_(7.);
            assert_eq!(run(&changed).0, value, "{name}");
        }
    }
}
