//! Terms of the loss that need no network, and their variants for photos with masks.

use crate::data::ViewBatch;
use crate::ffi::take_tensor;
use crate::model::{MAX_SCALE, RawOutputs};
use globalsplat_csrc::tensor_ops;
use tch::{Kind, Tensor};

// L_mse: ‖I − Î‖² per element (spec 7.2).

/// Computes the mean squared error over all elements; a scalar.
pub fn mse(rendered: &Tensor, ground_truth: &Tensor) -> Tensor {
    (rendered - ground_truth).square().mean(None::<Kind>)
}

/// Computes the mean squared error weighted by `mask` [.., 1, H, W], over all elements of images [.., C, H, W] (spec 7.9); a scalar.
pub fn masked_mse(rendered: &Tensor, ground_truth: &Tensor, mask: &Tensor) -> Tensor {
    ((rendered - ground_truth).square() * mask).mean(None::<Kind>) / mean_weight(mask)
}

/// Minimum error in [`psnr_of_mse`], so that equal images have a finite PSNR: 100 dB.
const MIN_MSE: f64 = 1e-10;

/// Computes the peak signal-to-noise ratio in dB of images in [0, 1] from their mean squared error. NaN gives NaN.
pub fn psnr_of_mse(mse: f64) -> f64 {
    // f64::max would replace NaN by the minimum.
    let mse = if mse < MIN_MSE { MIN_MSE } else { mse };
    -10. * mse.log10()
}

// Absolute differences and structural similarity (SSIM, Wang et al. 2004), computed as by scikit-image's `structural_similarity` with
// Gaussian weights (spec 9.4).

/// Computes `l1_weight` times the mean absolute difference plus `ssim_weight` times the mean SSIM. Both are means over images and channels;
/// the first is over all pixels, the second over pixels whose 11×11 window lies inside the image. The result is a scalar, differentiable
/// with respect to `image`; on the CPU, forward and backward take one pass each. Images are [.., C, H, W] in [0, 1] and of the same shape, H
/// and W at least 11; float64 if `image` is, and float32 otherwise.
///
/// With a `mask` [.., 1, H, W], only the pixels that count do (spec 7.9): the absolute difference is weighted, and the mean SSIM is
/// 1 − (1 − SSIM) / mean weight, where SSIM compares images that are equal where they are masked out.
///
/// # Panics
/// Panics if the shapes differ or the images are smaller.
pub fn photometric(
    image: &Tensor,
    ground_truth: &Tensor,
    mask: Option<&Tensor>,
    l1_weight: f64,
    ssim_weight: f64,
) -> Tensor {
    let filled = mask.map(|mask| fill_masked(image, ground_truth, mask));
    let addresses = [filled.as_ref().unwrap_or(image), ground_truth].map(|t| t.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, which returns the address of a new one.
    let loss = unsafe { tensor_ops::photometric(addresses[0], addresses[1], l1_weight, ssim_weight) };
    let loss = unsafe { take_tensor(loss.unwrap_or_else(|error| panic!("{error}"))) };
    match mask {
        Some(mask) => (loss - ssim_weight) / mean_weight(mask) + ssim_weight,
        None => loss,
    }
}

/// Computes the mean SSIM, with sample covariances; 1 for equal images. The requirements on the images are those of [`photometric`].
///
/// # Panics
/// Panics if the shapes differ or the images are smaller than 11×11.
pub fn ssim(image: &Tensor, ground_truth: &Tensor) -> Tensor {
    photometric(image, ground_truth, None, 0., 1.)
}

// L_con: the Gaussians of two subsets of the photos must agree in geometry (spec 7.7).

/// Part of a training step that one forward pass covers: a step may run the model in slices.
#[derive(Debug)]
pub struct StepFraction {
    /// Fraction of the step's scenes.
    pub scenes: f64,
    /// Number of pixels of the whole step whose depth L_con compares, a scalar; `None` if this pass is the whole step.
    pub depth_pixels: Option<Tensor>,
}

impl StepFraction {
    /// Fraction of a pass that is the whole step.
    pub const WHOLE: StepFraction = StepFraction { scenes: 1., depth_pixels: None };
}

/// Minimum opacity of both splats at a pixel whose depth is compared.
const MIN_ALPHA: f64 = 0.01;

/// Computes `alpha_factor` · L1(A_a, A_b) + `depth_factor` · L1(D_a, D_b), each ½|x − sg(y)| + ½|y − sg(x)|, where sg stops the gradient:
/// either side learns from the other, which is fixed. Accumulated opacities and depths are [B, C, H, W] and those of `share` of a step; the
/// result is a scalar, this share's part of the step's loss. Means are weighted by the target views' `mask` [B, C, 1, H, W] if there is one
/// (spec 7.9).
pub fn consistency(
    alpha: [&Tensor; 2],
    depth: [&Tensor; 2],
    mask: Option<&Tensor>,
    (alpha_factor, depth_factor): (f64, f64),
    share: &StepFraction,
) -> Tensor {
    let distance = symmetric_distance(alpha);
    let opacity = match mask {
        Some(mask) => {
            let mask = mask.squeeze_dim(2);
            let scene_means = |t: Tensor| t.mean_dim([1i64, 2, 3].as_slice(), false, None::<Kind>);
            let weighted = scene_means(distance * &mask) / scene_means(mask).clamp_min(MIN_WEIGHT);
            weighted.mean(None::<Kind>)
        }
        None => distance.mean(None::<Kind>),
    } * share.scenes;
    let both = compared(alpha, mask, depth[0].kind());
    let sum = (symmetric_distance(depth) * &both).sum(None::<Kind>);
    let depth = match &share.depth_pixels {
        Some(count) => sum / count.clamp_min(1.),
        None => sum / both.sum(None::<Kind>).clamp_min(1.),
    };
    opacity * alpha_factor + depth * depth_factor
}

/// Counts the pixels whose depth is compared, each by its weight in `mask` [B, C, 1, H, W]; returns a scalar of `alpha`'s kind.
pub fn depth_pixels(alpha: [&Tensor; 2], mask: Option<&Tensor>) -> Tensor {
    compared(alpha, mask, alpha[0].kind()).sum(None::<Kind>)
}

/// Returns the weight of every pixel whose depth is compared, and 0 for the others, [B, C, H, W].
fn compared(alpha: [&Tensor; 2], mask: Option<&Tensor>, kind: Kind) -> Tensor {
    let opaque_in_both = alpha[0].gt(MIN_ALPHA).logical_and(&alpha[1].gt(MIN_ALPHA)).to_kind(kind);
    match mask {
        Some(mask) => opaque_in_both * mask.squeeze_dim(2),
        None => opaque_in_both,
    }
}

fn symmetric_distance([x, y]: [&Tensor; 2]) -> Tensor {
    ((x - y.detach()).abs() + (y - x.detach()).abs()) * 0.5
}

// L_fru: pulls Gaussians that no input view can see back into the frustum of some view (spec 7.5).

/// Minimum divisor of the projection.
const MIN_DIVISOR: f64 = 1e-6;
/// Near plane: Gaussians with a smaller depth violate the frustum.
const NEAR: f64 = 0.01;
/// Violation, in pixels or units of depth, that counts as one.
const SOFTNESS: f64 = 10.;

/// Computes the mean over Gaussians and scenes of log(1 + v/10), where v is the smallest violation over the views. A violation is the
/// distance of the projection from the image, in pixels, plus the distance of the depth from [0.01, far].
///
/// `means` is [B, N, 3] and `far` is `[B]`. The result is a scalar.
pub fn frustum(means: &Tensor, views: &ViewBatch, far: &Tensor) -> Tensor {
    let (height, width) = (views.images.size()[3], views.images.size()[4]);
    let rotation = views.w2c.narrow(-2, 0, 3).narrow(-1, 0, 3);
    let translation = views.w2c.narrow(-2, 0, 3).narrow(-1, 3, 1).transpose(-1, -2);
    let camera = means.unsqueeze(1).matmul(&rotation.transpose(-1, -2)) + translation; // [B, V, N, 3]
    let pixel = camera.matmul(&views.intrinsics.transpose(-1, -2)); // (f_x x + c_x z, f_y y + c_y z, z)
    let depth = camera.select(-1, 2);
    let divisor = depth.clamp_min(MIN_DIVISOR);
    let outside =
        |coordinate: Tensor, size: i64| (-&coordinate).relu() + (coordinate - (size - 1) as f64).relu();
    let violation = outside(pixel.select(-1, 0) / &divisor, width)
        + outside(pixel.select(-1, 1) / &divisor, height)
        + (-&depth + NEAR).relu()
        + (&depth - far.view([-1, 1, 1])).relu();
    (violation.amin([1i64].as_slice(), false) / SOFTNESS).log1p().mean(None::<Kind>)
}

// L_dec: keeps the decoder's raw outputs in a range where they can be learned (spec 7.6).

/// Factor of the whole term.
const DECODER_FACTOR: f64 = 1e-2;
/// Magnitude of spherical harmonics above which they are softly penalized.
const SH_CAP: f64 = 5.;
/// Opacity above which opacities are penalized.
const OPACITY_THRESHOLD: f64 = 0.2;

/// L_dec and its parts, all scalars.
#[derive(Debug)]
pub struct DecoderRegularization {
    /// Total of L_dec: 1e-2 times the sum of the parts.
    pub total: Tensor,
    /// Penalty on large opacities, L_opacity; 0 if it is left out.
    pub opacity: Tensor,
    /// Penalty on large scales, L_scale.
    pub scale: Tensor,
    /// Penalty on rotation residuals, L_rot.
    pub rotation: Tensor,
    /// Penalty on large spherical harmonics, L_SH.
    pub sh: Tensor,
}

/// Computes 1e-2 · (L_scale + L_rot + L_SH), with L_opacity in the sum if `opacity` is set.
pub fn decoder_regularization(raw: &RawOutputs, opacity: bool) -> DecoderRegularization {
    let mean = |t: Tensor| t.mean(None::<Kind>);
    let scale = mean((&raw.log_scales - MAX_SCALE.ln()).relu().square());
    let rotation = mean(raw.rotations.square());
    let sh = sh_soft_cap(&raw.sh);
    let opacity = match opacity {
        true => {
            let logit = (OPACITY_THRESHOLD / (1. - OPACITY_THRESHOLD)).ln();
            mean(raw.opacity_logits.sigmoid()) + mean((&raw.opacity_logits - logit).relu().square())
        }
        false => scale.zeros_like(),
    };
    let total = (&scale + &rotation + &sh + &opacity) * DECODER_FACTOR;
    DecoderRegularization { total, opacity, scale, rotation, sh }
}

/// Computes mean softplus(|c| − 5)².
pub fn sh_soft_cap(sh: &Tensor) -> Tensor {
    (sh.abs() - SH_CAP).softplus().square().mean(None::<Kind>)
}

// Edge-aware depth smoothness, which regularizes geometry if there are few photos (Godard et al. 2017, eq. 3).

/// Minimum weight of a pixel whose depth is compared.
const MIN_DEPTH_WEIGHT: f64 = 0.5;

/// Computes `factor` times the mean of 2 |a − b| / (a + b) · exp(−10 |g − h|) over all pairs of horizontally or vertically neighbouring
/// pixels, where a and b are the depths and g and h the photo's gray values at the two pixels. Pairs with a depth of 0, where nothing is
/// visible, contribute 0. `depths` are [.., H, W], 0 or more; `photos` are [.., 3, H, W]. The result is a scalar, differentiable with
/// respect to the depths; float64 if the depths are, and float32 otherwise.
///
/// With a `mask` [.., H, W], only pairs of pixels that both count do: those with a weight of ½ or more (spec 7.9). The mean over all pairs is
/// then divided by the fraction of these pixels.
///
/// # Panics
/// Panics if the shapes don't fit.
pub fn depth_smoothness(depths: &Tensor, photos: &Tensor, mask: Option<&Tensor>, factor: f64) -> Tensor {
    let counts = mask.map(|mask| mask.ge(MIN_DEPTH_WEIGHT).to_kind(depths.kind()));
    let counted = counts.as_ref().map(|counts| depths * counts);
    let addresses = [counted.as_ref().unwrap_or(depths), photos].map(|t| t.as_ptr() as usize);
    // SAFETY: the tensors outlive the call, which returns the address of a new one.
    let loss = unsafe { tensor_ops::depth_smoothness(addresses[0], addresses[1], factor) };
    let loss = unsafe { take_tensor(loss.unwrap_or_else(|error| panic!("{error}"))) };
    match counts {
        Some(counts) => loss / mean_weight(&counts),
        None => loss,
    }
}

// Masks of photos (spec 7.9): a pixel that is masked out contributes nothing, and has no gradient.

/// Minimum mean weight, so that the loss of photos without any pixel that counts is finite.
const MIN_WEIGHT: f64 = 1e-6;

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
            ("l1", &|image, photo, mask| photometric(image, photo, Some(mask), 1., 0.)),
            ("ssim", &|image, photo, mask| photometric(image, photo, Some(mask), 0., 1.)),
            ("smoothness", &|image, photo, mask| {
                depth_smoothness(&depth(image), photo, Some(&depth(mask)), 1.)
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
