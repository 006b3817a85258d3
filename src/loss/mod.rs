//! Losses (spec 7.1), one file per term, and their weighted sum.

mod config;
mod consistency;
mod decoder_regularization;
mod depth_smoothness;
mod frustum;
mod lpips;
mod mask;
mod mse;
mod perceptual;
mod photometric;
mod terms;
mod vgg19;

pub use config::{LossConfig, PerceptualKind};
pub use decoder_regularization::{DecoderRegularization, decoder_regularization, sh_soft_cap};
pub use depth_smoothness::{depth_smoothness, masked_depth_smoothness};
pub use frustum::frustum;
pub use lpips::{Lpips, LpipsNetwork};
pub use mask::{fill_masked, mean_weight};
pub use mse::{masked_mse, mse, psnr_of_mse};
pub use perceptual::PerceptualLoss;
pub use photometric::{masked_photometric, photometric, ssim};
pub use terms::{Losses, Term};
pub use vgg19::Vgg19;

// Used by training, which may run the model in slices.
pub(crate) use consistency::{StepFraction, consistency, depth_pixels};

use crate::data::Batch;
use crate::model::Decoded;
use crate::render::RenderOutput;
use tch::Tensor;

/// Computes the loss terms of `decoded`, which was rendered from the target cameras to `rendered`. All terms are means over equally
/// large halves, so for a paired sample the sum is ½(L_a + L_b) + L_con. The losses of all shares of a step add up to the step's loss.
pub(crate) fn losses(
    config: &LossConfig,
    perceptual: Option<&PerceptualLoss>,
    batch: &Batch,
    decoded: &Decoded,
    rendered: &RenderOutput,
    share: &StepFraction,
) -> Losses<Tensor> {
    let ground_truth = &batch.target.images;
    let masks = batch.target_masks();
    let mse = match &masks {
        Some(masks) => mean_over_scenes(&rendered.rgb, &batch.unpaired(ground_truth), masks, masked_mse),
        None => mse(&rendered.rgb, ground_truth),
    } * share.scenes;
    let perceptual = match (perceptual, &masks) {
        (Some(network), Some(masks)) => {
            let loss = |image: &Tensor, ground_truth: &Tensor, mask: &Tensor| {
                network.loss(&fill_masked(image, ground_truth, mask), ground_truth) / mean_weight(mask)
            };
            mean_over_scenes(&rendered.rgb, &batch.unpaired(ground_truth), masks, loss) * share.scenes
        }
        (Some(network), None) => network.loss(&rendered.rgb, &batch.unpaired(ground_truth)) * share.scenes,
        (None, _) => mse.zeros_like(),
    };
    let consistency = match batch.paired {
        true => {
            let (alpha, depth) = (rendered.alpha.chunk(2, 0), rendered.depth.chunk(2, 0));
            let factors = (config.consistency_alpha, config.consistency_depth);
            consistency([&alpha[0], &alpha[1]], [&depth[0], &depth[1]], masks.as_ref(), factors, share)
        }
        false => mse.zeros_like(),
    };
    let frustum = frustum(&decoded.gaussians.means, &batch.context, &batch.far) * share.scenes;
    let decoder = decoder_regularization(&decoded.raw, config.decoder_opacity);
    Losses::weighted(config, |term| match term {
        Term::Mse => mse.shallow_clone(),
        Term::Perceptual => perceptual.shallow_clone(),
        Term::Consistency => consistency.shallow_clone(),
        Term::Frustum => frustum.shallow_clone(),
        Term::Decoder => &decoder.total * share.scenes,
        Term::DecoderOpacity => &decoder.opacity * share.scenes,
        Term::DecoderScale => &decoder.scale * share.scenes,
        Term::DecoderRotation => &decoder.rotation * share.scenes,
        Term::DecoderSh => &decoder.sh * share.scenes,
    })
}

/// Computes the mean of `loss` over the B scenes of `ground_truth` [B, C, 3, H, W] with `masks` [B, C, 1, H, W]. Each scene's mean is over its
/// own pixels that count, so that the slices of a step add up. `rendered` [R·B, C, 3, H, W] holds R renderings of the ground truth along the
/// batch.
fn mean_over_scenes(
    rendered: &Tensor,
    ground_truth: &Tensor,
    masks: &Tensor,
    loss: impl Fn(&Tensor, &Tensor, &Tensor) -> Tensor,
) -> Tensor {
    let (size, count) = (ground_truth.size(), ground_truth.size()[0]);
    let repeated = rendered.reshape([&[-1], size.as_slice()].concat());
    let of_scene = |scene: i64| {
        let [ground_truth, mask] = [ground_truth, masks].map(|t| t.narrow(0, scene, 1));
        loss(&repeated.select(1, scene), &ground_truth, &mask)
    };
    (0..count).map(of_scene).reduce(|sum, loss| sum + loss).expect("a scene") / count as f64
}
