//! Contents of a run's event files: its images, the times of its steps, and the steps at which it was started or resumed.

use crate::error::Result;
use crate::io::{EventReader, event_files, read_event_image};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

/// Maximum number of images that are remembered.
const PICTURES: usize = 6;
/// Maximum number of steps that the speed is computed from.
const MARKS: usize = 100;

/// Image in an event file.
#[derive(Debug)]
struct Picture {
    step: u64,
    file: PathBuf,
    /// Offset of its event in the file.
    at: u64,
}

/// State read from the event files of a run so far.
#[derive(Debug, Default)]
pub(super) struct Events {
    readers: BTreeMap<PathBuf, EventReader>,
    /// Images, newest last.
    pictures: VecDeque<Picture>,
    /// Steps since the run was last started or resumed, and the times at which they were done, in seconds.
    marks: VecDeque<(u64, f64)>,
    /// Steps at which the run was resumed.
    pub resumed: Vec<u64>,
}

impl Events {
    /// Reads what is new in the folder `run`.
    ///
    /// # Errors
    /// Returns an error if a file can't be read.
    pub fn read(&mut self, run: &Path) -> Result<()> {
        if self.readers.values().any(EventReader::is_stale) {
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
                if let Some(at) = event.image_offset {
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

    /// Returns the steps of the images, newest first.
    pub fn picture_steps(&self) -> Vec<u64> {
        self.pictures.iter().rev().map(|picture| picture.step).collect()
    }

    /// Returns the image of step `step` as a PNG, or `None` if it isn't one of the newest.
    ///
    /// # Errors
    /// Returns an error if the file can't be read.
    pub fn picture(&self, step: u64) -> Result<Option<Vec<u8>>> {
        match self.pictures.iter().find(|picture| picture.step == step) {
            Some(picture) => read_event_image(&picture.file, picture.at),
            None => Ok(None),
        }
    }

    /// Returns the mean duration of the latest steps in seconds, including the time between steps.
    pub fn seconds_per_step(&self) -> Option<f64> {
        let (first, last) = (self.marks.front()?, self.marks.back()?);
        Some((last.1 - first.1) / (last.0.checked_sub(first.0)? as f64)).filter(|s| s.is_finite() && *s > 0.)
    }
}
