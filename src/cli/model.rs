//! Shared code for `--weights` and `--precision auto|f32|bf16`.

use super::distributed;
use crate::config::Config;
use crate::model::{Precision, Stage};
use crate::reconstruct::{BUNDLED_MODEL, LoadedModel, ModelFile};
use crate::{Error, Result};
use std::path::Path;
use tch::Device;

/// Parses `--precision`; `auto` gives `None`.
pub fn parse_precision(requested: &str) -> Result<Option<Precision>> {
    if requested == "auto" {
        return Ok(None);
    }
    let precision = requested.parse().map_err(|_| {
        Error::request(format!("--precision: {requested} is no precision, expected auto, f32 or bf16"))
    })?;
    Ok(Some(precision))
}

/// Returns the precision `requested`, or [`Precision::best_on`] `device` for tokens of `width` elements. Warns if bf16 is the
/// slower one.
pub fn precision(requested: Option<Precision>, device: Device, width: i64) -> Precision {
    let precision = requested.unwrap_or_else(|| Precision::best_on(device, width));
    if precision == Precision::Bf16
        && Precision::fastest_on(device) == Precision::F32
        && distributed::is_main_process()
    {
        eprintln!("--precision bf16: slower than f32 here, as there are no instructions for it");
    }
    precision
}

/// Loads the model in `weights`, or the one embedded in this program, to compute in [`precision`].
pub fn load(weights: Option<&Path>, requested: Option<Precision>, device: Device) -> Result<LoadedModel> {
    let file = ModelFile::open_or_bundled(weights)?;
    let precision = precision(requested, device, file.config.model.width);
    let loaded = file.load(device, precision)?;
    if !distributed::is_main_process() {
        return Ok(loaded);
    }
    if let Some(assumed) = &loaded.assumed {
        eprintln!("{}: taken for {assumed}; `globalsplat import` can say otherwise", name(weights).display());
    }
    if let Some(early) = early_stage(loaded.stage, &loaded.config) {
        eprintln!("{}: {early}, and are used so", name(weights).display());
    }
    Ok(loaded)
}

/// Returns the name of the weights in errors and reports.
pub fn name(weights: Option<&Path>) -> &Path {
    weights.unwrap_or(Path::new(BUNDLED_MODEL))
}

/// Warning for photos that are smaller than the size they are resized to.
pub const ENLARGED: &str = "smaller photos are enlarged, which shows no more of the scene";

/// Returns a warning about weights whose training was stopped before the final stage.
pub fn early_stage(stage: Stage, config: &Config) -> Option<String> {
    let last = config.curriculum.final_stage();
    let Stage { index, mix } = stage;
    (stage != last)
        .then(|| format!("the weights were trained to stage {index} (λ {mix:.2}) of {}", last.index))
}
