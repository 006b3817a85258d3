//! Configuration of a run: one TOML file, in which every key defaults to the paper's value. Unknown keys are errors.
//!
//! The sections `data`, `loss` and `model` are defined in the modules of these names; the sections on training are defined here.

mod train;

pub use train::{CurriculumConfig, OptimizerKind, TrainConfig};

use crate::data::DataConfig;
use crate::error::{Error, Result};
use crate::loss::LossConfig;
use crate::model::ModelConfig;
use crate::scene::ImageSize;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
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
        let mut config: Config = toml::from_str(text).map_err(described)?;
        for assignment in overrides {
            override_key(&mut table, assignment)?;
            config = table.clone().try_into().map_err(|e: toml::de::Error| {
                Error::request(format!("--set {assignment}: {}", e.message().replace('\n', " ")))
            })?;
        }
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

// Access to keys by their dotted names, `section.key`.

/// Returns the keys at which two configurations differ, each as "train.batch_size 2 → 4". Both are TOML texts with every key written out.
pub(crate) fn changed_keys(before: &str, after: &str) -> Vec<String> {
    let keys = |text: &str| {
        let mut keys = BTreeMap::new();
        let table: toml::Table = text.parse().unwrap_or_default();
        flatten("", toml::Value::Table(table), &mut keys);
        keys
    };
    let (before, after) = (keys(before), keys(after));
    let changed = after.iter().filter_map(|(key, value)| match before.get(key) {
        Some(old) if old == value => None,
        Some(old) => Some(format!("{key} {old} → {value}")),
        None => Some(format!("{key} {value}")),
    });
    changed.collect()
}

/// Collects the values of a table of tables into a map from dotted keys to values.
fn flatten(key: &str, value: toml::Value, into: &mut BTreeMap<String, toml::Value>) {
    match value {
        toml::Value::Table(table) => {
            for (name, value) in table {
                let key = if key.is_empty() { name } else { format!("{key}.{name}") };
                flatten(&key, value, into);
            }
        }
        value => {
            into.insert(key.to_string(), value);
        }
    }
}

/// Sets the key that `assignment`, `section.key=value`, names in `table`.
fn override_key(table: &mut toml::Table, assignment: &str) -> Result<()> {
    let refused = || Error::request(format!("--set {assignment}: expected section.key=value"));
    let (key, value) = assignment.split_once('=').ok_or_else(refused)?;
    let value: toml::Value = match format!("value = {value}").parse::<toml::Table>() {
        Ok(mut parsed) => parsed.remove("value").ok_or_else(refused)?,
        Err(_) => toml::Value::String(value.to_string()),
    };
    let mut path: Vec<&str> = key.trim().split('.').collect();
    let last = path.pop().ok_or_else(refused)?;
    let mut table = table;
    for section in path {
        let entry = table.entry(section).or_insert_with(|| toml::Value::Table(Default::default()));
        table = entry.as_table_mut().ok_or_else(refused)?;
    }
    table.insert(last.to_string(), value);
    Ok(())
}
