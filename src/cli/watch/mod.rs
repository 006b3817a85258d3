mod page;
mod server;

use super::{print_json, stop_flag};
use anyhow::Result;
use clap::Args;
use globalsplat::train::WatchedRun;
use serde_json::json;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Interval between two checks for Ctrl-C.
const PAUSE: Duration = Duration::from_millis(50);

/// Show a run during or after training: a page for a browser on this machine, which no other machine can open.
///
/// The page shows curves, the newest images, speed, the time left, checkpoints, and anomalies, a few seconds old at most. Only
/// the run's folder is read. Ctrl-C ends the command without any effect on the training.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat watch runs/mine\n  ssh -L 8000:127.0.0.1:8000 trainer globalsplat watch runs/mine --port 8000"
)]
pub struct Watch {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Port of the page; 0 for any free port
    #[arg(long, value_name = "N", default_value_t = 0)]
    port: u16,
    /// Print the page's URL as one JSON object
    #[arg(long)]
    json: bool,
}

impl Watch {
    pub fn run(self) -> Result<()> {
        let run = WatchedRun::open(&self.run)?;
        let stop = stop_flag()?;
        let url = server::serve(run, self.port)?;
        match self.json {
            true => print_json(&json!({"run": self.run.to_string_lossy(), "url": url})),
            false => println!("{url} shows {}; Ctrl-C ends it", self.run.display()),
        }
        while !stop.load(Ordering::Relaxed) {
            std::thread::sleep(PAUSE);
        }
        Ok(())
    }
}
