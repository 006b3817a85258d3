//! A model as one safetensors file that rebuilds it: the weights, and the configuration in the metadata (spec 10.10).

use crate::config::Config;
use crate::error::{Error, Result};
use crate::io::{Weights, read_weights, weights_from, write_weights};
use crate::model::{GlobalSplat, Stage};
use std::collections::HashMap;
use std::path::Path;
use tch::{Device, Kind, Tensor, nn};

/// The metadata's key for the configuration, as TOML.
pub const CONFIG_KEY: &str = "globalsplat.config";
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
    /// Holds the weights.
    pub vs: nn::VarStore,
}

/// Writes the variables of `vs`, which were trained to `stage`, and `config`, whole or not at all.
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
    let stored = |t: Tensor| match dtype {
        ModelDtype::F32 => t.to_kind(Kind::Float),
        ModelDtype::BF16 => t.to_kind(Kind::BFloat16),
    };
    let tensors = vs.variables().into_iter().map(|(name, t)| (name, stored(t))).collect();
    let mut metadata = HashMap::from([(CONFIG_KEY.to_string(), config.to_toml())]);
    if stage != config.curriculum.final_stage() {
        metadata.insert(STAGE_KEY.into(), serde_json::to_string(&stage).expect("two numbers"));
    }
    write_weights(path, &tensors, metadata)
}

/// The weights that come with this program, which it carries inside: the model of `configs/tiny.toml`, trained on made-up worlds
/// alone. Their card is `models/README.md`.
pub const SHIPPED_MODEL: &str = "models/tiny.safetensors";
const SHIPPED_BYTES: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/tiny.safetensors"));

/// The model that comes with this program, [`SHIPPED_MODEL`].
///
/// # Errors
/// The device's refusal.
pub fn shipped_model(device: Device) -> Result<LoadedModel> {
    let name = Path::new(SHIPPED_MODEL);
    rebuild(&weights_from(SHIPPED_BYTES, name)?, name, device)
}

/// Rebuilds the model that [`save_model`] wrote, in float32.
///
/// # Errors
/// A file that can't be read, has no configuration, or whose weights don't fit it.
pub fn load_model(path: &Path, device: Device) -> Result<LoadedModel> {
    rebuild(&read_weights(path)?, path, device)
}

fn rebuild(weights: &Weights, path: &Path, device: Device) -> Result<LoadedModel> {
    let config = weights.metadata.get(CONFIG_KEY).ok_or_else(|| {
        Error::input(
            path,
            format!("metadata {CONFIG_KEY}"),
            "absent",
            "weights that `globalsplat export` wrote",
        )
    })?;
    let config = Config::parse(config, &[], path)?;
    // Before a model of whatever size is made.
    let numbers: usize = weights.tensors.values().map(Tensor::numel).sum();
    let least = config.model.least_parameters();
    if (numbers as i64) < least {
        let expected = format!("{least} or more, as its configuration says");
        return Err(Error::input(path, "the number of weights", numbers, expected));
    }
    let vs = nn::VarStore::new(device);
    let model = GlobalSplat::new(&vs.root(), &config.model)?;
    weights.load_into(&vs, path)?;
    let stage = match weights.metadata.get(STAGE_KEY) {
        Some(text) => read_stage(path, text, &config)?,
        None => config.curriculum.final_stage(),
    };
    Ok(LoadedModel { model, config, stage, vs })
}

fn read_stage(path: &Path, text: &str, config: &Config) -> Result<Stage> {
    let most = config.curriculum.final_stage;
    let is_known = |stage: &Stage| stage.index <= most && (0. ..=1.).contains(&stage.mix);
    serde_json::from_str(text).ok().filter(is_known).ok_or_else(|| {
        let expected = format!("{{\"index\": 0 to {most}, \"mix\": 0 to 1}}");
        Error::input(path, format!("metadata {STAGE_KEY}"), text, expected)
    })
}
