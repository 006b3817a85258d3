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
    pub fn run(self) -> Result<()> {
        let mut inputs = InputFiles::default();
        self.run.iter().for_each(|run| add_run_inputs(run, &mut inputs));
        self.weights.iter().for_each(|weights| inputs.add(weights));
        self.config.iter().for_each(|config| inputs.add(config));
        self.out.check(&inputs)?;
        let mut note = None;
        let (vs, config, stage) = match (&self.run, &self.weights, &self.config) {
            (Some(run), ..) => {
                let checkpoint = if self.best { best_checkpoint(run)? } else { latest_checkpoint(run)? };
                let loaded = load_model(&checkpoint.join(MODEL_FILE), Device::Cpu)?;
                (loaded.vs, loaded.config, loaded.stage)
            }
            (None, Some(weights), _) => {
                let loaded = load_model(weights, Device::Cpu)?;
                note = loaded.assumed.map(|assumed| format!("taken for {assumed}"));
                (loaded.vs, loaded.config, loaded.stage)
            }
            (None, None, config) => {
                let config = Config::read(config.as_ref().expect("clap asks for one of the three"), &[])?;
                tch::manual_seed(config.train.seed as i64);
                let vs = nn::VarStore::new(Device::Cpu);
                GlobalSplat::new(&vs.root(), &config.model)?;
                let stage = config.curriculum.final_stage();
                (vs, config, stage)
            }
        };
        self.out.write(&vs, &config, stage, self.format, (json!({}), note))
    }
}
