//! Evaluation indices: the context and target frames of each scene.

use crate::data::Capture;
use crate::error::{Error, Result};
use crate::io::{read_text, write_json};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Frames of one scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFrames {
    /// Context frames, which the model sees.
    pub context: Vec<usize>,
    /// Target frames, which are rendered and scored.
    pub target: Vec<usize>,
}

impl SceneFrames {
    /// Splits a video of `count` frames, at least three: every other frame is context, and every other one of the rest is a target.
    pub fn alternating(count: usize) -> Self {
        SceneFrames { context: (0..count).step_by(2).collect(), target: (1..count).step_by(4).collect() }
    }

    /// Returns a checksum of the unmodified photo files of these frames, and of their cameras.
    ///
    /// # Errors
    /// Fails if a photo can't be read.
    pub(super) fn checksum(&self, capture: &Capture) -> Result<u32> {
        Ok(capture.checksum(self.context.iter().chain(&self.target).copied())?)
    }

    /// Returns the file names of the target images without their extensions: six-digit frame numbers, as chunks name frames.
    pub(super) fn render_names(&self) -> Vec<String> {
        self.target.iter().map(|frame| format!("{frame:06}")).collect()
    }
}

/// Contents of an index file: `{scene: {"context": [frames], "target": [frames]}}`. A scene that is null is left out.
#[derive(Debug, Clone)]
pub struct EvaluationIndex {
    /// Path of the index file.
    pub file: PathBuf,
    /// Frames of each scene, by the scene's key.
    pub scenes: BTreeMap<String, SceneFrames>,
}

impl EvaluationIndex {
    /// Reads an index from `file`.
    ///
    /// # Errors
    /// Fails if the file can't be read, is not an index, names no scene, or has a scene with fewer than two context frames or no target.
    pub fn read(file: &Path) -> Result<Self> {
        let expected = "{scene: {\"context\": [frames], \"target\": [frames]} or null}";
        let scenes: BTreeMap<String, Option<SceneFrames>> = serde_json::from_str(&read_text(file)?)
            .map_err(|e| Error::input(file, "the index", format!("unusable ({e})"), expected))?;
        let scenes: BTreeMap<_, _> =
            scenes.into_iter().filter_map(|(key, frames)| Some((key, frames?))).collect();
        if scenes.is_empty() {
            return Err(Error::input(file, "the index", "one without scenes", expected));
        }
        for (key, frames) in &scenes {
            let (context, target) = (frames.context.len(), frames.target.len());
            if context < 2 || target == 0 {
                let found = format!("{context} context and {target} target frames");
                return Err(Error::input(file, format!("scene {key}"), found, "2 and 1 at least"));
            }
        }
        Ok(EvaluationIndex { file: file.to_owned(), scenes })
    }

    /// Writes the index to [`EvaluationIndex::file`].
    ///
    /// # Errors
    /// Fails if the file can't be written.
    pub fn write(&self) -> Result<()> {
        Ok(write_json(&self.file, &self.scenes)?)
    }

    /// Returns the name of the index file.
    pub fn name(&self) -> String {
        self.file.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Returns the number of context frames of the first scene. Indices have the same number for every scene.
    pub fn context_views(&self) -> usize {
        self.scenes.values().next().map_or(0, |frames| frames.context.len())
    }

    /// Returns the frames of scene `key`, which has `count` frames.
    ///
    /// # Errors
    /// Fails if the index names a frame that the scene doesn't have.
    pub(super) fn frames(&self, key: &str, count: usize) -> Result<&SceneFrames> {
        let frames = &self.scenes[key];
        match frames.context.iter().chain(&frames.target).find(|&&frame| frame >= count) {
            None => Ok(frames),
            Some(frame) => {
                let expected = format!("one of the scene's {count}, 0 to {}", count.saturating_sub(1));
                Err(Error::input(&self.file, format!("a frame of scene {key}"), frame, expected))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<EvaluationIndex> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        EvaluationIndex::read(file.path())
    }

    #[test]
    fn null_scenes_are_left_out() {
        let index = read(r#"{"b": null, "a": {"context": [3, 0], "target": [1], "overlap": 0.5}}"#).unwrap();
        assert_eq!(index.scenes.keys().collect::<Vec<_>>(), ["a"]);
        assert_eq!(index.frames("a", 4).unwrap().context, [3, 0]);
        let error = index.frames("a", 3).unwrap_err().to_string();
        assert!(error.contains("a frame of scene a is 3, expected one of the scene's 3, 0 to 2"), "{error}");
    }

    #[test]
    fn malformed_indices_are_refused() {
        for (text, found) in [
            ("{}", "one without scenes"),
            ("{\"a\": null}", "one without scenes"),
            ("[1]", "unusable"),
            ("{\"a\": {\"context\": [1, -2], \"target\": [1]}}", "unusable"),
            ("{\"a\": {\"context\": [1, 2.5], \"target\": [1]}}", "unusable"),
            ("{\"a\": {\"context\": [1, 2]}}", "missing field `target`"),
            ("{\"a\": {\"context\": [1], \"target\": [1]}}", "scene a is 1 context and 1 target frames"),
            ("{\"a\": {\"context\": [1, 2], \"target\": []}}", "scene a is 2 context and 0 target frames"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(found), "{error}");
        }
    }
}
