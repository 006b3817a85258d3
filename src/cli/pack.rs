use super::{Output, progress, warn_of_many};
use crate::data::{ChunkWriter, Holdout, find_captures, open_capture};
use crate::error::Error;
use crate::io::{InputFiles, check_writable_dir};
use anyhow::Result;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;

/// Pack captures into chunks, the format of RealEstate10K, ACID and DL3DV.
///
/// The folder gets an index.json and files that Python's torch.load reads. JPEG and PNG photos of 8-bit RGB are copied bit for
/// bit, unless lens distortion has to be removed; all others are encoded again.
#[derive(Args)]
#[command(after_help = "Example:\n  globalsplat pack captures/room captures/garden --out chunks/train")]
pub struct Pack {
    /// Captures of any format, or folders of captures
    #[arg(value_name = "SCENE", required = true)]
    scenes: Vec<PathBuf>,
    /// Folder for index.json, 000000.torch, …
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Approximate megabytes of photos per chunk
    #[arg(long, value_name = "MB", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=2000))]
    chunk_size: u32,
}

impl Pack {
    pub fn run(self) -> Result<Output> {
        let (mut captures, mut lines) = (vec![], vec![]);
        for scene in &self.scenes {
            if !scene.exists() && !scene.to_string_lossy().contains('#') {
                return Err(Error::request(format!("{}: no such capture", scene.display())).into());
            }
            let found = find_captures(scene)?;
            lines.extend(found.warnings);
            for path in &found.paths {
                captures.push(open_capture(path)?);
            }
        }
        for capture in &captures {
            lines.extend_from_slice(capture.warnings());
            if capture.has_test_part() {
                let test = capture.scored_views().len();
                lines.push(format!(
                    "{}: the {test} views of its test part are left out",
                    capture.file().display()
                ));
            }
            let masks = capture.mask_count();
            if masks > 0 {
                lines.push(format!(
                    "{}: the masks or alpha channels of {masks} photos are left out, as chunks have no place for them",
                    capture.file().display()
                ));
            }
        }
        warn_of_many(lines.iter());
        check_writable_dir(&self.out)?;
        let mut inputs = InputFiles::default();
        captures.iter().for_each(|capture| capture.add_input_files(&mut inputs));
        inputs.check_folder(&self.out)?;
        let mut writer = ChunkWriter::new(&self.out, self.chunk_size as usize * 1_000_000)?;
        let bar = progress::bar(captures.len() as u64, "scenes");
        let mut views = 0;
        for capture in &captures {
            writer.add(capture)?;
            views += capture.split(Holdout::None).0.len();
            bar.inc(1);
        }
        let chunks = writer.finish()?;
        bar.finish_and_clear();
        let (out, scenes) = (self.out.to_string_lossy(), captures.len());
        Ok(Output::new(
            json!({ "out": out, "scenes": scenes, "views": views, "chunks": chunks }),
            format!("{out}: {scenes} scenes, {views} views in {chunks} chunks"),
        ))
    }
}
