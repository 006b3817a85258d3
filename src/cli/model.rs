//! `--weights` and `--precision f32|bf16`.

use globalsplat::reconstruct::{LoadedModel, load_model};
use globalsplat::{Error, Result};
use std::path::Path;
use tch::Device;

/// Reads the model in `weights`, which computes in `precision` from then on.
pub fn load(weights: &Path, precision: &str, device: Device) -> Result<LoadedModel> {
    let precision = precision.parse().map_err(|e| Error::Request(format!("--precision: {e}")))?;
    let mut loaded = load_model(weights, device)?;
    loaded.model.set_precision(precision);
    Ok(loaded)
}
