//! Files from which an interrupted evaluation resumes: the settings that it was started with, and the scores of each finished scene.

use super::evaluation::{SceneScores, scene_file_name};
use super::scores_file::{REPORT, SCORES, TABLE, comparison_path};
use crate::error::{Error, Result};
use crate::io::write_json;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Name of the file that an evaluation writes first.
const IDENTITY: &str = "evaluation.json";

/// Settings that must be equal for an evaluation to resume.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Identity {
    #[serde(rename = "subject")]
    pub method: String,
    pub dataset: String,
    pub index: String,
    pub image_size: [u32; 2],
}

/// Scores of a scene as they are stored on disk.
#[derive(Serialize, Deserialize)]
pub(super) struct StoredScores {
    #[serde(flatten)]
    pub scores: SceneScores,
    /// Checksums of the files that were scored, by which replaced files are detected.
    pub files: Option<String>,
}

/// Returns the paths of the files that an evaluation of the scenes `keys` writes into the folder `out`.
pub fn evaluation_files<'a>(out: &Path, keys: impl IntoIterator<Item = &'a String>) -> Vec<PathBuf> {
    let store = ScoreStore::new(out);
    let of_scene = |key: &'a String| [store.file(key), comparison_path(out, key)];
    let of_all = [IDENTITY, SCORES, TABLE].map(|name| out.join(name));
    keys.into_iter().flat_map(of_scene).chain(of_all).collect()
}

/// The folder `scenes` of an evaluation, which holds a file of scores per scene.
pub(super) struct ScoreStore {
    scenes: PathBuf,
}

impl ScoreStore {
    /// Opens the store in the folder `out`, or creates it.
    ///
    /// # Errors
    /// Fails if `out` holds files of another evaluation or a broken store, or if it can't be written.
    pub fn open(out: &Path, identity: &Identity) -> Result<Self> {
        let file = out.join(IDENTITY);
        // An evaluation writes `file` first, so without it these files belong to something else.
        let others = [SCORES, TABLE, REPORT];
        if let (false, Some(name)) = (file.exists(), others.into_iter().find(|name| out.join(name).exists()))
        {
            let found = format!("a folder with a {name} that no evaluation wrote");
            return Err(Error::input(out, "the output", found, "a folder of its own (choose another --out)"));
        }
        let store = ScoreStore::new(out);
        std::fs::create_dir_all(&store.scenes).map_err(Error::write(&store.scenes))?;
        // If no scene has been scored yet, different settings do no harm.
        let mut entries = std::fs::read_dir(&store.scenes).map_err(Error::read(&store.scenes))?;
        if entries.next().is_some()
            && let Ok(text) = std::fs::read(&file)
        {
            let wanted = |of: &Identity| {
                let [height, width] = of.image_size;
                format!("{} on {} by {}, {width}×{height} pixels", of.method, of.dataset, of.index)
            };
            return match serde_json::from_slice::<Identity>(&text) {
                Ok(found) if found == *identity => Ok(store),
                Ok(found) => {
                    let expected = format!("{} (choose another --out)", wanted(identity));
                    Err(Error::input(&file, "the evaluation", format!("of {}", wanted(&found)), expected))
                }
                Err(e) => Err(Error::input(
                    &file,
                    "the file",
                    format!("broken ({e})"),
                    "what globalsplat eval wrote",
                )),
            };
        }
        write_json(&file, identity)?;
        Ok(store)
    }

    /// Returns the store in the folder `out`, without accessing the disk.
    pub fn new(out: &Path) -> Self {
        ScoreStore { scenes: out.join("scenes") }
    }

    /// Returns the stored scores of scene `key`. Returns `None` if there are none, or if they can't be read.
    pub fn read_scores(&self, key: &str) -> Option<StoredScores> {
        let kept: StoredScores = serde_json::from_slice(&std::fs::read(self.file(key)).ok()?).ok()?;
        (kept.scores.scores.scene == key).then_some(kept)
    }

    /// Stores the scores of scene `key`. `files` identifies the files that were scored.
    ///
    /// # Errors
    /// Fails if the file can't be written.
    pub fn write_scores(&self, key: &str, scores: &SceneScores, files: String) -> Result<()> {
        Ok(write_json(&self.file(key), &StoredScores { scores: scores.clone(), files: Some(files) })?)
    }

    fn file(&self, key: &str) -> PathBuf {
        self.scenes.join(format!("{}.json", scene_file_name(key)))
    }
}
