use super::weights_out::{Format, WeightsOut};
use anyhow::Result;
use clap::Args;
use globalsplat::io::InputFiles;
use globalsplat::model::Precision;
use globalsplat::reconstruct::ModelFile;
use serde_json::json;
use std::path::PathBuf;
use tch::Device;

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
    pub fn run(self) -> Result<()> {
        let mut inputs = InputFiles::default();
        inputs.add(&self.from);
        self.out.check(&inputs)?;
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
