//! Weights without a configuration of this program: the authors' checkpoints, and other state dicts (spec 10.16).

use crate::config::Config;
use crate::error::{Error, Result};
use crate::io::WeightsFile;
use crate::model::{MODULES, ModelConfig};
use std::collections::BTreeMap;

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
pub(super) const CHECKPOINT_PREFIX: &str = "model.";
/// Name of a parameter that every model has. Its prefix in a file is that of the model.
const ANCHOR: &str = "scene_tokens";
/// Name components that torch's wrappers add: DistributedDataParallel and compile.
const WRAPPERS: [&str; 2] = ["module", "_orig_mod"];

/// Returns `true` if the model may have a parameter of this name.
pub(super) fn is_ours(name: &str) -> bool {
    name.split('.').next().is_some_and(|module| MODULES.contains(&module))
}

/// Returns the model's tensors under the model's own names, and the number of other tensors in the file. In a checkpoint the names begin
/// with `model.`, and other networks, such as those of a loss, are stored beside them.
///
/// # Errors
/// Fails if the file holds no model.
pub(super) fn model_tensors(file: WeightsFile) -> Result<(WeightsFile, usize)> {
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
///
/// # Errors
/// Fails if the shapes fit no model.
pub(super) fn configuration(file: &WeightsFile) -> Result<Config> {
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
pub(super) fn assumed(file: &WeightsFile, config: &Config) -> String {
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
