//! Model stored in one safetensors file that rebuilds it: the weights, and the configuration in the metadata (spec 10.10). The
//! configuration of other weights is inferred from their shapes (spec 10.16).

use crate::config::Config;
use crate::error::{Error, Result};
use crate::io::{Weights, WeightsFile, write_checkpoint, write_weights};
use crate::model::{GlobalSplat, MODULES, ModelConfig, Precision, Stage};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use tch::{Device, nn};

/// Prefix of this program's metadata keys.
const OURS: &str = "globalsplat.";
/// Metadata key of the configuration, as TOML.
pub const CONFIG_KEY: &str = "globalsplat.config";
/// Metadata key of the version of this program that wrote the file.
const VERSION_KEY: &str = "globalsplat.version";
/// Metadata key of the stage that the weights were trained to, as JSON. Written only if it isn't the final stage.
pub const STAGE_KEY: &str = "globalsplat.stage";

/// Model that was loaded from a file.
#[derive(Debug)]
pub struct LoadedModel {
    /// Network, built from the file's configuration.
    pub model: GlobalSplat,
    /// Configuration from the file.
    pub config: Config,
    /// Stage that the weights were trained to: the final stage, unless the file has another.
    pub stage: Stage,
    /// Weights of the network. Those of linear layers are in the precision of passes.
    pub vs: nn::VarStore,
    /// Description of the assumed model, if the file has no configuration.
    pub assumed: Option<String>,
}

/// Returns the content of a model file: the variables of `vs`, which were trained to `stage`, and `config`. float32 stores weights exactly;
/// bf16 takes half the bytes.
pub fn model_weights(vs: &nn::VarStore, config: &Config, stage: Stage, precision: Precision) -> Weights {
    let tensors = vs.variables().into_iter().map(|(name, t)| (name, t.to_kind(precision.kind()))).collect();
    let text = |key: &str, value: &str| (key.to_string(), value.to_string());
    let mut metadata = HashMap::from([
        text(CONFIG_KEY, &config.to_toml()),
        text(VERSION_KEY, env!("CARGO_PKG_VERSION")),
        // Hugging Face libraries expect this key.
        text("format", "pt"),
    ]);
    if stage != config.curriculum.final_stage() {
        metadata.insert(STAGE_KEY.into(), serde_json::to_string(&stage).expect("two numbers"));
    }
    Weights { tensors, metadata }
}

/// Writes [`model_weights`] to one safetensors file atomically.
///
/// # Errors
/// Fails if the file can't be written.
pub fn save_model(
    path: &Path,
    vs: &nn::VarStore,
    config: &Config,
    stage: Stage,
    precision: Precision,
) -> Result<()> {
    let Weights { tensors, metadata } = model_weights(vs, config, stage, precision);
    write_weights(path, &tensors, metadata)
}

/// Writes `weights`, as [`model_weights`] returns them, to a checkpoint with the layout of the authors' checkpoints. The configuration is
/// stored beside the state dict.
///
/// # Errors
/// Fails if the file can't be written.
pub fn save_checkpoint(path: &Path, weights: Weights) -> Result<()> {
    let named = |(name, tensor)| (format!("{CHECKPOINT_PREFIX}{name}"), tensor);
    let tensors = weights.tensors.into_iter().map(named).collect();
    let metadata = weights.metadata.into_iter().filter(|(key, _)| key.starts_with(OURS)).collect();
    write_checkpoint(path, &Weights { tensors, metadata })
}

/// Path of the weights that are embedded in this program: the model of `configs/tiny.toml`, trained on synthetic scenes only. Its model
/// card is `models/README.md`.
pub const BUNDLED_MODEL: &str = "models/tiny.safetensors";
const BUNDLED_BYTES: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/tiny.safetensors"));

/// Loads the model that is embedded in this program, [`BUNDLED_MODEL`], in float32.
///
/// # Errors
/// Fails if the device reports an error.
pub fn bundled_model(device: Device) -> Result<LoadedModel> {
    ModelFile::open_bundled()?.load(device, Precision::F32)
}

/// Loads a model in float32 from a file that [`save_model`] wrote or that holds only weights.
///
/// # Errors
/// Fails if the file can't be read, or if the weights don't fit their configuration or any model.
pub fn load_model(path: &Path, device: Device) -> Result<LoadedModel> {
    ModelFile::open(path, &[])?.load(device, Precision::F32)
}

/// Model file whose weights aren't read yet, and the model that it describes.
#[derive(Debug)]
pub struct ModelFile {
    weights: WeightsFile,
    /// Configuration from the file, or inferred from the shapes of the weights.
    pub config: Config,
    /// Stage that the weights were trained to.
    pub stage: Stage,
    /// Description of the assumed model, if the file has no configuration.
    pub assumed: Option<String>,
    /// Number of tensors in the file that aren't part of the model.
    pub left_out: usize,
}

impl ModelFile {
    /// Opens a file of any format that [`WeightsFile::open`] reads. `overrides` change its configuration, as in [`Config::read`].
    ///
    /// # Errors
    /// Fails if the file can't be read or holds no model, or if overrides don't fit.
    pub fn open(path: &Path, overrides: &[String]) -> Result<Self> {
        Self::from_weights(WeightsFile::open(path)?, overrides)
    }

    /// Opens the weights that are embedded in this program, [`BUNDLED_MODEL`].
    ///
    /// # Errors
    /// Fails only if the embedded weights are damaged.
    pub fn open_bundled() -> Result<Self> {
        Self::from_weights(WeightsFile::from_embedded(BUNDLED_BYTES, Path::new(BUNDLED_MODEL))?, &[])
    }

    /// Opens a file of weights, or the embedded ones if `path` is `None`.
    ///
    /// # Errors
    /// Fails like [`ModelFile::open`].
    pub fn open_or_bundled(path: Option<&Path>) -> Result<Self> {
        path.map_or_else(Self::open_bundled, |path| Self::open(path, &[]))
    }

    /// Reads the configuration and the stage of an open weights file. `overrides` change its configuration, as in [`Config::read`].
    ///
    /// # Errors
    /// Fails if the file holds no model, or if overrides don't fit.
    pub fn from_weights(weights: WeightsFile, overrides: &[String]) -> Result<Self> {
        let path = weights.path().to_owned();
        let text = weights.metadata().get(CONFIG_KEY).cloned();
        let stage = weights.metadata().get(STAGE_KEY).cloned();
        // Safetensors files that `export` wrote contain the model's tensors under their own names and no others.
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
    /// Fails if the weights are those of another model.
    pub fn load_into(&self, vs: &nn::VarStore) -> Result<()> {
        self.weights.load_into(vs)
    }

    /// Builds the model for passes in `precision` and copies the weights to `device`.
    ///
    /// # Errors
    /// Fails if the weights don't fit the configuration.
    pub fn load(self, device: Device, precision: Precision) -> Result<LoadedModel> {
        // Checked before a model of the configured size is allocated.
        let numbers: i64 =
            self.weights.shapes().values().map(|(_, shape)| shape.iter().product::<i64>()).sum();
        let least = self.config.model.least_parameters();
        if numbers < least {
            let expected = format!("{least} or more, as its configuration says");
            return Err(Error::input(self.weights.path(), "the number of weights", numbers, expected));
        }
        let mut vs = nn::VarStore::new(device);
        let mut model = GlobalSplat::uninitialized(&mut vs, &self.config.model, precision)?;
        let ModelFile { weights, config, stage, assumed, .. } = self;
        weights.load_into(&vs)?;
        if device != Device::Cpu {
            model.fold_weights();
        }
        Ok(LoadedModel { model, config, stage, vs, assumed })
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

// Weights without a configuration of this program: the authors' checkpoints, and other state dicts (spec 10.16).

/// Model variants of spec 8.9: name, M, K, and final stage.
const VARIANTS: [(&str, i64, i64, u32); 5] = [
    ("2K", 2048, 2, 0),
    ("2K with few latents", 256, 16, 3),
    ("16K", 2048, 16, 3),
    ("32K", 4096, 16, 3),
    ("32K with dense tokens", 2048, 16, 4),
];
/// Number of steps between the stages after the third, as in `configs/re10k_32k_dense.toml`.
const BOUNDARY: u64 = 30_000;
/// Prefix of the model's parameters in a checkpoint, where the Lightning module has the model as an attribute of this name.
const CHECKPOINT_PREFIX: &str = "model.";
/// Name of a parameter that every model has. Its prefix in a file is that of the model.
const ANCHOR: &str = "scene_tokens";
/// Name components that torch's wrappers add: DistributedDataParallel and compile.
const WRAPPERS: [&str; 2] = ["module", "_orig_mod"];

/// Returns `true` if the model may have a parameter of this name.
fn is_ours(name: &str) -> bool {
    name.split('.').next().is_some_and(|module| MODULES.contains(&module))
}

/// Returns the model's tensors under the model's own names, and the number of other tensors in the file. In a checkpoint the names begin
/// with `model.`, and other networks, such as those of a loss, are stored beside them.
fn model_tensors(file: WeightsFile) -> Result<(WeightsFile, usize)> {
    let plain = |name: &str| {
        let parts: Vec<&str> = name.split('.').filter(|part| !WRAPPERS.contains(part)).collect();
        parts.join(".")
    };
    let names: Vec<String> = file.names().map(plain).collect();
    let prefixes = names.iter().filter_map(|name| name.strip_suffix(ANCHOR));
    let prefixes = prefixes.filter(|prefix| prefix.is_empty() || prefix.ends_with('.'));
    // If there are several models, such as a moving average, this takes the trained one.
    let Some(prefix) =
        prefixes.min_by_key(|prefix| (!prefix.is_empty(), *prefix != CHECKPOINT_PREFIX, prefix.len()))
    else {
        let expected = "weights of a GlobalSplat model, as `globalsplat export` or its authors wrote them";
        return Err(Error::input(file.path(), format!("tensor {ANCHOR}"), "missing", expected));
    };
    let of_model = |name: &str| {
        let name = plain(name).strip_prefix(prefix)?.to_string();
        is_ours(&name).then_some(name)
    };
    let file = file.rename_tensors(of_model);
    let left_out = names.len() - file.names().len();
    Ok((file, left_out))
}

/// Returns the configuration of a model, inferred from its weights.
fn configuration(file: &WeightsFile) -> Result<Config> {
    let shapes: BTreeMap<_, _> = file.shapes().into_iter().map(|(name, (_, shape))| (name, shape)).collect();
    let mut model = ModelConfig::from_shapes(&shapes, file.path())?;
    model.heads = stored_heads(file).unwrap_or_else(|| {
        let halves = std::iter::successors(Some(model.heads), |heads| Some(heads / 2));
        halves.into_iter().find(|heads| model.width % heads == 0).expect("one divides all")
    });
    let mut config = Config { model, ..Default::default() };
    config.model.check().map_err(|e| Error::request(format!("{}: {e}", file.path().display())))?;

    let ModelConfig { latents, candidates, .. } = config.model;
    let known = VARIANTS.iter().find(|&&(_, m, k, _)| (m, k) == (latents, candidates));
    // The published variants leave the last merge to the decoder, whatever K is.
    let stage = known.map_or(candidates.ilog2().saturating_sub(1), |&(.., stage)| stage);
    config.curriculum.final_stage = stage;
    let boundaries = &mut config.curriculum.boundaries;
    while boundaries.len() < stage as usize {
        boundaries.push(boundaries.last().map_or(0, |last| last + BOUNDARY));
    }
    Ok(config)
}

fn stored_heads(file: &WeightsFile) -> Option<i64> {
    file.metadata().get("num_heads").and_then(|heads| heads.parse().ok())
}

/// Describes the model that a file without a configuration is assumed to hold, and says which values the shapes don't determine.
fn assumed(file: &WeightsFile, config: &Config) -> String {
    let ModelConfig { latents, candidates, heads, .. } = config.model;
    let stage = config.curriculum.final_stage;
    let known = VARIANTS.iter().find(|&&(_, m, k, s)| (m, k, s) == (latents, candidates, stage));
    let name = known.map_or(String::new(), |(name, ..)| format!("the variant {name}: "));
    let by_default =
        if stored_heads(file) == Some(heads) { "" } else { ", which the shapes don't determine" };
    format!(
        "{name}{latents} scene tokens of {candidates} candidates at stage {stage}, {} Gaussians, {heads} attention heads{by_default}",
        latents << stage
    )
}
