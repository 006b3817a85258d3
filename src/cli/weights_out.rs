//! Output of weights, shared by `export` and `import`.

use super::{model, print_json};
use anyhow::Result;
use clap::{Args, ValueEnum};
use globalsplat::config::Config;
use globalsplat::io::{InputFiles, check_writable_file, write_weights};
use globalsplat::model::Stage;
use globalsplat::reconstruct::{ModelDtype, model_weights, save_checkpoint};
use serde_json::{Value, json};
use std::path::PathBuf;
use tch::nn;

#[derive(Args)]
pub struct WeightsOut {
    /// Output file
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Data type of the stored weights
    #[arg(long, value_enum, default_value = "f32")]
    dtype: Dtype,
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
    pub fn check(&self, inputs: &InputFiles) -> Result<()> {
        check_writable_file(&self.out)?;
        Ok(inputs.check_file(&self.out)?)
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
        match format {
            Format::Safetensors => write_weights(&self.out, &weights.tensors, weights.metadata)?,
            Format::Torch => save_checkpoint(&self.out, weights)?,
        }
        let bytes = std::fs::metadata(&self.out)?.len();
        let parameters: usize = vs.trainable_variables().iter().map(|t| t.numel()).sum();
        if self.json {
            let mut report = json!({ "weights": self.out.to_string_lossy(), "parameters": parameters, "bytes": bytes, "stage": stage });
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
            println!("{}: {parameters} parameters, {:.1} MB{notes}", self.out.display(), bytes as f64 / 1e6);
        }
        Ok(())
    }
}
