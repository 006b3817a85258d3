//! The file that records how far an estimate of poses has come, so that the same call continues it.

use crate::estimate::{Matching, PoseReport, Step};
use crate::photos::{FoundPhoto, Photo, SkippedPhoto};
use globalsplat_files::{Error, Result, read_text, write_json};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the file, in the capture's folder.
pub(crate) const FILE: &str = "capture.json";

/// How far an estimate has come, and for which photos and settings.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Record {
    /// Version of COLMAP, as `pycolmap 4.2.1`.
    pub colmap: String,
    /// Camera model, or `None` to choose it by the number of photos.
    pub camera_model: Option<String>,
    /// Choice of pairs.
    pub matching: Matching,
    /// Folder of masks that the user named.
    pub masks: Option<PathBuf>,
    /// Photos in the folder of the user.
    pub found: Vec<FoundPhoto>,
    /// Photos in the folder of images, once they are all there.
    pub photos: Option<Vec<Photo>>,
    /// Photos that aren't used.
    pub skipped: Vec<SkippedPhoto>,
    /// `true` if the database has a camera for each group of photos.
    pub has_cameras: bool,
    /// `true` if the database has the features of all photos.
    pub has_features: bool,
    /// Number of pairs whose features are matched.
    pub matched_pairs: usize,
    /// Seconds that each step took, in all calls together.
    pub seconds: BTreeMap<Step, f64>,
    /// The result.
    pub report: Option<PoseReport>,
}

impl Record {
    /// Reads the record in the folder `out`, if there is one.
    ///
    /// # Errors
    /// Returns an error if the file isn't a record.
    pub fn read(out: &Path) -> Result<Option<Self>> {
        let file = out.join(FILE);
        if !file.exists() {
            return Ok(None);
        }
        let refuse = |why| Error::input(&file, "the contents", why, "what an earlier run wrote");
        serde_json::from_str(&read_text(&file)?).map(Some).map_err(refuse)
    }

    /// Writes the record to the folder `out`.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn write(&self, out: &Path) -> Result<()> {
        write_json(&out.join(FILE), self)
    }
}
