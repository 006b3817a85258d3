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

/// How long a Ctrl-C may go unnoticed.
const PAUSE: Duration = Duration::from_millis(50);

/// Show a run while it trains, or afterwards: one page for a browser on this machine, which no other machine can open.
///
/// Curves, the newest pictures, speed, the time left, checkpoints, and whatever is out of the ordinary, a few seconds old at most.
/// The run's folder is read alone. Ctrl-C ends it; the training doesn't notice.
#[derive(Args)]
#[command(
    after_help = "Examples:\n  globalsplat watch runs/mine\n  ssh -L 8000:127.0.0.1:8000 trainer globalsplat watch runs/mine --port 8000"
)]
pub struct Watch {
    /// The folder of the run
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// The page's port; 0 for any that is free
    #[arg(long, value_name = "N", default_value_t = 0)]
    port: u16,
    /// Print the page's address as one JSON object
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
