//! `--weights`, `--precision auto|f32|bf16` and `--views-at`.

use super::ranks;
use globalsplat::config::Config;
use globalsplat::model::{Precision, Stage};
use globalsplat::reconstruct::{Input, LoadedModel, ModelFile, SHIPPED_MODEL, ViewsAs};
use globalsplat::scene::ImageSize;
use globalsplat::{Error, Result};
use std::path::Path;
use tch::Device;

/// What `--precision` asks for; nothing is `auto`.
pub fn asked_precision(asked: &str) -> Result<Option<Precision>> {
    if asked == "auto" {
        return Ok(None);
    }
    let precision = asked.parse().map_err(|_| {
        Error::Request(format!("--precision: {asked} is no precision, expected auto, f32 or bf16"))
    })?;
    Ok(Some(precision))
}

/// The precision that is `asked` for, or [`Precision::best_on`] `device` for tokens of `width` numbers. The slower one is told of.
pub fn precision(asked: Option<Precision>, device: Device, width: i64) -> Precision {
    let precision = asked.unwrap_or_else(|| Precision::best_on(device, width));
    if precision == Precision::Bf16 && Precision::fastest_on(device) == Precision::F32 && ranks::is_first() {
        eprintln!("--precision bf16: slower than f32 here, as there are no instructions for it");
    }
    precision
}

/// Reads the model in `weights`, or the one that comes with this program, which computes in [`precision`] from then on.
pub fn load(weights: Option<&Path>, asked: Option<Precision>, device: Device) -> Result<LoadedModel> {
    let file = match weights {
        Some(weights) => ModelFile::open(weights, &[])?,
        None => ModelFile::shipped()?,
    };
    let precision = precision(asked, device, file.config.model.width);
    let loaded = file.lend(device, precision)?;
    if !ranks::is_first() {
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

/// What errors and reports call the weights.
pub fn name(weights: Option<&Path>) -> &Path {
    weights.unwrap_or(Path::new(SHIPPED_MODEL))
}

/// Told where photos are smaller than what they are fitted to.
pub const ENLARGED: &str = "smaller photos are enlarged, which shows no more of the scene";

/// What photos become for a model that was trained with images of `trained`.
pub fn shown_as(input: Input, trained: ImageSize) -> String {
    let pixels = |size: ImageSize| format!("{}×{} pixels", size.width, size.height);
    let (photo, trained, views) =
        (pixels(input.photo_size(trained)), pixels(trained), input.views_of_photo());
    match input.views_as() {
        _ if input.is_plain() => format!("the {trained} that the model sees"),
        ViewsAs::Polyphase => format!("{photo}, {views} views of the {trained} that the model sees"),
        ViewsAs::Whole => {
            format!("{photo}, a view of more than the {trained} that the model was trained with")
        }
        ViewsAs::Repeated => format!("the {trained} that the model sees, {views} times the same view"),
    }
}

/// What is to be told of weights whose training was stopped on the way.
pub fn early_stage(stage: Stage, config: &Config) -> Option<String> {
    let last = config.curriculum.final_stage();
    let Stage { index, mix } = stage;
    (stage != last)
        .then(|| format!("the weights were trained to stage {index} (λ {mix:.2}) of {}", last.index))
}
