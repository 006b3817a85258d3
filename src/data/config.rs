//! Configuration of the data of a run.

use crate::error::{Error, Result};
use crate::io::expand_path;
use crate::scene::ImageSize;
use globalsplat_capture::Holdout;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Method of choosing context views from a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// Uniformly at random over all frames, as in the paper.
    Uniform,
    /// A random frame first, then repeatedly the frame whose camera is farthest from those chosen, as in the published code.
    Farthest,
}

/// Ranges of the color jitter. The paper applies jitter but gives no values. A value of 0 disables an adjustment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JitterConfig {
    /// Maximum brightness change x: colors are multiplied by a factor from 1 − x to 1 + x.
    pub brightness: f64,
    /// Maximum contrast change x: distances from the image's mean gray are multiplied by a factor from 1 − x to 1 + x.
    pub contrast: f64,
    /// Maximum saturation change x: distances from the pixel's gray are multiplied by a factor from 1 − x to 1 + x.
    pub saturation: f64,
    /// Maximum hue rotation in either direction, as a fraction of the full circle; at most ½.
    pub hue: f64,
}

impl Default for JitterConfig {
    fn default() -> Self {
        JitterConfig { brightness: 0.3, contrast: 0.4, saturation: 0.3, hue: 0.1 }
    }
}

impl JitterConfig {
    /// Settings that leave colors unchanged.
    pub const OFF: Self = JitterConfig { brightness: 0., contrast: 0., saturation: 0., hue: 0. };
}

/// Settings for captures and views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Captures, folders of captures, or datasets of chunks, of which the `train` part is used. `${NAME}` and `${NAME:-default}`
    /// stand for environment variables.
    pub captures: Vec<String>,
    /// Size [height, width] that images are fitted to.
    pub image_size: ImageSize,
    /// If `true`, a plane sweep estimates a depth for every pixel of the context views, and the model sees the scene with distances
    /// made about equal (spec 3.5).
    pub depths: bool,
    /// Number of least-squares steps by which the colors of a reconstruction are fitted to its photos (spec 9.9), in
    /// validation, too. 0 leaves the network's colors as they are.
    pub color_steps: usize,
    /// Maximum number of context views per scene in a training step.
    pub context_views: usize,
    /// Minimum number of context views. If it isn't 0, every step draws the number of context views from this to `context_views`.
    pub min_context_views: usize,
    /// Number of target views per scene that renderings are compared with in a training step.
    pub target_views: usize,
    /// Range [shortest, longest] of the number of frames of a video from which the views of a training step are drawn, at most the
    /// whole video. A video that is shorter than the shortest window is skipped.
    pub window: [usize; 2],
    /// Method of choosing context views: `uniform` or `farthest`.
    pub sampling: Sampling,
    /// Maximum extra crop x: in training, the visible part of a photo is smaller than the largest possible one by a factor of 1 to
    /// 1 + x.
    pub extra_crop: f64,
    /// If `true`, training samples are mirrored with probability ½.
    pub flip: bool,
    /// Ranges of the color jitter in training.
    pub jitter: JitterConfig,
    /// Views that are never used in training: the targets of validation.
    pub holdout: Holdout,
    /// Additional validation data: captures, folders of captures, or datasets, of which the `test` part is used.
    pub validation: Vec<String>,
    /// Maximum number of scenes of `validation`, spread evenly over all of them.
    pub validation_scenes: usize,
    /// Maximum share of unusable scenes, too short or broken in any way, before training fails.
    pub max_bad_share: f64,
    /// Number of loader threads; 0 for one per core.
    pub threads: usize,
    /// Number of scenes to prefetch.
    pub prefetch: usize,
    /// Size limit of the photo cache in 10⁶ bytes. Decoded photos are kept only if all of them together fit.
    pub photo_cache_mb: u64,
}

impl Default for DataConfig {
    fn default() -> Self {
        DataConfig {
            captures: vec![],
            image_size: [256, 256].into(),
            depths: false,
            color_steps: 0,
            context_views: 24,
            min_context_views: 0,
            target_views: 12,
            window: [40, 220],
            sampling: Sampling::Uniform,
            extra_crop: 0.1,
            flip: false,
            jitter: JitterConfig::default(),
            holdout: Holdout::None,
            validation: vec![],
            validation_scenes: 8,
            max_bad_share: 0.25,
            threads: 0,
            prefetch: 32,
            photo_cache_mb: 1000,
        }
    }
}

impl DataConfig {
    /// Returns `captures` with environment variables expanded.
    ///
    /// # Errors
    /// Fails if a variable is not set and has no default.
    pub fn capture_paths(&self) -> Result<Vec<PathBuf>> {
        self.captures.iter().map(|path| expand_path(path)).collect()
    }

    /// Returns all settings that the validation scores depend on, as a string.
    pub(crate) fn validation_settings(&self) -> String {
        let scenes = (&self.captures, &self.holdout, &self.validation, self.validation_scenes);
        let views = (self.image_size, self.context_views, self.target_views, self.window);
        // Omitting the default value keeps the string of runs that began before `color_steps` existed.
        let settings = match self.color_steps {
            0 => serde_json::to_string(&(scenes, views)),
            steps => serde_json::to_string(&(scenes, views, steps)),
        };
        settings.expect("numbers and strings")
    }

    /// Returns `validation` with environment variables expanded.
    ///
    /// # Errors
    /// Fails like [`DataConfig::capture_paths`].
    pub fn validation_paths(&self) -> Result<Vec<PathBuf>> {
        self.validation.iter().map(|path| expand_path(path)).collect()
    }

    /// Checks that the values are consistent.
    ///
    /// # Errors
    /// Names the first invalid field.
    pub fn check(&self) -> Result<()> {
        let [shortest, longest] = self.window;
        if shortest > longest {
            return Err(Error::setting(
                "data.window",
                format!("[{shortest}, {longest}]"),
                "[shortest, longest]",
            ));
        }
        for (field, views) in
            [("data.context_views", self.context_views), ("data.target_views", self.target_views)]
        {
            if !(1..=shortest).contains(&views) {
                let expected = format!("1 to the {shortest} frames of the shortest window, data.window");
                return Err(Error::setting(field, views, expected));
            }
        }
        if self.min_context_views > self.context_views {
            let expected = format!("0 to the {} of data.context_views", self.context_views);
            return Err(Error::setting("data.min_context_views", self.min_context_views, expected));
        }
        let JitterConfig { brightness, contrast, saturation, hue } = self.jitter;
        for (field, value, largest) in [
            ("data.extra_crop", self.extra_crop, 4.),
            ("data.jitter.brightness", brightness, f64::MAX),
            ("data.jitter.contrast", contrast, f64::MAX),
            ("data.jitter.saturation", saturation, f64::MAX),
            ("data.jitter.hue", hue, 0.5),
            ("data.max_bad_share", self.max_bad_share, 1.),
        ] {
            if !(0. ..=largest).contains(&value) {
                let expected =
                    if largest < f64::MAX { format!("0 to {largest}") } else { "0 or more".into() };
                return Err(Error::setting(field, value, expected));
            }
        }
        Ok(())
    }
}
