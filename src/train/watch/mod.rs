//! A run seen from outside, while it goes on or when it is over: its folder is read, and nothing else is done to it.

mod events;
mod new_lines;
mod series;

use super::checkpoint::{Kept, kept};
use super::lock::RunLock;
use super::metrics::{Line, METRICS_FILE};
use super::run::CONFIG_FILE;
use crate::error::{Error, Result};
use events::Events;
use new_lines::{NewLines, News};
use serde::{Deserialize, Serialize};
use series::Series;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};

/// Steps over which the speed is averaged.
const RECENT: usize = 50;
/// A run without a new line for so many seconds stands still, and for so many steps' time.
const STILL: (f64, f64) = (60., 20.);
/// Scenes of a skipped step that are named, and letters of each.
const NAMED: (usize, usize) = (3, 80);

/// How a run stands.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunState {
    /// Its folder; what isn't UTF-8 of its name is replaced.
    pub run: String,
    /// Steps done.
    pub step: u64,
    /// Steps in all, by its configuration.
    pub steps: Option<u64>,
    /// Of the last step.
    pub stage: Option<u32>,
    /// How far the transition from the stage before has come, in the last step.
    pub mix: Option<f64>,
    /// Of the last step.
    pub loss: Option<f64>,
    /// Of the last step, in dB.
    pub psnr: Option<f64>,
    /// Of the last step.
    pub learning_rate: Option<f64>,
    /// Mean over the last steps, without what is done between them.
    pub samples_per_second: Option<f64>,
    /// Until all steps are done, by when the last ones were.
    pub seconds_left: Option<f64>,
    /// Since something was written down.
    pub seconds_since: Option<f64>,
    /// Curves.
    pub curves: RunCurves,
    /// Steps of the newest pictures, newest first.
    pub pictures: Vec<u64>,
    /// What a person should know, a sentence each.
    pub notices: Vec<String>,
    /// Checkpoints, oldest first.
    pub checkpoints: Vec<Kept>,
    /// The one that validation found best.
    pub best: Option<Kept>,
}

/// Curves of at most some hundred points: the last step of some in a row, and the mean over them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunCurves {
    /// Of views in training, in dB.
    pub psnr: Vec<(u64, f64)>,
    /// Of held-out views, in dB, by the last step before each validation.
    pub held_out: Vec<(u64, f64)>,
    /// What training minimizes.
    pub loss: Vec<(u64, f64)>,
    /// The schedule.
    pub learning_rate: Vec<(u64, f64)>,
}

/// What the lines so far told.
#[derive(Debug, Default)]
struct Told {
    psnr: Series,
    held_out: Series,
    loss: Series,
    learning_rate: Series,
    speeds: VecDeque<f64>,
    last: Option<Line>,
    skipped: u64,
    last_skipped: Option<Line>,
    unreadable: u64,
}

impl Told {
    fn add(&mut self, line: &[u8]) {
        let Ok(line) = serde_json::from_slice::<Line>(line) else {
            self.unreadable += 1;
            return;
        };
        let step = line.step;
        if let Some(validation) = line.validation {
            validation.psnr.into_iter().for_each(|psnr| self.held_out.push(step, psnr));
            return;
        }
        for (series, value) in [
            (&mut self.psnr, line.psnr),
            (&mut self.loss, line.loss),
            (&mut self.learning_rate, line.learning_rate),
        ] {
            value.into_iter().for_each(|value| series.push(step, value));
        }
        self.speeds.extend(line.samples_per_second);
        self.speeds.drain(..self.speeds.len().saturating_sub(RECENT));
        if line.skipped {
            self.skipped += 1;
            self.last_skipped =
                Some(Line { scenes: line.scenes.clone(), ..Line { step, ..Line::default() } });
        }
        self.last = Some(line);
    }

    /// The sum of times is what makes a mean of speeds.
    fn samples_per_second(&self) -> Option<f64> {
        let mean = self.speeds.len() as f64 / self.speeds.iter().map(|speed| 1. / speed).sum::<f64>();
        Some(mean).filter(|mean| mean.is_finite())
    }
}

/// A run's folder, which is read on from where it was left.
#[derive(Debug)]
pub struct WatchedRun {
    folder: PathBuf,
    lines: NewLines,
    told: Told,
    events: Events,
}

impl WatchedRun {
    /// Reads what the folder `run` has so far.
    ///
    /// # Errors
    /// A folder that no run ever had, or the system's refusal to read.
    pub fn open(run: &Path) -> Result<Self> {
        if !RunLock::was_taken(run) && !run.join(METRICS_FILE).is_file() {
            let found = if run.exists() { "a folder without metrics.jsonl" } else { "absent" };
            return Err(Error::input(
                run,
                "the run",
                found,
                "a folder that `globalsplat train --out` writes",
            ));
        }
        let lines = NewLines::new(&run.join(METRICS_FILE));
        let mut watched =
            WatchedRun { folder: run.to_owned(), lines, told: Told::default(), events: Events::default() };
        watched.read()?;
        Ok(watched)
    }

    /// Looks again at how the run stands.
    ///
    /// # Errors
    /// The system's refusal to read.
    pub fn look(&mut self) -> Result<RunState> {
        self.read()?;
        let WatchedRun { folder, told, events, lines } = self;
        let last = told.last.as_ref();
        let step = last.map_or(0, |line| line.step + 1);
        let steps = steps(folder);
        let left = steps.map(|steps| steps.saturating_sub(step) as f64);
        let seconds_per_step = events.seconds_per_step();
        let seconds_since = lines.written.map(|written| written.elapsed().unwrap_or_default().as_secs_f64());
        let (checkpoints, best) = kept(folder);
        let mut state = RunState {
            run: folder.to_string_lossy().into_owned(),
            step,
            steps,
            stage: last.map(|line| line.stage),
            mix: last.and_then(|line| line.mix),
            loss: last.and_then(|line| line.loss),
            psnr: last.and_then(|line| line.psnr),
            learning_rate: last.and_then(|line| line.learning_rate),
            samples_per_second: told.samples_per_second(),
            seconds_left: left.and_then(|left| Some(left * seconds_per_step?)),
            seconds_since,
            curves: RunCurves {
                psnr: told.psnr.points(),
                held_out: told.held_out.points(),
                loss: told.loss.points(),
                learning_rate: told.learning_rate.points(),
            },
            pictures: events.picture_steps(),
            notices: vec![],
            checkpoints,
            best,
        };
        state.notices = self.notices(&state);
        Ok(state)
    }

    /// The picture of step `step`, a PNG, if that is one of the newest when the run was last looked at.
    ///
    /// # Errors
    /// The system's refusal to read.
    pub fn picture(&self, step: u64) -> Result<Option<Vec<u8>>> {
        self.events.picture(step)
    }

    fn read(&mut self) -> Result<()> {
        let told = &mut self.told;
        self.lines.read(|news| match news {
            News::Anew => *told = Told::default(),
            News::Line(line) => told.add(line),
        })?;
        self.events.read(&self.folder)
    }

    fn notices(&self, state: &RunState) -> Vec<String> {
        let mut notices = vec![];
        let still = STILL.0.max(STILL.1 * self.events.seconds_per_step().unwrap_or(0.));
        let is_done = state.steps.is_some_and(|steps| state.step >= steps);
        match state.seconds_since {
            None => notices.push("no step is written down yet".into()),
            Some(since) if since > still && !is_done => notices.push(format!(
                "nothing was written down for {} min: the run validates, waits, or was stopped",
                (since / 60.).floor()
            )),
            Some(_) => {}
        }
        if let Some(Line { step, scenes, .. }) = &self.told.last_skipped {
            let short = |name: &String| name.chars().take(NAMED.1).collect::<String>();
            let mut names: Vec<String> = scenes.iter().take(NAMED.0).map(short).collect();
            if scenes.len() > NAMED.0 {
                names.push(format!("{} more", scenes.len() - NAMED.0));
            }
            let shown =
                if names.is_empty() { String::new() } else { format!(", and showed {}", names.join(", ")) };
            let skipped = match self.told.skipped {
                1 => "1 step was skipped".into(),
                count => format!("{count} steps were skipped"),
            };
            notices
                .push(format!("{skipped}: loss or gradient was not finite; the last was step {step}{shown}"));
        }
        if let Some(step) = self.events.resumed.last() {
            notices.push(format!("the run was resumed at step {step}"));
        }
        if self.told.unreadable > 0 {
            notices.push(format!("lines of {METRICS_FILE} that no run wrote: {}", self.told.unreadable));
        }
        notices
    }
}

/// `train.steps` of the run's configuration, whatever version of the program wrote it.
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
