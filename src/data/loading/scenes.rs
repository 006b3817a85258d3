//! Where scenes come from: groups that are read together.

use crate::data::capture::Capture;
use crate::data::dataset::{Dataset, SceneGroup, Split};
use crate::error::Result;
use crate::io::Inputs;
use std::fmt;
use std::path::{Path, PathBuf};

/// Scenes in groups, each of which is opened as a whole, as a file that holds several of them.
pub trait SceneGroups: Send + Sync + fmt::Debug {
    /// Scenes in each group.
    fn sizes(&self) -> Vec<usize>;

    /// The scenes of `group`, in an order that is always the same, each of them or what is wrong with it.
    ///
    /// # Errors
    /// A group that can't be read at all.
    fn open(&self, group: usize) -> Result<Vec<Result<Capture>>>;

    /// Bytes that all photos take up when they are decoded; none where nobody knows without reading them.
    fn decoded_bytes(&self) -> Option<u64>;
}

/// Captures that are open already, a group each.
impl SceneGroups for Vec<Capture> {
    fn sizes(&self) -> Vec<usize> {
        vec![1; self.len()]
    }

    fn open(&self, group: usize) -> Result<Vec<Result<Capture>>> {
        Ok(vec![Ok(self[group].clone())])
    }

    fn decoded_bytes(&self) -> Option<u64> {
        Some(self.iter().map(decoded_bytes).fold(0, u64::saturating_add))
    }
}

fn decoded_bytes(capture: &Capture) -> u64 {
    let pixels =
        capture.cameras().into_iter().map(|camera| u64::from(camera.width) * u64::from(camera.height));
    pixels.fold(0, |sum, pixels| sum.saturating_add(pixels.saturating_mul(3)))
}

/// What a configuration names: captures, which are opened at once and kept, and the others, chunks and made-up videos, which are
/// opened as they are needed.
#[derive(Debug)]
pub struct TrainingScenes {
    captures: Vec<Capture>,
    others: Vec<SceneGroup>,
    warnings: Vec<String>,
}

impl TrainingScenes {
    /// Finds them by [`Dataset::open`], where there are parts in the one that is to be learned from.
    ///
    /// # Errors
    /// Nothing known at one of `paths`, or a capture that breaks its format's rules. The others aren't opened yet.
    pub fn find(paths: &[PathBuf]) -> Result<Self> {
        let mut found = TrainingScenes { captures: vec![], others: vec![], warnings: vec![] };
        for path in paths {
            let dataset = Dataset::open(path, Split::Train)?;
            found.warnings.extend_from_slice(dataset.warnings());
            for group in dataset.groups() {
                match group.is_folder() {
                    true => found.captures.push(group.open()?.capture(&group.keys[0])?),
                    false => found.others.push(group.clone()),
                }
            }
        }
        Ok(found)
    }

    /// Returns a line for each folder that couldn't be looked into.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Adds the files that they are read from to `inputs`, as far as what is written below the folder `output` could be one of them.
    pub fn add_inputs(&self, output: &Path, inputs: &mut Inputs) {
        self.captures.iter().for_each(|capture| capture.add_inputs(inputs));
        self.others.iter().for_each(|group| group.add_inputs(output, inputs));
    }

    /// Those that are kept.
    pub fn captures(&self) -> &[Capture] {
        &self.captures
    }

    /// The others, in chunks or made up.
    pub fn others(&self) -> &[SceneGroup] {
        &self.others
    }
}

impl SceneGroups for TrainingScenes {
    fn sizes(&self) -> Vec<usize> {
        let others = self.others.iter().map(|group| group.keys.len());
        self.captures.iter().map(|_| 1).chain(others).collect()
    }

    fn open(&self, group: usize) -> Result<Vec<Result<Capture>>> {
        if let Some(capture) = self.captures.get(group) {
            return Ok(vec![Ok(capture.clone())]);
        }
        let group = &self.others[group - self.captures.len()];
        let opened = group.open()?;
        Ok(group.keys.iter().map(|key| opened.capture(key)).collect())
    }

    fn decoded_bytes(&self) -> Option<u64> {
        self.others.is_empty().then(|| self.captures.decoded_bytes())?
    }
}
