use super::weights_out::{Format, WeightsOut};
use anyhow::Result;
use clap::Args;
use globalsplat::io::Inputs;
use globalsplat::model::Precision;
use globalsplat::reconstruct::ModelFile;
use serde_json::json;
use std::path::PathBuf;
use tch::Device;

/// Take over weights from a checkpoint of the authors' or anybody's state dict, as safetensors with a configuration.
///
/// The model's shape is read off the tensors; optimizer state, other networks and settings beside them are left out. Nothing in
/// the file is run: one that would run code in Python is refused. What shapes don't tell, the number of attention heads and the stage
/// that the model ends in, is the paper's, and told; --set says it otherwise.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat import --from globalsplat_16k.ckpt --out model.safetensors\n  \
    globalsplat import --from dense_32k.ckpt --set curriculum.final_stage=4 --out model.safetensors"
)]
pub struct Import {
    /// What torch.save or Lightning wrote, or a safetensors file with or without a configuration
    #[arg(long, value_name = "FILE")]
    from: PathBuf,
    /// Say a key of the configuration otherwise, as in model.heads=4; may be given more than once
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    out: WeightsOut,
}

impl Import {
    pub fn run(self) -> Result<()> {
        let mut inputs = Inputs::default();
        inputs.add_weights(&self.from);
        self.out.check(Format::Safetensors, &inputs)?;
        let file = ModelFile::open(&self.from, &self.set)?;
        let left_out = file.left_out;
        let loaded = file.load(Device::Cpu, Precision::F32)?;
        let notes: Vec<String> = loaded
            .assumed
            .iter()
            .map(|assumed| format!("taken for {assumed}"))
            .chain((left_out > 0).then(|| format!("{left_out} other tensors left out")))
            .collect();
        let note = (!notes.is_empty()).then(|| notes.join("; "));
        let more = json!({ "taken_for": loaded.assumed, "left_out": left_out });
        self.out.write(&loaded.vs, &loaded.config, loaded.stage, Format::Safetensors, (more, note))
    }
}
