use super::{model, print_json};
use anyhow::Result;
use clap::{ArgGroup, Args, ValueEnum};
use globalsplat::config::Config;
use globalsplat::io::check_writable_file;
use globalsplat::model::GlobalSplat;
use globalsplat::reconstruct::{ModelDtype, load_model, save_model};
use globalsplat::train::{MODEL_FILE, best_checkpoint, latest_checkpoint};
use serde_json::json;
use std::path::PathBuf;
use tch::{Device, nn};

/// Write a run's newest or best weights, with their configuration, as one safetensors file.
#[derive(Args)]
#[command(group(ArgGroup::new("source").required(true)))]
#[command(
    after_help = "Example:\n  globalsplat export --run runs/first_light --out model.safetensors --dtype bf16"
)]
pub struct Export {
    /// Folder of a run
    #[arg(long, value_name = "RUN", group = "source")]
    run: Option<PathBuf>,
    /// Of the run, the weights that validation found best, instead of the newest
    #[arg(long, conflicts_with = "config")]
    best: bool,
    /// Fresh weights of a configuration instead, as training would begin with
    #[arg(long, value_name = "FILE", group = "source")]
    config: Option<PathBuf>,
    /// The file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How weights are stored
    #[arg(long, value_enum, default_value = "f32")]
    dtype: Dtype,
    /// Print what was written as one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Dtype {
    F32,
    Bf16,
}

impl Export {
    pub fn run(self) -> Result<()> {
        check_writable_file(&self.out)?;
        let (vs, config, stage) = match (&self.run, &self.config) {
            (Some(run), _) => {
                let checkpoint = if self.best { best_checkpoint(run)? } else { latest_checkpoint(run)? };
                let loaded = load_model(&checkpoint.join(MODEL_FILE), Device::Cpu)?;
                (loaded.vs, loaded.config, loaded.stage)
            }
            (None, config) => {
                let config = Config::read(config.as_ref().expect("clap asks for one of the two"), &[])?;
                tch::manual_seed(config.train.seed as i64);
                let vs = nn::VarStore::new(Device::Cpu);
                GlobalSplat::new(&vs.root(), &config.model)?;
                let stage = config.curriculum.final_stage();
                (vs, config, stage)
            }
        };
        let dtype = match self.dtype {
            Dtype::F32 => ModelDtype::F32,
            Dtype::Bf16 => ModelDtype::BF16,
        };
        save_model(&self.out, &vs, &config, stage, dtype)?;
        let parameters: usize = vs.trainable_variables().iter().map(|t| t.numel()).sum();
        let bytes = std::fs::metadata(&self.out)?.len();
        if self.json {
            let told =
                json!({ "weights": self.out, "parameters": parameters, "bytes": bytes, "stage": stage });
            print_json(&told);
        } else {
            let early =
                model::early_stage(stage, &config).map_or(String::new(), |early| format!(", {early}"));
            println!("{}: {parameters} parameters, {:.1} MB{early}", self.out.display(), bytes as f64 / 1e6);
        }
        Ok(())
    }
}
