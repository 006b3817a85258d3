//! A run's configuration: one TOML file, every key with the paper's value as its default. Unknown keys are errors.
//!
//! `data`, `loss` and `model` have the sections that are about them; those about training are here.

mod curriculum;
mod keys;
mod train;

pub use curriculum::CurriculumConfig;
pub(crate) use keys::changed_keys;
pub use train::{OptimizerKind, TrainConfig};

use crate::data::DataConfig;
use crate::error::{Error, Result};
use crate::loss::LossConfig;
use crate::model::ModelConfig;
use crate::scene::ImageSize;
use keys::override_key;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Everything a run depends on.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The network.
    pub model: ModelConfig,
    /// What it looks at.
    pub data: DataConfig,
    /// How many Gaussians, when.
    pub curriculum: CurriculumConfig,
    /// The factors of the loss.
    pub loss: LossConfig,
    /// How it learns.
    pub train: TrainConfig,
}

impl Config {
    /// Reads `file` and applies `overrides`, each `section.key=value` with a TOML value (a bare word counts as a string).
    ///
    /// # Errors
    /// A file that can't be read, unknown keys, values of the wrong type, numbers that don't fit together.
    pub fn read(file: &Path, overrides: &[String]) -> Result<Self> {
        let text = std::fs::read_to_string(file).map_err(Error::read(file))?;
        Self::parse(&text, overrides, file)
    }

    /// As [`Config::read`], from `text` that came from `origin`.
    ///
    /// # Errors
    /// As there.
    pub fn parse(text: &str, overrides: &[String], origin: &Path) -> Result<Self> {
        // The file by itself first, so that its errors tell a line.
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
                Error::Request(format!("--set {assignment}: {}", e.message().replace('\n', " ")))
            })?;
        }
        let config: Config = table.try_into().map_err(described)?;
        config.check().map_err(|e| Error::Request(format!("{}: {e}", origin.display())))?;
        Ok(config)
    }

    /// As TOML, every key written out.
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

/// The parser's message and where, on one line.
fn one_line(error: &toml::de::Error, text: &str) -> String {
    let message = error.message().replace('\n', " ");
    match error.span() {
        Some(span) => {
            format!("{message} in line {}", text[..span.start.min(text.len())].matches('\n').count() + 1)
        }
        None => message,
    }
}
