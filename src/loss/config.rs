//! Configuration of the loss: its terms and their weights.

use super::perceptual_network::PerceptualBackbone;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Network of the perceptual loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PerceptualKind {
    /// No network: L_perc is left out.
    None,
    /// Features of VGG-19.
    Vgg19,
    /// LPIPS with VGG-16.
    LpipsVgg,
    /// LPIPS with AlexNet.
    LpipsAlex,
}

impl PerceptualKind {
    /// Returns the network; `None` if L_perc is left out.
    pub fn backbone(self) -> Option<PerceptualBackbone> {
        match self {
            PerceptualKind::None => None,
            PerceptualKind::Vgg19 => Some(PerceptualBackbone::Vgg19),
            PerceptualKind::LpipsVgg => Some(PerceptualBackbone::LpipsVgg),
            PerceptualKind::LpipsAlex => Some(PerceptualBackbone::LpipsAlex),
        }
    }
}

/// Weights of the loss terms (spec 7.1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of the mean squared error of the rendered colors.
    pub mse: f64,
    /// Network of the perceptual loss: `none`, `vgg19`, `lpips_vgg` or `lpips_alex`.
    pub perceptual: PerceptualKind,
    /// Weight of the perceptual loss.
    pub perceptual_factor: f64,
    /// File of the network's weights. By default it has the network's own name and is looked up in the folders where `make weights` puts
    /// them. `${NAME}` and `${NAME:-default}` stand for environment variables.
    pub perceptual_weights: String,
    /// Weight of the difference of the two subsets' accumulated opacities. If this and `consistency_depth` are 0, all context views form
    /// one set.
    pub consistency_alpha: f64,
    /// Weight of the difference of the two subsets' depths.
    pub consistency_depth: f64,
    /// Weight of the frustum constraint on the Gaussians' centers.
    pub frustum: f64,
    /// Weight of L_dec, in addition to its own factor of 1e-2.
    pub decoder: f64,
    /// Includes the opacity term in L_dec if `true`.
    pub decoder_opacity: bool,
}

impl LossConfig {
    /// Returns `true` if the context is split into two subsets that have to agree.
    pub fn has_consistency(&self) -> bool {
        self.consistency_alpha > 0. || self.consistency_depth > 0.
    }

    /// Checks that the weights are finite and at least 0.
    ///
    /// # Errors
    /// Names the first weight that isn't.
    pub fn check(&self) -> Result<()> {
        for (field, value) in [
            ("loss.mse", self.mse),
            ("loss.perceptual_factor", self.perceptual_factor),
            ("loss.consistency_alpha", self.consistency_alpha),
            ("loss.consistency_depth", self.consistency_depth),
            ("loss.frustum", self.frustum),
            ("loss.decoder", self.decoder),
        ] {
            if !(value >= 0. && value.is_finite()) {
                return Err(Error::setting(field, value, "0 or more"));
            }
        }
        Ok(())
    }
}

impl Default for LossConfig {
    fn default() -> Self {
        LossConfig {
            mse: 2.,
            perceptual: PerceptualKind::Vgg19,
            perceptual_factor: 1.,
            perceptual_weights: String::new(),
            consistency_alpha: 1e-3,
            consistency_depth: 1e-2,
            frustum: 1e-2,
            decoder: 1.,
            decoder_opacity: false,
        }
    }
}
