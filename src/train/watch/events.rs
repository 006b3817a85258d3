//! What a run's event files tell: its pictures, when which step was done, and where it was begun or resumed.

use super::super::tensorboard::event_files;
use crate::error::Result;
use crate::io::{EventReader, read_picture};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

/// Pictures that are kept in mind.
const PICTURES: usize = 6;
/// Events by which the speed is told.
const MARKS: usize = 100;

/// A picture in an event file.
#[derive(Debug)]
struct Picture {
    step: u64,
    file: PathBuf,
    /// Where in the file its event begins.
    at: u64,
}

/// What the event files of a run told so far.
#[derive(Debug, Default)]
pub(super) struct Events {
    readers: BTreeMap<PathBuf, EventReader>,
    /// Newest last.
    pictures: VecDeque<Picture>,
    /// Steps since the run was last begun or resumed, and when they were done, in seconds.
    marks: VecDeque<(u64, f64)>,
    /// At which steps the run was resumed.
    pub resumed: Vec<u64>,
}

impl Events {
    /// Reads what is new in the folder `run`.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn read(&mut self, run: &Path) -> Result<()> {
        if self.readers.values().any(EventReader::is_void) {
            *self = Events::default();
        }
        for file in event_files(run) {
            let reader = self.readers.entry(file.clone()).or_insert_with(|| EventReader::new(&file));
            for event in reader.read_new()? {
                if event.is_start {
                    self.pictures.retain(|picture| picture.step < event.step);
                    self.marks.clear();
                    self.resumed.retain(|&step| step < event.step);
                    self.resumed.extend((event.step > 0).then_some(event.step));
                    continue;
                }
                if let Some(at) = event.picture {
                    self.pictures.push_back(Picture { step: event.step, file: file.clone(), at });
                }
                if self.marks.back().is_none_or(|mark| mark.0 < event.step) {
                    self.marks.push_back((event.step, event.wall_time));
                }
                self.pictures.drain(..self.pictures.len().saturating_sub(PICTURES));
                self.marks.drain(..self.marks.len().saturating_sub(MARKS));
            }
        }
        Ok(())
    }

    /// Steps of the pictures, newest first.
    pub fn picture_steps(&self) -> Vec<u64> {
        self.pictures.iter().rev().map(|picture| picture.step).collect()
    }

    /// The PNG of step `step`, if that is one of the newest.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn picture(&self, step: u64) -> Result<Option<Vec<u8>>> {
        match self.pictures.iter().find(|picture| picture.step == step) {
            Some(picture) => read_picture(&picture.file, picture.at),
            None => Ok(None),
        }
    }

    /// How long a step took of late, with all that is done between steps.
    pub fn seconds_per_step(&self) -> Option<f64> {
        let (first, last) = (self.marks.front()?, self.marks.back()?);
        Some((last.1 - first.1) / (last.0.checked_sub(first.0)? as f64)).filter(|s| s.is_finite() && *s > 0.)
    }
}
