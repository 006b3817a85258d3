//! Losses (spec 7.1), one file per term, and their weighted sum.

mod config;
mod consistency;
mod decoder_regularization;
mod depth_smoothness;
mod frustum;
mod lpips;
mod mse;
mod perceptual;
mod photometric;
mod terms;
mod vgg19;

pub use config::{LossConfig, PerceptualKind};
pub use decoder_regularization::{DecoderRegularization, decoder_regularization, sh_soft_cap};
pub use depth_smoothness::depth_smoothness;
pub use frustum::frustum;
pub use lpips::{Lpips, LpipsNetwork};
pub use mse::{mse, psnr_of_mse};
pub use perceptual::PerceptualLoss;
pub use photometric::{photometric, ssim};
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
    let mse = mse(&rendered.rgb, ground_truth) * share.scenes;
    let perceptual = match perceptual {
        Some(network) => {
            // Both halves of a paired sample have the same targets.
            let halves = ground_truth.chunk(if batch.paired { 2 } else { 1 }, 0);
            network.loss(&rendered.rgb, &halves[0]) * share.scenes
        }
        None => mse.zeros_like(),
    };
    let consistency = match batch.paired {
        true => {
            let (alpha, depth) = (rendered.alpha.chunk(2, 0), rendered.depth.chunk(2, 0));
            let factors = (config.consistency_alpha, config.consistency_depth);
            consistency([&alpha[0], &alpha[1]], [&depth[0], &depth[1]], factors.0, factors.1, share)
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
