//! A model as one safetensors file that rebuilds it: the weights, and the configuration in the metadata (spec 10.10).

use super::published::{CHECKPOINT_PREFIX, assumed, configuration, is_ours, model_tensors};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::io::{LentWeights, Weights, WeightsFile, write_checkpoint, write_weights};
use crate::model::{GlobalSplat, Precision, Stage};
use std::collections::HashMap;
use std::path::Path;
use tch::{Device, Kind, nn};

/// How the metadata's keys of this program begin.
const OURS: &str = "globalsplat.";
/// The metadata's key for the configuration, as TOML.
pub const CONFIG_KEY: &str = "globalsplat.config";
/// The metadata's key for the version of this program that wrote the file.
const VERSION_KEY: &str = "globalsplat.version";
/// The metadata's key for the stage that the weights were trained to, as JSON, where it isn't the final one.
pub const STAGE_KEY: &str = "globalsplat.stage";

/// How weights are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelDtype {
    /// Exactly.
    F32,
    /// In half the bytes, with 8 bits of mantissa.
    BF16,
}

/// A model from a file.
#[derive(Debug)]
pub struct LoadedModel {
    /// Built as the file says.
    pub model: GlobalSplat,
    /// As the file says.
    pub config: Config,
    /// To which the weights were trained: the final one, unless the file says otherwise.
    pub stage: Stage,
    /// Holds the weights, those of products in the precision of passes.
    pub vs: nn::VarStore,
    /// What weights lie in that weren't copied: nobody should write to these.
    pub lent: Option<LentWeights>,
    /// For what a file without a configuration is taken.
    pub assumed: Option<String>,
}

/// What a file of the model holds: the variables of `vs`, which were trained to `stage`, and `config`.
pub fn model_weights(vs: &nn::VarStore, config: &Config, stage: Stage, dtype: ModelDtype) -> Weights {
    let kind = match dtype {
        ModelDtype::F32 => Kind::Float,
        ModelDtype::BF16 => Kind::BFloat16,
    };
    let tensors = vs.variables().into_iter().map(|(name, t)| (name, t.to_kind(kind))).collect();
    let text = |key: &str, value: &str| (key.to_string(), value.to_string());
    let mut metadata = HashMap::from([
        text(CONFIG_KEY, &config.to_toml()),
        text(VERSION_KEY, env!("CARGO_PKG_VERSION")),
        // Libraries of Hugging Face ask for it.
        text("format", "pt"),
    ]);
    if stage != config.curriculum.final_stage() {
        metadata.insert(STAGE_KEY.into(), serde_json::to_string(&stage).expect("two numbers"));
    }
    Weights { tensors, metadata }
}

/// Writes [`model_weights`] as one safetensors file, whole or not at all.
///
/// # Errors
/// The system's refusal to write.
pub fn save_model(
    path: &Path,
    vs: &nn::VarStore,
    config: &Config,
    stage: Stage,
    dtype: ModelDtype,
) -> Result<()> {
    let Weights { tensors, metadata } = model_weights(vs, config, stage, dtype);
    write_weights(path, &tensors, metadata)
}

/// Writes `weights`, as [`model_weights`] has them, as a checkpoint of the layout that the authors' have, with their configuration
/// beside them.
///
/// # Errors
/// The system's refusal to write.
pub fn save_checkpoint(path: &Path, weights: Weights) -> Result<()> {
    let named = |(name, tensor)| (format!("{CHECKPOINT_PREFIX}{name}"), tensor);
    let tensors = weights.tensors.into_iter().map(named).collect();
    let metadata = weights.metadata.into_iter().filter(|(key, _)| key.starts_with(OURS)).collect();
    write_checkpoint(path, &Weights { tensors, metadata })
}

/// The weights that come with this program, which it carries inside: the model of `configs/tiny.toml`, trained on made-up worlds
/// alone. Their card is `models/README.md`.
pub const SHIPPED_MODEL: &str = "models/tiny.safetensors";
const SHIPPED_BYTES: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/tiny.safetensors"));

/// The model that comes with this program, [`SHIPPED_MODEL`], in float32.
///
/// # Errors
/// The device's refusal.
pub fn shipped_model(device: Device) -> Result<LoadedModel> {
    ModelFile::shipped()?.load(device, Precision::F32)
}

/// Rebuilds the model that [`save_model`] wrote, or whose weights alone are known, in float32.
///
/// # Errors
/// A file that can't be read, or whose weights don't fit their configuration or any.
pub fn load_model(path: &Path, device: Device) -> Result<LoadedModel> {
    ModelFile::open(path, &[])?.load(device, Precision::F32)
}

/// A file of a model's weights, of which none is read yet, and what it is a model of.
#[derive(Debug)]
pub struct ModelFile {
    weights: WeightsFile,
    /// As the file says, or as shapes tell.
    pub config: Config,
    /// To which the weights were trained.
    pub stage: Stage,
    /// For what a file without a configuration is taken.
    pub assumed: Option<String>,
    /// Tensors in the file that are none of the model's.
    pub left_out: usize,
}

impl ModelFile {
    /// Looks into whatever [`WeightsFile::open`] knows. `overrides` are for its configuration, as for [`Config::read`].
    ///
    /// # Errors
    /// A file that can't be read, or is of no model; overrides that don't fit.
    pub fn open(path: &Path, overrides: &[String]) -> Result<Self> {
        Self::of(WeightsFile::open(path)?, overrides)
    }

    /// Looks into the weights that come with this program, [`SHIPPED_MODEL`].
    ///
    /// # Errors
    /// None, unless they are damaged.
    pub fn shipped() -> Result<Self> {
        Self::of(WeightsFile::carried(SHIPPED_BYTES, Path::new(SHIPPED_MODEL))?, &[])
    }

    /// The same of a file that is open.
    ///
    /// # Errors
    /// As there.
    pub fn of(weights: WeightsFile, overrides: &[String]) -> Result<Self> {
        let path = weights.path().to_owned();
        let text = weights.metadata().get(CONFIG_KEY).cloned();
        let stage = weights.metadata().get(STAGE_KEY).cloned();
        // What `export` wrote as safetensors has the model's names and no others.
        let (weights, left_out) = match text.is_some() && weights.names().any(is_ours) {
            true => (weights, 0),
            false => model_tensors(weights)?,
        };
        let has_configuration = text.is_some();
        let text = match text {
            Some(text) => text,
            None => configuration(&weights)?.to_toml(),
        };
        let config = Config::parse(&text, overrides, &path)?;
        let assumed = (!has_configuration).then(|| assumed(&weights, &config));
        let stage = match stage {
            Some(text) => read_stage(&path, &text, &config)?,
            None => config.curriculum.final_stage(),
        };
        Ok(ModelFile { weights, config, stage, assumed, left_out })
    }

    /// Copies the weights into the variables of `vs`.
    ///
    /// # Errors
    /// Those of another model.
    pub fn load_into(&self, vs: &nn::VarStore) -> Result<()> {
        self.weights.load_into(vs)
    }

    /// Builds the model for passes in `precision`.
    ///
    /// # Errors
    /// Weights that don't fit the configuration.
    pub fn load(self, device: Device, precision: Precision) -> Result<LoadedModel> {
        self.build(device, precision, |weights, vs| weights.load_into(vs).map(|()| None))
    }

    /// The same for passes alone: on the CPU, weights that products take as they are on disk stay there, and the system reads them as
    /// they are needed. The file mustn't be changed in its place meanwhile.
    ///
    /// # Errors
    /// As there.
    pub fn lend(self, device: Device, precision: Precision) -> Result<LoadedModel> {
        match device {
            Device::Cpu => self.build(device, precision, |weights, vs| weights.lend_to(vs).map(Some)),
            _ => self.load(device, precision),
        }
    }

    fn build(
        self,
        device: Device,
        precision: Precision,
        fill: impl FnOnce(WeightsFile, &nn::VarStore) -> Result<Option<LentWeights>>,
    ) -> Result<LoadedModel> {
        // Before a model of whatever size is made.
        let numbers: i64 =
            self.weights.shapes().values().map(|(_, shape)| shape.iter().product::<i64>()).sum();
        let least = self.config.model.least_parameters();
        if numbers < least {
            let expected = format!("{least} or more, as its configuration says");
            return Err(Error::input(self.weights.path(), "the number of weights", numbers, expected));
        }
        let mut vs = nn::VarStore::new(device);
        let mut model = GlobalSplat::to_be_filled(&mut vs, &self.config.model, precision)?;
        let ModelFile { weights, config, stage, assumed, .. } = self;
        let lent = fill(weights, &vs)?;
        if device != Device::Cpu {
            model.fold_weights();
        }
        Ok(LoadedModel { model, config, stage, vs, lent, assumed })
    }
}

fn read_stage(path: &Path, text: &str, config: &Config) -> Result<Stage> {
    let most = config.curriculum.final_stage;
    let is_known = |stage: &Stage| stage.index <= most && (0. ..=1.).contains(&stage.mix);
    serde_json::from_str(text).ok().filter(is_known).ok_or_else(|| {
        let expected = format!("{{\"index\": 0 to {most}, \"mix\": 0 to 1}}");
        Error::input(path, format!("metadata {STAGE_KEY}"), text, expected)
    })
}
