//! Configuration of a run: one TOML file, in which every key defaults to the paper's value. Unknown keys are errors.
//!
//! The sections `data`, `loss` and `model` are defined in the modules of these names; the sections on training are defined here.

mod keys;
mod train;

pub(crate) use keys::changed_keys;
pub use train::{CurriculumConfig, OptimizerKind, TrainConfig};

use crate::data::DataConfig;
use crate::error::{Error, Result};
use crate::loss::LossConfig;
use crate::model::ModelConfig;
use crate::scene::ImageSize;
use keys::override_key;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Configuration of a run. It holds everything that the run depends on.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Network.
    pub model: ModelConfig,
    /// Datasets, and how views are sampled from them.
    pub data: DataConfig,
    /// Curriculum: the number of Gaussians per scene token in the course of training.
    pub curriculum: CurriculumConfig,
    /// Terms of the loss and their factors.
    pub loss: LossConfig,
    /// Optimizer, learning rate schedule, checkpoints and logs.
    pub train: TrainConfig,
}

impl Config {
    /// Reads `file` and applies `overrides`, each `section.key=value` with a TOML value (a bare word counts as a string).
    ///
    /// # Errors
    /// Returns an error if the file can't be read, a key is unknown, a value has the wrong type, or values don't fit together.
    pub fn read(file: &Path, overrides: &[String]) -> Result<Self> {
        let text = std::fs::read_to_string(file).map_err(Error::read(file))?;
        Self::parse(&text, overrides, file)
    }

    /// Parses `text` and applies `overrides` like [`Config::read`]. `origin` is the file that error messages name.
    ///
    /// # Errors
    /// Returns an error if `text` isn't TOML, a key is unknown, a value has the wrong type, or values don't fit together.
    pub fn parse(text: &str, overrides: &[String], origin: &Path) -> Result<Self> {
        // Parse the file without overrides first, so that its errors give a line.
        let mut table: toml::Table = text
            .parse()
            .map_err(|e: toml::de::Error| Error::input(origin, "the file", one_line(&e, text), "TOML"))?;
        let described = |e: toml::de::Error| {
            Error::input(origin, "a key", one_line(&e, text), "a configuration of globalsplat")
        };
        toml::from_str::<Config>(text).map_err(described)?;
        for assignment in overrides {
            override_key(&mut table, assignment)?;
            let config: std::result::Result<Config, _> = table.clone().try_into();
            config.map_err(|e: toml::de::Error| {
                Error::request(format!("--set {assignment}: {}", e.message().replace('\n', " ")))
            })?;
        }
        let config: Config = table.try_into().map_err(described)?;
        config.check().map_err(|e| Error::request(format!("{}: {e}", origin.display())))?;
        Ok(config)
    }

    /// Returns the configuration as TOML, with every key written out.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self).expect("a configuration is numbers, strings and lists")
    }

    fn check(&self) -> Result<()> {
        self.model.check()?;
        let ImageSize { height, width } = self.data.image_size;
        self.model.check_image(i64::from(height), i64::from(width))?;
        self.data.check()?;
        self.curriculum.check(&self.model)?;
        self.loss.check()?;
        self.train.check()
    }
}

/// Returns the parser's message and the line of the error, on one line.
fn one_line(error: &toml::de::Error, text: &str) -> String {
    let message = error.message().replace('\n', " ");
    match error.span() {
        Some(span) => {
            format!("{message} in line {}", text[..span.start.min(text.len())].matches('\n').count() + 1)
        }
        None => message,
    }
}
