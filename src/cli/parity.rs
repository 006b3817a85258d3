use super::device;
use anyhow::Result;
use clap::Args;
use std::path::PathBuf;

/// Answer the cases that parity/run.py asks.
#[derive(Args)]
pub struct Parity {
    /// Folder of request files
    #[arg(long, value_name = "DIR")]
    requests: PathBuf,
    /// Folder for the answers
    #[arg(long, value_name = "DIR")]
    responses: PathBuf,
    /// cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Parity {
    pub fn run(self) -> Result<()> {
        globalsplat::parity::answer_all(&self.requests, &self.responses, device::parse(&self.device)?)?;
        Ok(())
    }
}
