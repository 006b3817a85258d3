//! Losses (SPEC section 7), one file per term, and their weighted sum.

mod consistency;
mod decoder_regularization;
mod frustum;
mod lpips;
mod mse;
mod perceptual;
mod vgg19;

pub use consistency::{consistency, depth_pixels};
pub use decoder_regularization::{DecoderRegularization, decoder_regularization, sh_soft_cap};
pub use frustum::frustum;
pub use lpips::{Lpips, LpipsNetwork};
pub use mse::{mse, psnr_of_mse};
pub use perceptual::{PerceptualKind, PerceptualLoss};
pub use vgg19::Vgg19;

use crate::config::LossConfig;
use crate::data::Sample;
use crate::model::Decoded;
use crate::render::Pictures;
use tch::Tensor;

/// What a forward pass is of a training step, which may go through the model in slices.
#[derive(Debug)]
pub struct Share {
    /// Of the step's scenes.
    pub scenes: f64,
    /// Pixels of the whole step whose depth L_con compares, a scalar; none where this pass is the whole step.
    pub depth_pixels: Option<Tensor>,
}

impl Share {
    /// All of it.
    pub const WHOLE: Share = Share { scenes: 1., depth_pixels: None };
}

/// The loss of one forward pass and what it is made of, all scalars: its parts of the whole step's.
#[derive(Debug)]
pub struct Losses {
    /// What is minimized.
    pub total: Tensor,
    /// Mean squared error, before its factor.
    pub mse: Tensor,
    /// L_perc, before its factor; 0 where it is left out.
    pub perceptual: Tensor,
    /// L_con, with its factors; 0 where the sample isn't paired.
    pub consistency: Tensor,
    /// L_fru, before its factor.
    pub frustum: Tensor,
    /// L_dec, before its factor.
    pub decoder: DecoderRegularization,
}

/// What `decoded` is worth, whose `pictures` were rendered from the sample's target cameras. All terms are means over equally
/// large halves, so for a paired sample the sum is ½(L_a + L_b) + L_con. Losses of all shares of a step add up to the step's.
pub fn losses(
    config: &LossConfig,
    perceptual: Option<&PerceptualLoss>,
    sample: &Sample,
    decoded: &Decoded,
    pictures: &Pictures,
    share: &Share,
) -> Losses {
    let truth = &sample.target.images;
    let mse = mse(&pictures.rgb, truth) * share.scenes;
    let perceptual = match perceptual {
        // Both halves of a paired sample have the same targets.
        Some(network) if sample.paired => network.loss(&pictures.rgb, &truth.chunk(2, 0)[0]) * share.scenes,
        Some(network) => network.loss(&pictures.rgb, truth) * share.scenes,
        None => mse.zeros_like(),
    };
    let consistency = match sample.paired {
        true => {
            let (alpha, depth) = (pictures.alpha.chunk(2, 0), pictures.depth.chunk(2, 0));
            let factors = (config.consistency_alpha, config.consistency_depth);
            consistency([&alpha[0], &alpha[1]], [&depth[0], &depth[1]], factors.0, factors.1, share)
        }
        false => mse.zeros_like(),
    };
    let frustum = frustum(&decoded.gaussians.means, &sample.context, &sample.far) * share.scenes;
    let decoder = decoder_regularization(&decoded.raw, config.decoder_opacity) * share.scenes;
    let total = &mse * config.mse
        + &perceptual * config.perceptual_factor
        + &consistency
        + &frustum * config.frustum
        + &decoder.total * config.decoder;
    Losses { total, mse, perceptual, consistency, frustum, decoder }
}
