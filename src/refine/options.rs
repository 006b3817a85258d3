//! Options of a refinement session.

use super::config::RefineConfig;
use crate::data::{Capture, Holdout};
use crate::error::{Error, Result};
use crate::reconstruct::spread_over_path;
use crate::scene::ImageSize;
use rand::Rng;
use std::time::{Duration, Instant};
use tch::Device;

/// Budget of an optimization.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Budget {
    /// Number of steps. The same number of steps gives bit-identical results.
    Steps(u64),
    /// Wall-clock time, including all other work.
    Time(Duration),
}

/// Background that a splat is seen over where photos are masked out, so that nothing is left there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaskBackground {
    /// Black.
    Black,
    /// White.
    White,
    /// Another colour in every step, which no Gaussian can imitate.
    Random,
}

impl MaskBackground {
    /// Returns red, green and blue of the background of a step.
    pub(super) fn colour(self, random: &mut impl Rng) -> [f32; 3] {
        match self {
            MaskBackground::Black => [0.; 3],
            MaskBackground::White => [1.; 3],
            MaskBackground::Random => random.random(),
        }
    }
}

/// Options of a session.
#[derive(Debug, Clone)]
pub struct RefineOptions {
    /// Hyperparameters. [`RefineConfig::from_splat`] returns those for a start from a splat.
    pub config: RefineConfig,
    /// Number of steps, or time. A time includes reading the photos, the start, the scores, and writing the splat.
    pub budget: Budget,
    /// Start of a time budget; if it is `None`, the start of the session.
    pub started: Option<Instant>,
    /// Number of Gaussians if the initial splat doesn't determine it.
    pub gaussians: usize,
    /// Seed of the random numbers.
    pub seed: u64,
    /// Views that are held out and scored, see [`Capture::split`].
    pub holdout: Holdout,
    /// Maximum number of the other views, spread along the camera path; if it is `None`, all are used.
    pub views: Option<usize>,
    /// Learns corrections of the camera poses if `true`.
    pub correct_poses: bool,
    /// Learns the exposure of each photo relative to the others if `true`.
    pub correct_exposures: bool,
    /// Background that masked pixels have in the optimization. If it is `None`, the optimization ignores masked pixels.
    pub mask_background: Option<MaskBackground>,
    /// Size to which photos are cropped and resized. If it is `None`, they keep their shape, and large ones are downscaled.
    pub size: Option<ImageSize>,
    /// Device of the depth estimation and the optimization.
    pub device: Device,
}

impl Default for RefineOptions {
    /// Returns the options for one minute on the CPU, with as many Gaussians as the paper's main model has.
    fn default() -> Self {
        RefineOptions {
            config: RefineConfig::default(),
            budget: Budget::Time(Duration::from_secs(60)),
            started: None,
            gaussians: 16_384,
            seed: 0,
            holdout: Holdout::None,
            views: None,
            correct_poses: false,
            correct_exposures: false,
            mask_background: None,
            size: None,
            device: Device::Cpu,
        }
    }
}

impl RefineOptions {
    /// Checks that every option is in its range.
    pub(super) fn check(&self) -> Result<()> {
        self.config.check().map_err(|expected| {
            Error::request(format!("a setting of the refinement is out of range, expected {expected}"))
        })?;
        if self.budget == Budget::Time(Duration::ZERO) {
            return Err(Error::setting("the time of the refinement", "0 s", "more than 0 s"));
        }
        if self.gaussians == 0 {
            return Err(Error::setting("the number of Gaussians", 0, "1 or more"));
        }
        if let Some(views @ ..2) = self.views {
            return Err(Error::setting("the number of views", views, "2 or more"));
        }
        Ok(())
    }

    /// Returns the indices of the photos to match and of the held-out views.
    pub(super) fn select_views(&self, capture: &Capture) -> [Vec<usize>; 2] {
        let (shown, held_out) = capture.split(self.holdout);
        let shown = spread_over_path(&capture.cameras(), &shown, self.views.unwrap_or(usize::MAX));
        [shown, held_out]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_refused() {
        let default = RefineOptions::default;
        assert!(default().check().is_ok());
        let config = RefineConfig { views: 0, ..RefineConfig::default() };
        for (options, expected) in [
            (RefineOptions { config, ..default() }, "expected 1 or more"),
            (RefineOptions { budget: Budget::Time(Duration::ZERO), ..default() }, "expected more than 0 s"),
            (RefineOptions { gaussians: 0, ..default() }, "number of Gaussians is 0"),
            (RefineOptions { views: Some(1), ..default() }, "number of views is 1"),
        ] {
            let error = options.check().unwrap_err();
            assert!(error.is_request() && error.to_string().contains(expected), "{error}");
        }
    }
}
