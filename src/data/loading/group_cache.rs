//! Cache of open groups, shared by all threads. The first thread that needs a group reads it.

use super::scenes::SceneGroups;
use crate::error::Result;
use globalsplat_capture::Capture;
use std::sync::{Arc, Mutex, OnceLock};

/// Number of groups that stay open while no thread uses them: two for a transition from one group to the next, and one more.
const KEPT: usize = 3;

/// A group, or the reason why it can't be opened.
#[derive(Debug)]
pub(super) enum CachedGroup {
    Scenes(Vec<Result<Capture>>),
    Broken(String),
}

/// Holds the most recently used groups.
#[derive(Debug)]
pub(super) struct GroupCache {
    source: Arc<dyn SceneGroups>,
    /// Groups ordered by last use, the most recent one last.
    kept: Mutex<Vec<(usize, Slot)>>,
}

/// Slot that the first thread fills while the others wait.
type Slot = Arc<OnceLock<Arc<CachedGroup>>>;

impl GroupCache {
    pub fn new(source: Arc<dyn SceneGroups>) -> Self {
        GroupCache { source, kept: Mutex::default() }
    }

    pub fn open(&self, group: usize) -> Arc<CachedGroup> {
        let slot = {
            let mut kept = self.kept.lock().expect("no thread panics here");
            let position = kept.iter().position(|(kept, _)| *kept == group);
            let entry = position.map_or_else(|| (group, Slot::default()), |position| kept.remove(position));
            let slot = entry.1.clone();
            kept.push(entry);
            let surplus = kept.len().saturating_sub(KEPT);
            kept.drain(..surplus);
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
