//! Cache of open groups, shared by all threads. The first thread that needs a group reads it.

use super::scenes::SceneGroups;
use crate::error::Result;
use globalsplat_capture::Capture;
use std::sync::{Arc, Mutex, OnceLock};

/// Number of groups that stay open while no thread uses them: two during the transition from one group to the next, and a spare one.
const CAPACITY: usize = 3;

/// Scenes of a group, or the reason why the group can't be opened.
#[derive(Debug)]
pub(super) enum CachedGroup {
    Scenes(Vec<Result<Capture>>),
    Broken(String),
}

/// Least-recently-used cache of [`CAPACITY`] groups.
#[derive(Debug)]
pub(super) struct GroupCache {
    source: Arc<dyn SceneGroups>,
    /// Groups ordered by last use, the most recent one last.
    entries: Mutex<Vec<(usize, Slot)>>,
}

/// Slot for a group. The first thread that needs the group fills the slot while other threads wait.
type Slot = Arc<OnceLock<Arc<CachedGroup>>>;

impl GroupCache {
    pub fn new(source: Arc<dyn SceneGroups>) -> Self {
        GroupCache { source, entries: Mutex::default() }
    }

    /// Returns the group with index `group`, which it opens first if the group isn't in the cache.
    pub fn open(&self, group: usize) -> Arc<CachedGroup> {
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
        let opened = slot.get_or_init(|| {
            Arc::new(match self.source.open(group) {
                Ok(scenes) => CachedGroup::Scenes(scenes),
                Err(why) => CachedGroup::Broken(why.to_string()),
            })
        });
        opened.clone()
    }
}
