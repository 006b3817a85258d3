use super::weights_out::{Format, WeightsOut};
use anyhow::Result;
use clap::{ArgGroup, Args};
use globalsplat::config::Config;
use globalsplat::io::InputFiles;
use globalsplat::model::GlobalSplat;
use globalsplat::reconstruct::load_model;
use globalsplat::train::{MODEL_FILE, add_run_inputs, best_checkpoint, latest_checkpoint};
use serde_json::json;
use std::path::PathBuf;
use tch::{Device, nn};

/// Write a run's newest or best weights, with their configuration, as one file: safetensors, or a checkpoint for torch.
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
    #[arg(long, conflicts_with = "config")]
    best: bool,
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
    pub fn run(self) -> Result<()> {
        let mut inputs = InputFiles::default();
        self.run.iter().for_each(|run| add_run_inputs(run, &mut inputs));
        self.config.iter().for_each(|config| inputs.add(config));
        self.out.check(self.format, &inputs)?;
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
        self.out.write(&vs, &config, stage, self.format, (json!({}), None))
    }
}
