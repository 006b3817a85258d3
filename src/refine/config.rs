//! How a splat is refined. The defaults are what measurements chose: see docs/refine.md.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Numbers of the optimization. Learning rates are those of Adam; lengths are in units of the scene's depth, see
/// [`super::scene_depth`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefineConfig {
    /// Views in a step.
    pub views: usize,
    /// Parts of the way at which pictures become twice as wide and high; before the first of them they are smallest.
    pub sizes: Vec<f64>,
    /// Of the spherical harmonics in the end.
    pub sh_degree: i64,
    /// Part of the way at which one degree more is learned, and again after the same part.
    pub sh_every: f64,
    /// Of means, at the beginning, in scene depths.
    pub means: f64,
    /// What is left of it in the end.
    pub means_end: f64,
    /// Of the logarithms of scales.
    pub log_scales: f64,
    /// Of quaternions.
    pub quaternions: f64,
    /// Of logits of opacities.
    pub opacity_logits: f64,
    /// Of colours.
    pub colours: f64,
    /// Of higher spherical harmonics, beside that of colours.
    pub harmonics: f64,
    /// What is left of all of these in the end.
    pub others_end: f64,
    /// Of tokens.
    pub tokens: f64,
    /// Of cameras' twists, in radians, and shifts, in scene depths, where poses are corrected.
    pub poses: f64,
    /// Of logarithms of exposures, where photos have their own.
    pub exposures: f64,
    /// What 1 − SSIM counts, beside absolute differences with one minus it.
    pub similar: f64,
    /// What the mean opacity counts.
    pub opacity: f64,
    /// What the mean scale counts, in scene depths.
    pub scale: f64,
    /// What the unevenness of depths counts, see [`crate::loss::depth_smoothness`].
    pub smooth: f64,
    /// Steps between relocations of dead Gaussians; 0: never.
    pub relocate_every: u64,
    /// Opacity at or below which a Gaussian is dead.
    pub dead: f64,
    /// Part of the way after which none is relocated.
    pub relocate_until: f64,
}

impl Default for RefineConfig {
    fn default() -> Self {
        RefineConfig {
            views: 2,
            sizes: vec![0.03, 0.1],
            sh_degree: 1,
            sh_every: 0.3,
            means: 2e-3,
            means_end: 0.02,
            log_scales: 1e-2,
            quaternions: 2e-3,
            opacity_logits: 3e-2,
            colours: 5e-3,
            harmonics: 0.1,
            others_end: 0.2,
            tokens: 1e-2,
            poses: 5e-4,
            exposures: 5e-3,
            similar: 0.4,
            opacity: 1e-3,
            scale: 0.,
            smooth: 0.7,
            relocate_every: 100,
            dead: 0.01,
            relocate_until: 0.8,
        }
    }
}

impl RefineConfig {
    /// The defaults, from a splat or from nothing, with `overrides`, each `key=value` with a TOML value.
    ///
    /// # Errors
    /// A key that isn't known, or a value of another type.
    pub fn with(overrides: &[String], from_splat: bool) -> Result<Self> {
        let defaults = if from_splat { RefineConfig::from_splat() } else { RefineConfig::default() };
        let mut table = toml::Table::try_from(&defaults).expect("plain numbers");
        for assignment in overrides {
            let refused = |why: &str| Error::Request(format!("--set {assignment}: {why}"));
            let set: toml::Table = assignment.parse().map_err(|_| refused("expected KEY=VALUE"))?;
            table.extend(set);
            if let Err(e) = table.clone().try_into::<RefineConfig>() {
                return Err(refused(&e.message().replace('\n', " ")));
            }
        }
        Ok(table.try_into().expect("what was just tried"))
    }

    /// For a splat that is good already.
    fn from_splat() -> Self {
        RefineConfig { sizes: vec![], opacity: 0., ..Default::default() }
    }

    /// Sizes of the photos.
    pub fn levels(&self) -> usize {
        self.sizes.len() + 1
    }
}
