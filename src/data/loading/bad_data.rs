//! Bookkeeping of scenes that can't be trained on. They are counted and skipped; too many of them are an error.

use super::sampler::SceneIndex;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Mutex;

/// Kind of defect of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Fault {
    /// The file that holds the scene together with others is broken.
    Group,
    /// The cameras, or anything else that all views of the scene share, are broken.
    Scene,
    /// The scene is shorter than the shortest window.
    Short,
    /// An image is broken.
    Image,
}

/// Scenes that were skipped so far, each counted once.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct BadData {
    /// Number of all scenes, skipped or not.
    pub scenes: u64,
    /// Number of scenes in files that can't be read.
    pub in_broken_files: u64,
    /// Number of scenes with cameras that can't be used.
    pub broken: u64,
    /// Number of scenes shorter than the shortest window.
    pub too_short: u64,
    /// Number of scenes with images that can't be read.
    pub with_broken_images: u64,
    /// Error of the first skipped scene, or of the first one that wasn't merely too short.
    pub first: Option<String>,
}

impl BadData {
    /// Returns the number of skipped scenes.
    pub fn total(&self) -> u64 {
        self.in_broken_files + self.broken + self.too_short + self.with_broken_images
    }
}

/// Formats the counts in one line.
impl fmt::Display for BadData {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let kinds = [
            (self.too_short, "too short"),
            (self.in_broken_files, "in broken files"),
            (self.broken, "with broken cameras"),
            (self.with_broken_images, "with broken images"),
        ];
        let found = kinds.iter().filter(|(count, _)| *count > 0);
        let found: Vec<String> = found.map(|(count, kind)| format!("{count} {kind}")).collect();
        write!(f, "{} of {} scenes were skipped: {}", self.total(), self.scenes, found.join(", "))?;
        match &self.first {
            Some(first) => write!(f, "; the first: {first}"),
            None => Ok(()),
        }
    }
}

/// Bad scenes found together, sent to other processes to be counted there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct BadSceneReport {
    fault: Fault,
    scene_indices: Vec<SceneIndex>,
    why: String,
}

/// Collects [`BadData`] from all threads.
#[derive(Debug)]
pub(crate) struct BadDataLog {
    largest_share: f64,
    entries: Mutex<Entries>,
}

#[derive(Debug, Default)]
struct Entries {
    counts: BadData,
    seen: BTreeSet<SceneIndex>,
    /// Bad scenes found by this process since the last [`BadDataLog::take_bad_scene_reports`].
    reports: Vec<BadSceneReport>,
}

impl BadDataLog {
    /// Creates a log for `scenes` scenes, of which the share `largest_share` may be bad.
    pub fn new(scenes: u64, largest_share: f64) -> Self {
        let counts = BadData { scenes, ..Default::default() };
        BadDataLog { largest_share, entries: Mutex::new(Entries { counts, ..Default::default() }) }
    }

    /// Counts `scene_indices` as bad, once each.
    ///
    /// # Errors
    /// Fails if too many scenes are bad.
    pub fn add(
        &self,
        fault: Fault,
        scene_indices: impl Iterator<Item = SceneIndex>,
        why: impl fmt::Display,
    ) -> Result<()> {
        let mut entries = self.entries.lock().expect("no thread panics here");
        let scene_indices: Vec<SceneIndex> =
            scene_indices.filter(|scene_index| !entries.seen.contains(scene_index)).collect();
        if scene_indices.is_empty() {
            return Ok(());
        }
        // Decoders' messages contain line breaks.
        let report = BadSceneReport { fault, scene_indices, why: why.to_string().replace('\n', " ") };
        entries.reports.push(report.clone());
        self.count(&mut entries, report)
    }

    /// Counts scenes that another process found.
    ///
    /// # Errors
    /// Fails if too many scenes are bad.
    pub fn record_report(&self, report: BadSceneReport) -> Result<()> {
        self.count(&mut self.entries.lock().expect("no thread panics here"), report)
    }

    fn count(
        &self,
        entries: &mut Entries,
        BadSceneReport { fault, scene_indices, why }: BadSceneReport,
    ) -> Result<()> {
        let Entries { counts, seen, .. } = entries;
        let new = scene_indices.into_iter().filter(|&scene_index| seen.insert(scene_index)).count() as u64;
        if new == 0 {
            return Ok(());
        }
        if counts.first.is_none() || (fault != Fault::Short && counts.total() == counts.too_short) {
            counts.first = Some(why);
        }
        *match fault {
            Fault::Group => &mut counts.in_broken_files,
            Fault::Scene => &mut counts.broken,
            Fault::Short => &mut counts.too_short,
            Fault::Image => &mut counts.with_broken_images,
        } += new;
        if counts.total() as f64 > self.largest_share * counts.scenes as f64 {
            let share = self.largest_share;
            return Err(Error::failed(format!("{counts}; data.max_bad_share allows {share} of them")));
        }
        Ok(())
    }

    /// Returns `true` if [`BadDataLog::take_bad_scene_reports`] would return anything.
    pub fn has_bad_scene_reports(&self) -> bool {
        !self.entries.lock().expect("no thread panics here").reports.is_empty()
    }

    /// Returns the bad scenes that this process found since the last call.
    pub fn take_bad_scene_reports(&self) -> Vec<BadSceneReport> {
        std::mem::take(&mut self.entries.lock().expect("no thread panics here").reports)
    }

    /// Returns the error for the case that no usable scene is left.
    pub fn exhausted(&self) -> Error {
        Error::failed(format!("no scene can be trained on: {}", self.counts()))
    }

    pub fn counts(&self) -> BadData {
        self.entries.lock().expect("no thread panics here").counts.clone()
    }
}
