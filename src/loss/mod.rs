//! Losses (SPEC section 7), one file per term, and their weighted sum.

mod decoder_regularization;
mod frustum;
mod mse;

pub use decoder_regularization::{decoder_regularization, sh_soft_cap};
pub use frustum::frustum;
pub use mse::mse;

use crate::config::LossConfig;
use crate::data::Sample;
use crate::model::Decoded;
use crate::render::Pictures;
use tch::Tensor;

/// The loss of one forward pass and what it is made of, all scalars.
#[derive(Debug)]
pub struct Losses {
    /// What is minimized.
    pub total: Tensor,
    /// Mean squared error, before its factor.
    pub mse: Tensor,
    /// L_fru, before its factor.
    pub frustum: Tensor,
    /// L_dec, before its factor.
    pub decoder: Tensor,
}

/// What `decoded` is worth, whose `pictures` were rendered from the sample's target cameras.
pub fn losses(config: &LossConfig, sample: &Sample, decoded: &Decoded, pictures: &Pictures) -> Losses {
    let mse = mse(&pictures.rgb, &sample.target.images);
    let frustum = frustum(&decoded.gaussians.means, &sample.context, &sample.far);
    let decoder = decoder_regularization(&decoded.raw, config.decoder_opacity);
    let total = &mse * config.mse + &frustum * config.frustum + &decoder * config.decoder;
    Losses { total, mse, frustum, decoder }
}
