//! The commands `export` and `import`, which write weights.

use super::{Output, model};
use crate::config::Config;
use crate::io::{InputFiles, check_writable_file, write_weights};
use crate::model::{GlobalSplat, Precision};
use crate::reconstruct::{LoadedModel, ModelFile, load_model, model_weights, save_checkpoint};
use crate::train::{MODEL_FILE, add_run_inputs, best_checkpoint, latest_checkpoint};
use anyhow::Result;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{ArgGroup, Args, ValueEnum};
use serde_json::json;
use std::path::PathBuf;
use tch::{Device, nn};

/// Write weights with their configuration, as safetensors or as a checkpoint for torch: a run's newest or best, or those of any file.
#[derive(Args)]
#[command(group(ArgGroup::new("source").required(true)))]
#[command(
    after_help = "Examples:\n  globalsplat export --run runs/first_light --out model.safetensors --dtype bf16\n  \
    globalsplat export --run runs/first_light --format torch --out model.ckpt"
)]
pub struct Export {
    /// Folder of a run
    #[arg(long, value_name = "RUN", group = "source")]
    run: Option<PathBuf>,
    /// Export the run's best weights by validation, instead of the newest
    #[arg(long, conflicts_with_all = ["config", "weights"])]
    best: bool,
    /// Export the weights of this file: safetensors or a checkpoint
    #[arg(long, value_name = "FILE", group = "source")]
    weights: Option<PathBuf>,
    /// Export newly initialized weights of a configuration instead, as at the start of training
    #[arg(long, value_name = "FILE", group = "source")]
    config: Option<PathBuf>,
    /// Format: safetensors, or a checkpoint that torch.load reads, in the authors' layout
    #[arg(long, value_enum, default_value = "safetensors")]
    format: Format,
    #[command(flatten)]
    out: WeightsOut,
}

impl Export {
    pub fn run(self) -> Result<Output> {
        let mut inputs = InputFiles::default();
        self.run.iter().for_each(|run| add_run_inputs(run, &mut inputs));
        self.weights.iter().for_each(|weights| inputs.add(weights));
        self.config.iter().for_each(|config| inputs.add(config));
        self.out.check(&inputs)?;
        let weights = match &self.run {
            Some(run) if self.best => Some(best_checkpoint(run)?.join(MODEL_FILE)),
            Some(run) => Some(latest_checkpoint(run)?.join(MODEL_FILE)),
            None => self.weights.clone(),
        };
        if let Some(weights) = weights {
            return self.out.write(load_model(&weights, Device::Cpu)?, self.format, 0);
        }
        let config = Config::read(self.config.as_ref().expect("clap asks for one of the three"), &[])?;
        tch::manual_seed(config.train.seed as i64);
        let vs = nn::VarStore::new(Device::Cpu);
        let model = GlobalSplat::new(&vs.root(), &config.model)?;
        let stage = config.curriculum.final_stage();
        self.out.write(LoadedModel { model, config, stage, vs, assumed: None }, self.format, 0)
    }
}

/// Convert weights from the authors' checkpoint or any state dict to safetensors with a configuration.
///
/// The model's shape is inferred from the tensors; optimizer state, other networks and settings beside them are ignored.
/// Nothing in the file is executed: a file that would run code in Python is refused. Settings that shapes don't determine, the
/// number of attention heads and the final stage of the model, default to the paper's and are reported; --set overrides them.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat import --from globalsplat_16k.ckpt --out model.safetensors\n  \
    globalsplat import --from dense_32k.ckpt --set curriculum.final_stage=4 --out model.safetensors"
)]
pub struct Import {
    /// File that torch.save or Lightning wrote, or a safetensors file with or without a configuration
    #[arg(long, value_name = "FILE")]
    from: PathBuf,
    /// Override a key of the configuration, as in model.heads=4; may be given more than once
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    out: WeightsOut,
}

impl Import {
    pub fn run(self) -> Result<Output> {
        let mut inputs = InputFiles::default();
        inputs.add(&self.from);
        self.out.check(&inputs)?;
        let file = ModelFile::open(&self.from, &self.set)?;
        let left_out = file.left_out;
        self.out.write(file.load(Device::Cpu, Precision::F32)?, Format::Safetensors, left_out)
    }
}

#[derive(Args)]
struct WeightsOut {
    /// Output file
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Data type of the stored weights
    #[arg(long, default_value = "f32", value_parser = PossibleValuesParser::new(["f32", "bf16"]).try_map(|dtype| dtype.parse::<Precision>()))]
    dtype: Precision,
}

/// File format of weights.
#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Format {
    Safetensors,
    /// A checkpoint for torch.load, in the authors' layout
    Torch,
}

impl WeightsOut {
    /// Returns an error, before the work, if the output couldn't be written, or would replace one of `inputs`.
    fn check(&self, inputs: &InputFiles) -> Result<()> {
        check_writable_file(&self.out)?;
        Ok(inputs.check_file(&self.out)?)
    }

    /// Writes the weights of `loaded`, and reports it with the number of tensors that were left out of its file.
    fn write(&self, loaded: LoadedModel, format: Format, left_out: usize) -> Result<Output> {
        let LoadedModel { config, stage, vs, assumed, .. } = loaded;
        let weights = model_weights(&vs, &config, stage, self.dtype);
        match format {
            Format::Safetensors => write_weights(&self.out, &weights.tensors, weights.metadata)?,
            Format::Torch => save_checkpoint(&self.out, weights)?,
        }
        let (out, bytes) = (self.out.to_string_lossy(), std::fs::metadata(&self.out)?.len());
        let parameters: usize = vs.trainable_variables().iter().map(|t| t.numel()).sum();
        let notes = [
            model::early_stage(stage, &config),
            assumed.as_ref().map(|assumed| format!("taken for {assumed}")),
            (left_out > 0).then(|| format!("{left_out} other tensors left out")),
        ];
        let notes: String = notes.into_iter().flatten().map(|note| format!(", {note}")).collect();
        Ok(Output::new(
            json!({
                "weights": out, "parameters": parameters, "bytes": bytes, "stage": stage,
                "taken_for": assumed, "left_out": left_out,
            }),
            format!("{out}: {parameters} parameters, {:.1} MB{notes}", bytes as f64 / 1e6),
        ))
    }
}
