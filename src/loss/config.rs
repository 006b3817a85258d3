//! Which terms the loss has, and what they count.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Which network compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PerceptualKind {
    /// None: L_perc is left out.
    None,
    /// Features of VGG-19.
    Vgg19,
    /// LPIPS with VGG-16.
    LpipsVgg,
    /// LPIPS with AlexNet.
    LpipsAlex,
}

/// The factors of the loss (spec 7.1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Mean squared error of the rendered colours.
    pub mse: f64,
    /// The network that compares pictures as people see them: `none`, `vgg19`, `lpips_vgg` or `lpips_alex`.
    pub perceptual: PerceptualKind,
    /// What its difference counts.
    pub perceptual_factor: f64,
    /// The file of its weights; by default the network's own name in the folders where `make weights` puts them. `${NAME}` and `${NAME:-default}` stand for environment variables.
    pub perceptual_weights: String,
    /// Difference of the two subsets' accumulated opacities. Without this and the next, all context views go together.
    pub consistency_alpha: f64,
    /// Difference of the two subsets' depths.
    pub consistency_depth: f64,
    /// Frustum constraint on the Gaussians' centres.
    pub frustum: f64,
    /// L_dec, which has its own 1e-2 inside.
    pub decoder: f64,
    /// Whether L_dec has its opacity term.
    pub decoder_opacity: bool,
}

impl LossConfig {
    /// Whether the context is split into two subsets that have to agree.
    pub fn has_consistency(&self) -> bool {
        self.consistency_alpha > 0. || self.consistency_depth > 0.
    }

    /// Whether the factors can be.
    ///
    /// # Errors
    /// Names the first that can't.
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
