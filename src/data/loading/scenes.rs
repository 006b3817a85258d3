//! Sources of scenes: groups of scenes that are read together, and a cache of them.

use crate::data::dataset::{Dataset, SceneGroup, Split};
use crate::error::Result;
use crate::io::InputFiles;
use globalsplat_capture::Capture;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock};

/// Groups of scenes. Each group is opened as a whole, for example as a file that holds several scenes.
pub trait SceneGroups: Send + Sync + fmt::Debug {
    /// Returns the number of scenes in each group.
    fn sizes(&self) -> Vec<usize>;

    /// Opens the scenes of `group` in a fixed order. Each item is a scene or the error that prevents its use.
    ///
    /// # Errors
    /// Fails if the group can't be read at all.
    fn open(&self, group: usize) -> Result<Vec<Result<Capture>>>;

    /// Returns the number of bytes of all decoded photos, or `None` if it isn't known without reading them.
    fn decoded_bytes(&self) -> Option<u64>;
}

/// Open captures, one per group.
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

/// Scenes that a configuration names: captures, which are opened immediately and stay open, and the other groups (chunks and
/// synthetic videos), which are opened when needed.
#[derive(Debug)]
pub struct TrainingScenes {
    /// The open captures.
    pub captures: Vec<Capture>,
    /// The other groups: chunks and synthetic videos.
    pub others: Vec<SceneGroup>,
    /// A line for each folder that couldn't be read.
    pub warnings: Vec<String>,
}

impl TrainingScenes {
    /// Finds the scenes with [`Dataset::open`]. If a dataset is split, the training part is used.
    ///
    /// # Errors
    /// Fails if nothing of a known format is at one of `paths`, or if a capture violates its format. The other groups aren't opened
    /// yet.
    pub fn find(paths: &[PathBuf]) -> Result<Self> {
        let mut found = TrainingScenes { captures: vec![], others: vec![], warnings: vec![] };
        for path in paths {
            let dataset = Dataset::open(path, Split::Train)?;
            found.warnings.extend(dataset.warnings);
            for group in dataset.groups {
                match group.is_folder() {
                    true => found.captures.push(group.open()?.capture(&group.keys[0])?),
                    false => found.others.push(group),
                }
            }
        }
        Ok(found)
    }

    /// Adds the files of the captures to `inputs`, and of the other groups the files that writing below the folder `output` could
    /// overwrite.
    pub fn add_input_files(&self, output: &Path, inputs: &mut InputFiles) {
        self.captures.iter().for_each(|capture| capture.add_input_files(inputs));
        self.others.iter().for_each(|group| group.add_input_files(output, inputs));
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

/// Number of groups that stay open while no thread uses them: two during the transition from one group to the next, and a spare one.
const CAPACITY: usize = 3;

/// Scenes of a group, or the reason why the group can't be opened.
pub(super) type OpenedGroup = Arc<Result<Vec<Result<Capture>>>>;

/// Least-recently-used cache of [`CAPACITY`] groups.
#[derive(Debug)]
pub(super) struct GroupCache {
    source: Arc<dyn SceneGroups>,
    /// Groups ordered by last use, the most recent one last.
    entries: Mutex<Vec<(usize, Slot)>>,
}

/// Slot for a group. The first thread that needs the group fills the slot while other threads wait.
type Slot = Arc<OnceLock<OpenedGroup>>;

impl GroupCache {
    pub fn new(source: Arc<dyn SceneGroups>) -> Self {
        GroupCache { source, entries: Mutex::default() }
    }

    /// Returns the group with index `group`, which it opens first if the group isn't in the cache.
    pub fn open(&self, group: usize) -> OpenedGroup {
        let slot = {
            let mut entries = self.entries.lock().expect("no thread panics here");
            let position = entries.iter().position(|(cached, _)| *cached == group);
            let entry =
                position.map_or_else(|| (group, Slot::default()), |position| entries.remove(position));
            let slot = entry.1.clone();
            entries.push(entry);
            let surplus = entries.len().saturating_sub(CAPACITY);
            entries.drain(..surplus);
            slot
        };
        slot.get_or_init(|| Arc::new(self.source.open(group))).clone()
    }
}
