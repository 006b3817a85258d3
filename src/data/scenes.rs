//! Where scenes come from: groups that are read together.

use super::capture::Capture;
use crate::error::Result;
use std::fmt;

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
        let bytes = |capture: &Capture| -> u64 {
            capture
                .cameras()
                .iter()
                .map(|camera| 3 * u64::from(camera.width) * u64::from(camera.height))
                .sum()
        };
        Some(self.iter().map(bytes).sum())
    }
}
