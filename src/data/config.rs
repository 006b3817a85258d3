//! Which data a run looks at, and how.

use super::holdout::Holdout;
use crate::error::{Error, Result};
use crate::io::expand_path;
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How context views are chosen from a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// All frames alike, as the paper says.
    Uniform,
    /// A random one first, then always the frame whose camera is farthest from those chosen, as the published code does.
    Farthest,
}

/// How far colours may be changed; the paper jitters and tells no numbers. 0 leaves an adjustment out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JitterConfig {
    /// Factors on colours are 1 − this to 1 + this.
    pub brightness: f64,
    /// Factors on the distance from the image's mean grey are 1 − this to 1 + this.
    pub contrast: f64,
    /// Factors on the distance from a pixel's grey are 1 − this to 1 + this.
    pub saturation: f64,
    /// Hues turn by up to this share of the circle, either way; ½ at most.
    pub hue: f64,
}

impl Default for JitterConfig {
    fn default() -> Self {
        JitterConfig { brightness: 0.3, contrast: 0.4, saturation: 0.3, hue: 0.1 }
    }
}

impl JitterConfig {
    /// Changes nothing.
    pub const OFF: Self = JitterConfig { brightness: 0., contrast: 0., saturation: 0., hue: 0. };
}

/// Captures and views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Captures, folders of captures, or data sets of chunks, of which the part `train` is taken. `${NAME}` and `${NAME:-default}` stand for environment variables.
    pub captures: Vec<String>,
    /// [height, width] that images are fitted to.
    pub image_size: ImageSize,
    /// In which sizes a scene is shown to a model that is used: what the largest distance between two cameras becomes. Of several,
    /// and of what lies around the best, the splat that shows the photos best is kept (spec 9.9): in validation, too. Training has 1
    /// alone.
    pub extents: Vec<f64>,
    /// Views the model sees of a scene in a training step, at most.
    pub context_views: usize,
    /// Where it isn't 0, every step draws how many views the model sees of its scenes: from this to `context_views`.
    pub fewest_context_views: usize,
    /// Views of a scene that its pictures are compared with in a training step.
    pub target_views: usize,
    /// [shortest, longest] part of a video, in frames, that the views of a training step are from, at most the whole of it. A
    /// video that is shorter than the shortest is skipped.
    pub window: [usize; 2],
    /// How context views are chosen: `uniform` or `farthest`.
    pub sampling: Sampling,
    /// The part of a photo that is shown in training is smaller than it could be by a factor of 1 to 1 + this.
    pub extra_crop: f64,
    /// Whether every other sample in training is mirrored.
    pub flip: bool,
    /// How far training changes colours.
    pub jitter: JitterConfig,
    /// Views never shown in training: the targets of validation.
    pub holdout: Holdout,
    /// What validation looks at besides: captures, folders of captures, or data sets, of which the part `test` is taken.
    pub validation: Vec<String>,
    /// Scenes of `validation` at most, spread evenly over all of them.
    pub validation_scenes: usize,
    /// Share of the scenes that may be unusable before training fails: too short, or broken in any way.
    pub max_bad_share: f64,
    /// Threads that load; 0 for one a core.
    pub threads: usize,
    /// Scenes that are loaded ahead.
    pub ahead: usize,
    /// Decoded photos are kept where all of them together take no more than this, in 10⁶ bytes.
    pub photo_megabytes: u64,
}

impl Default for DataConfig {
    fn default() -> Self {
        DataConfig {
            captures: vec![],
            image_size: [256, 256].into(),
            extents: vec![1.],
            context_views: 24,
            fewest_context_views: 0,
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
            ahead: 32,
            photo_megabytes: 1000,
        }
    }
}

impl DataConfig {
    /// `captures` with environment variables filled in.
    ///
    /// # Errors
    /// A variable that isn't set and has no default.
    pub fn capture_paths(&self) -> Result<Vec<PathBuf>> {
        self.captures.iter().map(|path| expand_path(path)).collect()
    }

    /// Everything that validation's scores depend on.
    pub(crate) fn validation_settings(&self) -> String {
        let scenes = (&self.captures, &self.holdout, &self.validation, self.validation_scenes);
        let views = (self.image_size, self.context_views, self.target_views, self.window);
        // As runs tell it that began before there were extents.
        let settings = match self.extents == [1.] {
            true => serde_json::to_string(&(scenes, views)),
            false => serde_json::to_string(&(scenes, views, &self.extents)),
        };
        settings.expect("numbers and strings")
    }

    /// `validation` with environment variables filled in.
    ///
    /// # Errors
    /// As [`DataConfig::capture_paths`].
    pub fn validation_paths(&self) -> Result<Vec<PathBuf>> {
        self.validation.iter().map(|path| expand_path(path)).collect()
    }

    /// Whether the numbers fit together.
    ///
    /// # Errors
    /// Names the first field that doesn't.
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
        if self.fewest_context_views > self.context_views {
            let expected = format!("0 to the {} of data.context_views", self.context_views);
            return Err(Error::setting("data.fewest_context_views", self.fewest_context_views, expected));
        }
        if self.extents.is_empty() || !self.extents.iter().all(|extent| *extent > 0. && extent.is_finite()) {
            let expected = "one or more numbers above 0";
            return Err(Error::setting("data.extents", format!("{:?}", self.extents), expected));
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
