use super::Output;
use crate::eval::{evaluation_files, read_evaluation, write_report};
use crate::io::{InputFiles, check_writable_file};
use anyhow::Result;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;

/// Compare evaluations with the paper's published results: one HTML page, images and plots included.
#[derive(Args)]
#[command(
    after_help = "Example:\n  globalsplat report runs/mine/eval_24 runs/other/eval_24 --out report.html"
)]
pub struct Report {
    /// Folders that `globalsplat eval --out` wrote
    #[arg(value_name = "DIR", required = true)]
    folders: Vec<PathBuf>,
    /// Output page
    #[arg(long, value_name = "FILE.html")]
    out: PathBuf,
}

impl Report {
    pub fn run(self) -> Result<Output> {
        check_writable_file(&self.out)?;
        let (mut evaluations, mut inputs) = (vec![], InputFiles::default());
        for folder in self.folders {
            let evaluation = read_evaluation(&folder)?;
            let scenes = evaluation.scenes.iter().map(|scene| &scene.scores.scene);
            evaluation_files(&folder, scenes).iter().for_each(|file| inputs.add(file));
            evaluations.push((folder, evaluation));
        }
        inputs.check_file(&self.out)?;
        write_report(&self.out, &evaluations)?;
        let bytes = std::fs::metadata(&self.out)?.len();
        let shown = evaluations.iter().map(|(folder, evaluation)| {
            json!({
                "folder": folder.display().to_string(),
                "method": evaluation.method,
                "dataset": evaluation.dataset,
                "context_views": evaluation.context_views,
                "scenes": evaluation.scenes.len(),
                "failures": evaluation.failures.len(),
                "summary": evaluation.summary,
            })
        });
        let (out, shown) = (self.out.to_string_lossy(), shown.collect::<Vec<_>>());
        Ok(Output::new(json!({ "out": out, "bytes": bytes, "evaluations": shown }), out))
    }
}
