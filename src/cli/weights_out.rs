//! Output of weights, shared by `export` and `import`.

use super::{model, print_json};
use anyhow::Result;
use clap::{Args, ValueEnum};
use globalsplat::Error;
use globalsplat::config::Config;
use globalsplat::io::{InputFiles, check_writable_file, parent_of, shard_index, write_sharded};
use globalsplat::model::Stage;
use globalsplat::reconstruct::{ModelDtype, model_weights, save_checkpoint};
use serde_json::{Value, json};
use std::path::PathBuf;
use tch::nn;

/// Default maximum size of a shard in bytes, the same as in Hugging Face's libraries.
const MAX_SHARD_SIZE: u64 = 5_000_000_000;

#[derive(Args)]
pub struct WeightsOut {
    /// Output file
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Data type of the stored weights
    #[arg(long, value_enum, default_value = "f32")]
    dtype: Dtype,
    /// Maximum size of a safetensors file, as in 500MB; larger weights are split into several with an index; by default 5GB
    #[arg(long, value_name = "SIZE", value_parser = parse_size)]
    max_shard_size: Option<u64>,
    /// Print the result as one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Dtype {
    F32,
    Bf16,
}

/// File format of weights.
#[derive(Clone, Copy, PartialEq, ValueEnum)]
pub enum Format {
    Safetensors,
    /// A checkpoint for torch.load, in the authors' layout
    Torch,
}

impl WeightsOut {
    /// Returns an error, before the work, if the output couldn't be written, or would replace one of `inputs`.
    pub fn check(&self, format: Format, inputs: &InputFiles) -> Result<()> {
        if format == Format::Torch && self.max_shard_size.is_some() {
            let why = "--max-shard-size: a checkpoint for torch is one file, expected --format safetensors";
            return Err(Error::request(why).into());
        }
        check_writable_file(&self.out)?;
        inputs.check_file(&self.out)?;
        // Shards have their index in the file name.
        let Some(index) = shard_index(&self.out) else { return Ok(()) };
        let stem = format!("{}-", self.out.file_stem().unwrap_or_default().to_string_lossy());
        let beside = parent_of(&index).read_dir().ok();
        let beside = beside.into_iter().flatten().flatten();
        let shards = beside.filter(|file| file.file_name().to_string_lossy().starts_with(&stem));
        let mut shards = shards.map(|file| file.path()).chain([index.clone()]);
        Ok(shards.try_for_each(|file| inputs.check_file(&file))?)
    }

    /// Writes the variables of `vs` and reports it; the JSON output also gets the entries of `more`, the text output `note`.
    pub fn write(
        &self,
        vs: &nn::VarStore,
        config: &Config,
        stage: Stage,
        format: Format,
        (more, note): (Value, Option<String>),
    ) -> Result<()> {
        let dtype = match self.dtype {
            Dtype::F32 => ModelDtype::F32,
            Dtype::Bf16 => ModelDtype::BF16,
        };
        let weights = model_weights(vs, config, stage, dtype);
        let bytes: usize = weights.tensors.values().map(|t| t.numel() * t.kind().elt_size_in_bytes()).sum();
        let written = match format {
            Format::Safetensors => {
                write_sharded(&self.out, &weights, self.max_shard_size.unwrap_or(MAX_SHARD_SIZE))?
            }
            Format::Torch => {
                save_checkpoint(&self.out, weights)?;
                self.out.clone()
            }
        };
        // A single file counts with its header.
        let bytes = if written == self.out { std::fs::metadata(&written)?.len() } else { bytes as u64 };
        let parameters: usize = vs.trainable_variables().iter().map(|t| t.numel()).sum();
        if self.json {
            let mut report = json!({ "weights": written.to_string_lossy(), "parameters": parameters, "bytes": bytes, "stage": stage });
            for (key, value) in more.as_object().into_iter().flatten() {
                report[key] = value.clone();
            }
            print_json(&report);
        } else {
            let notes: String = [model::early_stage(stage, config), note]
                .into_iter()
                .flatten()
                .map(|n| format!(", {n}"))
                .collect();
            println!("{}: {parameters} parameters, {:.1} MB{notes}", written.display(), bytes as f64 / 1e6);
        }
        Ok(())
    }
}

/// Parses a size, as `500MB` or `5GB`, and returns it in bytes; units are decimal.
fn parse_size(text: &str) -> Result<u64, String> {
    let units = [("GB", 1_000_000_000), ("MB", 1_000_000), ("KB", 1000), ("B", 1), ("", 1)];
    let (number, unit) =
        units.iter().find_map(|(name, unit)| Some((text.strip_suffix(name)?, unit))).expect("the last fits");
    let bytes = number.trim().parse::<u64>().ok().and_then(|number| number.checked_mul(*unit));
    bytes.filter(|&bytes| bytes > 0).ok_or_else(|| "expected a size, as in 500MB or 5GB".into())
}
