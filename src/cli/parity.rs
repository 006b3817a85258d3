use super::device;
use anyhow::Result;
use clap::Args;
use std::path::PathBuf;

/// Answer the requests of parity/run.py.
#[derive(Args)]
pub struct Parity {
    /// Folder of request files
    #[arg(long, value_name = "DIR")]
    requests: PathBuf,
    /// Folder for the responses
    #[arg(long, value_name = "DIR")]
    responses: PathBuf,
    /// Device: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Parity {
    pub fn run(self) -> Result<()> {
        globalsplat::parity::answer_all(&self.requests, &self.responses, device::parse(&self.device)?)?;
        Ok(())
    }
}
