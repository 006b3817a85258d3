//! PSNR and SSIM of images (spec 9.4), in float64 on values clamped to [0, 1].

use crate::loss::{self, fill_masked, psnr_of_mse};
use tch::{Kind, Tensor};

/// Approximate number of pixels of a band of rows. Images are compared band by band, so that a large one is never held in float64 as a
/// whole.
const BAND_PIXELS: i64 = 1 << 20;
/// Side of the SSIM windows, in pixels.
pub(super) const SSIM_WINDOW: i64 = 11;
/// Weight of the squared numbers of a color map per pixel.
const RIDGE: f64 = 1e-9;
/// Number of rows that a band shares with the next one, so that every window lies inside a band.
const SSIM_OVERLAP: i64 = SSIM_WINDOW - 1;

/// Returns rows `first` to `first + count` of an image `[3, H, W]` or of a mask `[1, H, W]` in float64, clamped to [0, 1], on the CPU.
fn band(image: &Tensor, first: i64, count: i64) -> Tensor {
    let rows = image.detach().narrow(-2, first, count);
    rows.to_device(tch::Device::Cpu).to_kind(Kind::Double).clamp(0., 1.)
}

/// Returns (first row, number of rows) of every band of `rows` rows of `width` pixels.
fn bands(rows: i64, width: i64) -> impl Iterator<Item = (i64, i64)> {
    let height = (BAND_PIXELS / width.max(1)).max(1);
    (0..rows).step_by(height as usize).map(move |first| (first, height.min(rows - first)))
}

/// Returns the sum of squared differences of two images `[3, H, W]`, with values clamped to [0, 1], weighted by `mask` `[1, H, W]`.
pub(super) fn squared_error(image: &Tensor, ground_truth: &Tensor, mask: Option<&Tensor>) -> f64 {
    let size = image.size();
    let error = |(first, count)| {
        let error = (band(image, first, count) - band(ground_truth, first, count)).square();
        let error = match mask {
            Some(mask) => error * band(mask, first, count),
            None => error,
        };
        error.sum(Kind::Double).double_value(&[])
    };
    bands(size[1], size[2]).map(error).sum()
}

/// Returns the peak signal-to-noise ratio in dB of two images of the same shape, `[3, H, W]`.
pub fn psnr(image: &Tensor, ground_truth: &Tensor) -> f64 {
    masked_psnr(image, ground_truth, None)
}

/// Returns the peak signal-to-noise ratio in dB of two images of the same shape, `[3, H, W]`, over the pixels that count: their errors are
/// weighted by `mask` `[1, H, W]` (spec 7.9). NaN if no pixel counts.
pub fn masked_psnr(image: &Tensor, ground_truth: &Tensor, mask: Option<&Tensor>) -> f64 {
    let mean = squared_error(image, ground_truth, mask) / image.numel() as f64;
    psnr_of_mse(mean / mask.map_or(1., mean_weight))
}

/// Returns [`masked_psnr`] after the affine map of the image's colors that brings them closest to the photo's: the 3×4 matrix with the least
/// squared error over the pixels that count. It disregards differences of exposure and white balance (spec 9.4).
pub fn color_corrected_psnr(image: &Tensor, ground_truth: &Tensor, mask: Option<&Tensor>) -> f64 {
    let size = image.size();
    let products = |(first, count)| {
        let band = |t: &Tensor| band(t, first, count).flatten(1, 2);
        let image = band(image);
        let colors = Tensor::cat(&[&image, &image.narrow(0, 0, 1).ones_like()], 0);
        let weighted = mask.map_or_else(|| colors.shallow_clone(), |mask| &colors * band(mask));
        weighted.matmul(&Tensor::cat(&[&colors, &band(ground_truth)], 0).tr())
    };
    let sums = bands(size[1], size[2]).map(products).reduce(|a, b| a + b).expect("an image has rows");
    // The map of an image of few colors isn't unique.
    let ridge =
        Tensor::eye(4, (Kind::Double, tch::Device::Cpu)) * (RIDGE * sums.double_value(&[3, 3]).max(1.));
    let map = Tensor::linalg_solve(&(sums.narrow(1, 0, 4) + ridge), &sums.narrow(1, 4, 3), true);
    let map = map.tr().to_kind(Kind::Float);
    let colors = image.detach().to_device(tch::Device::Cpu).clamp(0., 1.).flatten(1, 2);
    let corrected = map.narrow(1, 0, 3).matmul(&colors) + map.narrow(1, 3, 1);
    masked_psnr(&corrected.view(size.as_slice()), ground_truth, mask)
}

/// Returns the structural similarity of two images `[3, H, W]` over the pixels that count by `mask` `[1, H, W]`, in [−1, 1] (spec 7.9): the
/// images are equal where they are masked out, and windows without a pixel that counts are left out of the mean. H and W are at least 11.
/// NaN if no pixel counts.
pub fn masked_ssim(image: &Tensor, ground_truth: &Tensor, mask: Option<&Tensor>) -> f64 {
    let size = image.size();
    // Number of rows of windows that lie inside the image.
    let rows = size[1] - SSIM_OVERLAP;
    let weighted = |(first, count)| {
        let band = |image| band(image, first, count + SSIM_OVERLAP);
        let (image, ground_truth) = (band(image), band(ground_truth));
        let image = match mask {
            Some(mask) => fill_masked(&image, &ground_truth, &band(mask)),
            None => image,
        };
        loss::ssim(&image, &ground_truth).double_value(&[]) * count as f64
    };
    let whole = bands(rows, size[2]).map(weighted).sum::<f64>() / rows as f64;
    mask.map_or(whole, |mask| 1. - (1. - whole) / fraction_of_windows(mask))
}

/// Returns the fraction of SSIM's windows that have a pixel that counts by `mask` `[1, H, W]`.
fn fraction_of_windows(mask: &Tensor) -> f64 {
    let counts = mask.gt(0.).to_kind(Kind::Float);
    let windows = [[SSIM_WINDOW, 1], [1, SSIM_WINDOW]]
        .into_iter()
        .fold(counts, |counts, window| counts.max_pool2d(window, [1, 1], [0, 0], [1, 1], false));
    windows.mean(Kind::Double).double_value(&[])
}

/// Returns the mean weight of a mask `[1, H, W]`, with values clamped to [0, 1].
pub(super) fn mean_weight(mask: &Tensor) -> f64 {
    let size = mask.size();
    let sum = |(first, count)| band(mask, first, count).sum(Kind::Double).double_value(&[]);
    bands(size[1], size[2]).map(sum).sum::<f64>() / mask.numel() as f64
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

    /// Half of the pixels are masked out, and their error is large; others have a weight of ½.
    #[test]
    fn masked_pixels_are_not_scored() {
        tch::manual_seed(1);
        let options = (Kind::Float, Device::Cpu);
        let (truth, mask) = (Tensor::rand([3, 32, 24], options) * 0.5, Tensor::ones([1, 32, 24], options));
        let image = &truth + 0.1;
        let _ = image.narrow(1, 0, 16).fill_(1.);
        let _ = mask.narrow(1, 0, 16).zero_();
        assert!((masked_psnr(&image, &truth, Some(&mask)) - 20.).abs() < 1e-5);
        // A quarter of the weight has an error of 0.2: (3 · 0.01 + 0.04) / 4.
        let _ = mask.narrow(1, 16, 8).fill_(1. / 3.);
        let _ = image.narrow(1, 16, 8).g_add_scalar_(0.1);
        let expected = -10. * (0.07f64 / 4.).log10();
        assert!((masked_psnr(&image, &truth, Some(&mask)) - expected).abs() < 1e-5);
        let ssim_of = |image: &Tensor| masked_ssim(image, &truth, Some(&mask));
        let (before, filled) = (ssim_of(&image), fill_masked(&image, &truth, &mask));
        // Of 22 rows of windows, the first 6 lie in the masked half.
        let expected = 1. - (1. - masked_ssim(&filled, &truth, None)) / (16. / 22.);
        assert!((before - expected).abs() < 1e-6, "{before}, expected {expected}");
        // A single pixel counts, and 121 windows see it.
        let [dark, light] = [0., 1.].map(|value| Tensor::full([3, 32, 24], value, options));
        let pixel = mask.zeros_like();
        let _ = pixel.narrow(1, 15, 1).narrow(2, 12, 1).fill_(1.);
        for mask in [pixel, mask.ones_like() * 0.1] {
            let similarity = masked_ssim(&dark, &light, Some(&mask));
            assert!((-1. ..1.).contains(&similarity), "{similarity}");
        }
        let _ = image.narrow(1, 0, 16).zero_();
        assert_eq!(ssim_of(&image), before);
        assert!((ssim_of(&truth) - 1.).abs() < 1e-9);
        let [all, plain] = [Some(&mask.ones_like()), None].map(|mask| masked_ssim(&image, &truth, mask));
        assert!((all - plain).abs() < 1e-12);
        assert!(masked_psnr(&image, &truth, Some(&mask.zeros_like())).is_nan());
    }

    /// A photo of another exposure, white balance and saturation is that photo after a color map; noise stays, and so does what is masked out.
    #[test]
    fn color_maps_are_corrected_where_pixels_count() {
        tch::manual_seed(1);
        let options = (Kind::Float, Device::Cpu);
        let (truth, mask) =
            (Tensor::rand([3, 32, 24], options) * 0.5 + 0.2, Tensor::ones([1, 32, 24], options));
        let mix = Tensor::from_slice(&[0.7f32, 0.1, 0., 0.05, 0.8, 0.1, 0., 0.1, 0.6]).view([3, 3]);
        let image = mix.matmul(&truth.flatten(1, 2)).view([3, 32, 24]) + 0.05;
        assert!(psnr(&image, &truth) < 25.);
        assert!(color_corrected_psnr(&image, &truth, None) > 90.);
        let _ = image.narrow(1, 0, 16).fill_(1.);
        let _ = mask.narrow(1, 0, 16).zero_();
        assert!(color_corrected_psnr(&image, &truth, None) < 20.);
        assert!(color_corrected_psnr(&image, &truth, Some(&mask)) > 90.);
        // Every map of one color gives its channels' means.
        let gray = Tensor::full([3, 32, 24], 0.3, options);
        let mean = truth.mean_dim([1i64, 2].as_slice(), true, Kind::Float).expand_as(&truth);
        assert!((color_corrected_psnr(&gray, &truth, None) - psnr(&mean, &truth)).abs() < 1e-3);
    }

    #[test]
    fn metrics_in_bands_match_those_of_whole_images() {
        tch::manual_seed(1);
        // Three bands, the last of them a single row.
        let height = 2 * BAND_PIXELS / 40_000 + 1;
        let image = |rows: i64| Tensor::rand([3, rows, 40_000], (Kind::Double, Device::Cpu));
        let (a, b) = (image(height + SSIM_OVERLAP), image(height + SSIM_OVERLAP));
        assert_eq!(bands(height, 40_000).count(), 3);
        let mse = (&a - &b).square().mean(Kind::Double).double_value(&[]);
        assert!((psnr(&a, &b) - psnr_of_mse(mse)).abs() < 1e-10);
        assert!((masked_ssim(&a, &b, None) - loss::ssim(&a, &b).double_value(&[])).abs() < 1e-12);
    }
}
