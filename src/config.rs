//! A run's configuration: one TOML file, every key with the paper's value as its default. Unknown keys are errors.

use crate::data::{Holdout, ImageSize, JitterConfig, Sampling};
use crate::error::{Error, Result};
use crate::io::{find_pretrained, pretrained_folders};
use crate::loss::{LpipsNetwork, PerceptualKind};
use crate::model::{ModelConfig, Precision, Stage};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

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

/// Captures and views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Captures, folders of captures, or data sets of chunks, of which the part `train` is taken. `${NAME}` and `${NAME:-default}` stand for environment variables.
    pub captures: Vec<String>,
    /// [height, width] that images are fitted to.
    pub image_size: ImageSize,
    /// Views the model sees of a scene in a training step.
    pub context_views: usize,
    /// Views it is asked for of a scene in a training step.
    pub target_views: usize,
    /// [shortest, longest] part of a video, in frames, that the views of a training step are from, at most the whole of it. A
    /// video that is shorter than the shortest is skipped.
    pub window: [usize; 2],
    /// How context views are chosen: `uniform` or `farthest`.
    pub sampling: Sampling,
    /// The part of a photo that is shown in training is smaller than it could be by a factor of 1 to 1 + this.
    pub extra_crop: f64,
    /// Whether every other sample in training is mirrored.
    pub flip: bool,
    /// How far training changes colours.
    pub jitter: JitterConfig,
    /// Views never shown in training, which validation asks for.
    pub holdout: Holdout,
    /// What validation asks for besides: captures, folders of captures, or data sets, of which the part `test` is taken.
    pub validation: Vec<String>,
    /// Scenes of `validation` at most, spread evenly over all of them.
    pub validation_scenes: usize,
    /// Share of the scenes that may be unusable before training fails: too short, or broken in any way.
    pub max_bad_share: f64,
    /// Threads that load; 0 for one a core.
    pub threads: usize,
    /// Scenes that are loaded ahead.
    pub ahead: usize,
    /// Decoded photos are kept where all of them together take no more than this, in 10⁶ bytes.
    pub photo_megabytes: u64,
}

impl Default for DataConfig {
    fn default() -> Self {
        DataConfig {
            captures: vec![],
            image_size: [256, 256].into(),
            context_views: 24,
            target_views: 12,
            window: [40, 220],
            sampling: Sampling::Uniform,
            extra_crop: 0.1,
            flip: false,
            jitter: JitterConfig::default(),
            holdout: Holdout::None,
            validation: vec![],
            validation_scenes: 8,
            max_bad_share: 0.25,
            threads: 0,
            ahead: 32,
            photo_megabytes: 1000,
        }
    }
}

/// The coarse-to-fine curriculum (SPEC section 8).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CurriculumConfig {
    /// The stage that training ends in and inference uses: 2^s Gaussians per scene token.
    pub final_stage: u32,
    /// Steps at which stages 1, 2, … begin. Those beyond the final stage are ignored.
    pub boundaries: Vec<u64>,
    /// Steps over which λ goes from 0 to 1 after a boundary.
    pub transition: u64,
    /// The final stage from the first step: an ablation.
    pub full_capacity: bool,
}

impl Default for CurriculumConfig {
    fn default() -> Self {
        CurriculumConfig {
            final_stage: 3,
            boundaries: vec![10_000, 20_000, 50_000],
            transition: 2_000,
            full_capacity: false,
        }
    }
}

impl CurriculumConfig {
    /// The stage of inference.
    pub fn final_stage(&self) -> Stage {
        Stage::complete(self.final_stage)
    }
}

/// The factors of the loss (SPEC section 7).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Mean squared error of the rendered colours.
    pub mse: f64,
    /// The network that compares pictures as people see them: `none`, `vgg19`, `lpips_vgg` or `lpips_alex`.
    pub perceptual: PerceptualKind,
    /// What its difference counts.
    pub perceptual_factor: f64,
    /// The file of its weights; by default the network's own name in the folders where `make weights` puts them. `${NAME}` and `${NAME:-default}` stand for environment variables.
    pub perceptual_weights: String,
    /// Difference of the two subsets' accumulated opacities. Without this and the next, all context views go together.
    pub consistency_alpha: f64,
    /// Difference of the two subsets' depths.
    pub consistency_depth: f64,
    /// Frustum constraint on the Gaussians' centres.
    pub frustum: f64,
    /// L_dec, which has its own 1e-2 inside.
    pub decoder: f64,
    /// Whether L_dec has its opacity term.
    pub decoder_opacity: bool,
}

impl LossConfig {
    /// Whether the context is split into two subsets that have to agree.
    pub fn has_consistency(&self) -> bool {
        self.consistency_alpha > 0. || self.consistency_depth > 0.
    }

    /// `perceptual_weights` with environment variables filled in; where it is empty, the file that `make weights` makes, or
    /// would be called.
    ///
    /// # Errors
    /// A variable that isn't set and has no default.
    pub fn perceptual_weights(&self) -> Result<PathBuf> {
        if !self.perceptual_weights.is_empty() {
            return expand(&self.perceptual_weights).map(PathBuf::from);
        }
        let name = match self.perceptual {
            PerceptualKind::LpipsVgg => LpipsNetwork::Vgg16.file_name(),
            PerceptualKind::LpipsAlex => LpipsNetwork::AlexNet.file_name(),
            PerceptualKind::Vgg19 | PerceptualKind::None => "vgg19.safetensors",
        };
        Ok(find_pretrained(name).unwrap_or_else(|| pretrained_folders()[0].join(name)))
    }
}

impl Default for LossConfig {
    fn default() -> Self {
        LossConfig {
            mse: 2.,
            perceptual: PerceptualKind::Vgg19,
            perceptual_factor: 1.,
            perceptual_weights: String::new(),
            consistency_alpha: 1e-3,
            consistency_depth: 1e-2,
            frustum: 1e-2,
            decoder: 1.,
            decoder_opacity: false,
        }
    }
}

/// Optimizer, schedule and bookkeeping.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Of initial weights and of everything drawn.
    pub seed: u64,
    /// Optimizer steps.
    pub steps: u64,
    /// Scenes in a step.
    pub batch: usize,
    /// Scenes that go through the model at a time, for less memory; the gradient is that of the whole step. 0 for all at
    /// once. With `loss.consistency_depth`, whose mean is over pixels that only pictures tell, it takes a forward pass more.
    pub micro_batch: usize,
    /// Whether the encoder keeps nothing of a round but what it began with, and computes the round again in the backward
    /// pass: less memory, a fifth more time.
    pub checkpoint_rounds: bool,
    /// `f32`, or `bf16` for the encoder's matrix products, which is faster for wide models where the machine has instructions
    /// for it.
    pub precision: Precision,
    /// Peak learning rate.
    pub learning_rate: f64,
    /// Share of the steps over which the learning rate rises.
    pub warmup: f64,
    /// Of weights with two or more dimensions.
    pub weight_decay: f64,
    /// Largest norm of the gradient.
    pub gradient_clip: f64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Checkpoints kept.
    pub keep_checkpoints: usize,
    /// Steps between validations; 0 for one at the end alone.
    pub validate_every: u64,
    /// Steps in a row that may be skipped, because their loss or gradient isn't finite, before training fails.
    pub max_skipped: u64,
    /// Steps between numbers for TensorBoard; `metrics.jsonl` has those of every step.
    pub log_every: u64,
    /// Steps between pictures for TensorBoard; 0 for none.
    pub pictures_every: u64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        TrainConfig {
            seed: 0,
            steps: 220_000,
            batch: 16,
            micro_batch: 0,
            checkpoint_rounds: false,
            precision: Precision::F32,
            learning_rate: 5e-4,
            warmup: 0.03,
            weight_decay: 1e-6,
            gradient_clip: 1.,
            checkpoint_every: 1_000,
            keep_checkpoints: 2,
            validate_every: 5_000,
            max_skipped: 20,
            log_every: 10,
            pictures_every: 1_000,
        }
    }
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
        let refuse = |field: &str, found: String, expected: String| {
            Err(Error::Request(format!("{field} is {found}, expected {expected}")))
        };
        let CurriculumConfig { final_stage, boundaries, full_capacity, .. } = &self.curriculum;
        if *final_stage > self.model.max_stage() {
            let expected =
                format!("{} at most: model.candidates is {}", self.model.max_stage(), self.model.candidates);
            return refuse("curriculum.final_stage", final_stage.to_string(), expected);
        }
        if !full_capacity && boundaries.len() < *final_stage as usize {
            let expected = format!("a step for each of the {final_stage} stages after the first");
            return refuse("curriculum.boundaries", format!("{boundaries:?}"), expected);
        }
        if !boundaries.is_sorted() {
            return refuse("curriculum.boundaries", format!("{boundaries:?}"), "ascending steps".into());
        }
        for (field, value) in [
            ("train.batch", self.train.batch),
            ("train.checkpoint_every", self.train.checkpoint_every as usize),
            ("train.keep_checkpoints", self.train.keep_checkpoints),
            ("train.max_skipped", self.train.max_skipped as usize),
            ("train.log_every", self.train.log_every as usize),
        ] {
            if value == 0 {
                return refuse(field, "0".into(), "1 or more".into());
            }
        }
        for (field, value) in [
            ("train.learning_rate", self.train.learning_rate),
            ("train.gradient_clip", self.train.gradient_clip),
        ] {
            if !(value > 0. && value.is_finite()) {
                return refuse(field, value.to_string(), "a number above 0".into());
            }
        }
        let LossConfig {
            mse, perceptual_factor, consistency_alpha, consistency_depth, frustum, decoder, ..
        } = self.loss;
        for (field, value) in [
            ("train.weight_decay", self.train.weight_decay),
            ("loss.mse", mse),
            ("loss.perceptual_factor", perceptual_factor),
            ("loss.consistency_alpha", consistency_alpha),
            ("loss.consistency_depth", consistency_depth),
            ("loss.frustum", frustum),
            ("loss.decoder", decoder),
        ] {
            if !(value >= 0. && value.is_finite()) {
                return refuse(field, value.to_string(), "0 or more".into());
            }
        }
        let DataConfig { window: [shortest, longest], jitter, .. } = self.data;
        if shortest > longest {
            return refuse("data.window", format!("[{shortest}, {longest}]"), "[shortest, longest]".into());
        }
        for (field, views) in
            [("data.context_views", self.data.context_views), ("data.target_views", self.data.target_views)]
        {
            if !(1..=shortest).contains(&views) {
                let expected = format!("1 to the {shortest} frames of the shortest window, data.window");
                return refuse(field, views.to_string(), expected);
            }
        }
        for (field, value, largest) in [
            ("data.extra_crop", self.data.extra_crop, 4.),
            ("data.jitter.brightness", jitter.brightness, f64::MAX),
            ("data.jitter.contrast", jitter.contrast, f64::MAX),
            ("data.jitter.saturation", jitter.saturation, f64::MAX),
            ("data.jitter.hue", jitter.hue, 0.5),
            ("data.max_bad_share", self.data.max_bad_share, 1.),
        ] {
            if !(0. ..=largest).contains(&value) {
                let expected =
                    if largest < f64::MAX { format!("0 to {largest}") } else { "0 or more".into() };
                return refuse(field, value.to_string(), expected);
            }
        }
        if !(0. ..=1.).contains(&self.train.warmup) {
            return refuse("train.warmup", self.train.warmup.to_string(), "a share from 0 to 1".into());
        }
        Ok(())
    }
}

impl DataConfig {
    /// `captures` with environment variables filled in.
    ///
    /// # Errors
    /// A variable that isn't set and has no default.
    pub fn capture_paths(&self) -> Result<Vec<PathBuf>> {
        expand_paths(&self.captures)
    }

    /// Everything that validation's scores depend on.
    pub(crate) fn validation_settings(&self) -> String {
        let scenes = (&self.captures, &self.holdout, &self.validation, self.validation_scenes);
        let views = (self.image_size, self.context_views, self.target_views, self.window);
        serde_json::to_string(&(scenes, views)).expect("numbers and strings")
    }

    /// `validation` with environment variables filled in.
    ///
    /// # Errors
    /// As [`DataConfig::capture_paths`].
    pub fn validation_paths(&self) -> Result<Vec<PathBuf>> {
        expand_paths(&self.validation)
    }
}

fn expand_paths(paths: &[String]) -> Result<Vec<PathBuf>> {
    paths.iter().map(|path| expand(path).map(PathBuf::from)).collect()
}

/// Fills in `${NAME}` and `${NAME:-default}`.
fn expand(text: &str) -> Result<String> {
    let Some((before, rest)) = text.split_once("${") else { return Ok(text.to_string()) };
    let Some((inside, after)) = rest.split_once('}') else { return Ok(text.to_string()) };
    let (name, default) = match inside.split_once(":-") {
        Some((name, default)) => (name, Some(default.to_string())),
        None => (inside, None),
    };
    let value = std::env::var(name).ok().filter(|v| !v.is_empty()).or(default);
    let value =
        value.ok_or_else(|| Error::Request(format!("{text}: the environment variable {name} is not set")))?;
    Ok(format!("{before}{value}{}", expand(after)?))
}

/// The keys at which two configurations differ, both with every key written out, as "train.batch 2 → 4".
pub(crate) fn changed_keys(before: &str, after: &str) -> Vec<String> {
    let keys = |text: &str| {
        let mut keys = BTreeMap::new();
        flatten("", toml::Value::Table(text.parse().unwrap_or_default()), &mut keys);
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

/// Collects the values in a table of tables by their dotted keys.
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

/// Sets `section.key` of `section.key=value`.
fn override_key(table: &mut toml::Table, assignment: &str) -> Result<()> {
    let refused = || Error::Request(format!("--set {assignment}: expected section.key=value"));
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
