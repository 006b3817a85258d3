//! Observation of a run from outside, while it is running or when it is over. Its folder is only read, never changed.

mod events;
mod new_lines;
mod series;

use super::checkpoint::{CheckpointSummary, checkpoint_summaries};
use super::lock::RunLock;
use super::metrics::MetricsRecord;
use super::{CONFIG_FILE, METRICS_FILE};
use crate::error::{Error, Result};
use events::Events;
use new_lines::{FileChange, NewLines};
use serde::{Deserialize, Serialize};
use series::Series;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};

/// Number of steps over which the speed is averaged.
const RECENT: usize = 50;
/// Time without a new line after which a run counts as stalled: this many seconds, or the duration of this many steps if that is longer.
const STILL: (f64, f64) = (60., 20.);
/// Maximum number of scenes of a skipped step that are named, and maximum number of characters of each name.
const NAMED: (usize, usize) = (3, 80);

/// State of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunState {
    /// Folder of the run; characters of its name that aren't UTF-8 are replaced.
    pub run: String,
    /// Number of steps done.
    pub step: u64,
    /// Total number of steps, by the run's configuration.
    pub steps: Option<u64>,
    /// Curriculum stage of the last step.
    pub stage: Option<u32>,
    /// Progress of the transition from the previous stage in the last step, from 0 to 1.
    pub mix: Option<f64>,
    /// Loss of the last step.
    pub loss: Option<f64>,
    /// PSNR of the last step, in dB.
    pub psnr: Option<f64>,
    /// Learning rate of the last step.
    pub learning_rate: Option<f64>,
    /// Mean speed of the latest steps, in samples per second, without the time between steps.
    pub samples_per_second: Option<f64>,
    /// Estimated time until all steps are done, in seconds, from the speed of the latest steps.
    pub seconds_left: Option<f64>,
    /// Time since the run last wrote metrics, in seconds.
    pub seconds_since: Option<f64>,
    /// Training curves.
    pub curves: RunCurves,
    /// Steps of the newest images, newest first.
    pub pictures: Vec<u64>,
    /// Messages for the user, one sentence each.
    pub notices: Vec<String>,
    /// Checkpoints, oldest first.
    pub checkpoints: Vec<CheckpointSummary>,
    /// Checkpoint with the best validation score.
    pub best: Option<CheckpointSummary>,
}

/// Curves of at most some hundred (step, value) points, each the mean over consecutive steps, at the last of them. Skipped steps are left
/// out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunCurves {
    /// PSNR of training views, in dB.
    pub psnr: Vec<(u64, f64)>,
    /// PSNR of held-out views, in dB, each at the last step before a validation.
    pub held_out: Vec<(u64, f64)>,
    /// Training loss.
    pub loss: Vec<(u64, f64)>,
    /// Learning rate.
    pub learning_rate: Vec<(u64, f64)>,
}

/// Values collected from the lines read so far.
#[derive(Debug, Default)]
struct MetricsHistory {
    psnr: Series,
    held_out: Series,
    loss: Series,
    learning_rate: Series,
    speeds: VecDeque<f64>,
    last: Option<MetricsRecord>,
    skipped: u64,
    last_skipped: Option<MetricsRecord>,
    unreadable: u64,
}

impl MetricsHistory {
    fn add(&mut self, line: &[u8]) {
        let Ok(record) = serde_json::from_slice::<MetricsRecord>(line) else {
            self.unreadable += 1;
            return;
        };
        let step = record.step;
        if let Some(validation) = record.validation {
            validation.psnr.into_iter().for_each(|psnr| self.held_out.push(step, psnr));
            return;
        }
        self.speeds.extend(record.samples_per_second);
        self.speeds.drain(..self.speeds.len().saturating_sub(RECENT));
        if record.skipped {
            self.skipped += 1;
            let scenes = record.scenes.clone();
            self.last_skipped = Some(MetricsRecord { step, scenes, ..MetricsRecord::default() });
        } else {
            for (series, value) in [
                (&mut self.psnr, record.psnr),
                (&mut self.loss, record.loss),
                (&mut self.learning_rate, record.learning_rate),
            ] {
                value.into_iter().for_each(|value| series.push(step, value));
            }
        }
        self.last = Some(record);
    }

    /// Returns the mean speed of the latest steps in samples per second: the harmonic mean, because the times of steps add up.
    fn samples_per_second(&self) -> Option<f64> {
        let mean = self.speeds.len() as f64 / self.speeds.iter().map(|speed| 1. / speed).sum::<f64>();
        Some(mean).filter(|mean| mean.is_finite())
    }
}

/// Folder of a run. Each read continues where the last one ended.
#[derive(Debug)]
pub struct WatchedRun {
    folder: PathBuf,
    lines: NewLines,
    metrics: MetricsHistory,
    events: Events,
}

impl WatchedRun {
    /// Opens the folder `run` and reads what it has so far.
    ///
    /// # Errors
    /// Returns an error if no run ever used the folder, or if a file can't be read.
    pub fn open(run: &Path) -> Result<Self> {
        if !RunLock::was_ever_locked(run) && !run.join(METRICS_FILE).is_file() {
            let found = if run.exists() { "a folder without metrics.jsonl" } else { "missing" };
            return Err(Error::input(run, "the run", found, "a folder that `globalsplat train` writes"));
        }
        let lines = NewLines::new(&run.join(METRICS_FILE));
        let mut watched = WatchedRun {
            folder: run.to_owned(),
            lines,
            metrics: MetricsHistory::default(),
            events: Events::default(),
        };
        watched.read()?;
        Ok(watched)
    }

    /// Reads what is new and returns the state of the run.
    ///
    /// # Errors
    /// Returns an error if a file can't be read.
    pub fn refresh(&mut self) -> Result<RunState> {
        self.read()?;
        let WatchedRun { folder, metrics, events, lines } = self;
        let last = metrics.last.as_ref();
        let step = last.map_or(0, |line| line.step + 1);
        let steps = steps(folder);
        let left = steps.map(|steps| steps.saturating_sub(step) as f64);
        let seconds_per_step = events.seconds_per_step();
        let seconds_since = lines.written.map(|written| written.elapsed().unwrap_or_default().as_secs_f64());
        let (checkpoints, best) = checkpoint_summaries(folder);
        let mut state = RunState {
            run: folder.to_string_lossy().into_owned(),
            step,
            steps,
            stage: last.map(|line| line.stage),
            mix: last.and_then(|line| line.mix),
            loss: last.and_then(|line| line.loss),
            psnr: last.and_then(|line| line.psnr),
            learning_rate: last.and_then(|line| line.learning_rate),
            samples_per_second: metrics.samples_per_second(),
            seconds_left: left.and_then(|left| Some(left * seconds_per_step?)),
            seconds_since,
            curves: RunCurves {
                psnr: metrics.psnr.points(),
                held_out: metrics.held_out.points(),
                loss: metrics.loss.points(),
                learning_rate: metrics.learning_rate.points(),
            },
            pictures: events.picture_steps(),
            notices: vec![],
            checkpoints,
            best,
        };
        state.notices = self.notices(&state);
        Ok(state)
    }

    /// Returns the image of step `step` as a PNG, or `None` if it wasn't one of the newest when the run was last read.
    ///
    /// # Errors
    /// Returns an error if the file can't be read.
    pub fn picture(&self, step: u64) -> Result<Option<Vec<u8>>> {
        self.events.picture(step)
    }

    fn read(&mut self) -> Result<()> {
        let metrics = &mut self.metrics;
        self.lines.read(|news| match news {
            FileChange::Replaced => *metrics = MetricsHistory::default(),
            FileChange::Line(line) => metrics.add(line),
        })?;
        self.events.read(&self.folder)
    }

    fn notices(&self, state: &RunState) -> Vec<String> {
        let mut notices = vec![];
        let still = STILL.0.max(STILL.1 * self.events.seconds_per_step().unwrap_or(0.));
        let is_done = state.steps.is_some_and(|steps| state.step >= steps);
        match state.seconds_since {
            None => notices.push("no step has been logged yet".into()),
            Some(since) if since > still && !is_done => notices.push(format!(
                "nothing was logged for {} min: the run validates, waits, or was stopped",
                (since / 60.).floor()
            )),
            Some(_) => {}
        }
        if let Some(MetricsRecord { step, scenes, .. }) = &self.metrics.last_skipped {
            let short = |name: &String| name.chars().take(NAMED.1).collect::<String>();
            let mut names: Vec<String> = scenes.iter().take(NAMED.0).map(short).collect();
            if scenes.len() > NAMED.0 {
                names.push(format!("{} more", scenes.len() - NAMED.0));
            }
            let shown =
                if names.is_empty() { String::new() } else { format!(", and showed {}", names.join(", ")) };
            let skipped = match self.metrics.skipped {
                1 => "1 step was skipped".into(),
                count => format!("{count} steps were skipped"),
            };
            notices
                .push(format!("{skipped}: loss or gradient was not finite; the last was step {step}{shown}"));
        }
        if let Some(step) = self.events.resumed.last() {
            notices.push(format!("the run was resumed at step {step}"));
        }
        if self.metrics.unreadable > 0 {
            notices.push(format!("lines of {METRICS_FILE} that no run wrote: {}", self.metrics.unreadable));
        }
        notices
    }
}

/// Returns `train.steps` of the run's configuration, whichever version of the program wrote the file.
fn steps(run: &Path) -> Option<u64> {
    #[derive(Deserialize)]
    struct Config {
        train: Train,
    }
    #[derive(Deserialize)]
    struct Train {
        steps: u64,
    }
    let text = std::fs::read_to_string(run.join(CONFIG_FILE)).ok()?;
    toml::from_str(&text).map(|config: Config| config.train.steps).ok()
}
