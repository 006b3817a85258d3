//! Progress events of a session, and their log for TensorBoard.

use crate::error::{Error, Result};
use crate::io::{AppendFile, CONFIG_FILE, EventFile, METRICS_FILE, read_text};
use crate::metrics::Scores;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::path::Path;

/// Progress event of a session.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RefineEvent<'a> {
    /// Photos are being read.
    Loading {
        /// Number of photos read so far.
        done: usize,
        /// Number of photos to read, including those of the held-out views.
        count: usize,
    },
    /// Depths are being computed; the value is the number of photos that are done.
    Starting(usize),
    /// A step of the optimization is done.
    Optimizing {
        /// Number of steps done.
        steps: u64,
        /// Most recent PSNR of a sample of the held-out views, in dB.
        psnr: Option<f64>,
    },
    /// Metrics of a step that was just done, every 50 steps.
    Measured {
        /// Number of steps done.
        steps: u64,
        /// Time on the session's clock, in seconds.
        seconds: f64,
        /// Loss of the step's photos.
        loss: f64,
        /// Number of Gaussians.
        gaussians: i64,
        /// Learning rate of the means, in units of the scene's depth.
        learning_rate: f64,
    },
    /// A sample of the held-out views was scored.
    Scored(&'a EvalPoint),
    /// All held-out views are being scored; the value is the number of views that are done.
    Scoring(usize),
    /// Warning to print, a sentence: photos that were left out, exposures that are corrected, missing depth information, too little time, or
    /// an initial splat that is kept.
    Warning(&'a str),
}

/// Scores of the held-out views at one time during the optimization.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvalPoint {
    /// Time on the session's clock, in seconds.
    pub seconds: f64,
    /// Number of steps done.
    pub steps: u64,
    /// Mean scores of the sample.
    #[serde(flatten)]
    pub scores: Scores,
}

/// Log in the folder of a run: `metrics.jsonl`, with a line for some of the steps and one for each score, and event files in `tensorboard`.
#[derive(Debug)]
pub struct RefineLog {
    metrics: AppendFile,
    events: EventFile,
}

impl RefineLog {
    /// Checks that the folder `run` has no other metrics than those of refinements. A last line that is cut short, as by a kill, counts
    /// as one of them. Returns the length of the whole lines in bytes. Changes nothing.
    ///
    /// # Errors
    /// Returns an error if the folder has the log of a training, or a `metrics.jsonl` that no refinement wrote.
    pub fn check(run: &Path) -> Result<u64> {
        if run.join(CONFIG_FILE).exists() {
            return Err(Error::input(run, "the log", "a folder of a training run", "another folder"));
        }
        let file = run.join(METRICS_FILE);
        let text = if file.exists() { read_text(&file)? } else { String::new() };
        let is_own = |line: &str| match serde_json::from_str::<Value>(line) {
            Ok(value) => {
                let has_values = value["gaussians"].is_number() || value["validation"].is_object();
                value["step"].is_u64() && has_values
            }
            Err(e) => e.is_eof() && line.starts_with("{\"") && !line.ends_with('\n'),
        };
        match text.split_inclusive('\n').position(|line| !is_own(line)) {
            Some(index) => {
                let found = "no line of a refinement's log";
                Err(Error::input(&file, format!("line {}", index + 1), found, "another folder for the log"))
            }
            None => Ok(text.rfind('\n').map_or(0, |end| end as u64 + 1)),
        }
    }

    /// Opens the log of a refinement that continues after `steps` steps in the folder `run`. It is appended to those of earlier refinements.
    ///
    /// # Errors
    /// Returns the errors of [`RefineLog::check`], or an error if a file can't be written.
    pub fn open(run: &Path, steps: u64) -> Result<Self> {
        let whole = Self::check(run)?;
        std::fs::create_dir_all(run).map_err(Error::write(run))?;
        let mut metrics = AppendFile::open(&run.join(METRICS_FILE))?;
        metrics.truncate(whole)?;
        let mut events = EventFile::create_for(run)?;
        events.start(steps)?;
        Ok(RefineLog { metrics, events })
    }

    /// Writes the metrics or the scores of an event to both files. Other events aren't logged.
    ///
    /// # Errors
    /// Returns an error if a file can't be written.
    pub fn write(&mut self, event: &RefineEvent) -> Result<()> {
        let (group, steps, values) = match *event {
            RefineEvent::Measured { steps, seconds, loss, gaussians, learning_rate } => {
                let (gaussians, rate) = (("gaussians", gaussians as f64), ("learning_rate", learning_rate));
                ("refine", steps, vec![("loss", loss), gaussians, rate, ("seconds", seconds)])
            }
            RefineEvent::Scored(EvalPoint { steps, scores, .. }) => {
                ("validation", *steps, vec![("psnr", scores.psnr), ("ssim", scores.ssim)])
            }
            _ => return Ok(()),
        };
        // As in a log of training, the step is the index of the last one.
        let step = steps.saturating_sub(1);
        let tagged: Vec<_> = values.iter().map(|(name, value)| (format!("{group}/{name}"), *value)).collect();
        let object: Map<String, Value> =
            values.into_iter().map(|(name, value)| (name.into(), value.into())).collect();
        let mut line = if group == "refine" { object.into() } else { json!({ group: object }) };
        line["step"] = step.into();
        self.metrics.append(format!("{line}\n").as_bytes())?;
        self.events.write_scalars(step, &tagged)
    }
}
