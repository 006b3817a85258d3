//! The groups that are open, shared by all threads: each is read once, by the thread that comes first.

use super::scenes::SceneGroups;
use crate::data::capture::Capture;
use crate::error::Result;
use std::sync::{Arc, Mutex, OnceLock};

/// Groups that stay open when no thread works with them: those of a change from one to the next, and one more.
const KEPT: usize = 3;

/// A group, or why there is none.
#[derive(Debug)]
pub(super) enum Opened {
    Scenes(Vec<Result<Capture>>),
    Broken(String),
}

/// Keeps the groups that were opened last.
#[derive(Debug)]
pub(super) struct OpenGroups {
    source: Arc<dyn SceneGroups>,
    /// The last used at the end.
    kept: Mutex<Vec<(usize, Slot)>>,
}

/// Filled by the first thread that needs it; the others wait.
type Slot = Arc<OnceLock<Arc<Opened>>>;

impl OpenGroups {
    pub fn new(source: Arc<dyn SceneGroups>) -> Self {
        OpenGroups { source, kept: Mutex::default() }
    }

    pub fn open(&self, group: usize) -> Arc<Opened> {
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
                Ok(scenes) => Opened::Scenes(scenes),
                Err(why) => Opened::Broken(why.to_string()),
            })
        });
        opened.clone()
    }
}
