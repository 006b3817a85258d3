//! State of a refinement, from which another one continues.

use crate::error::{Error, Result};
use crate::io::{read_weights, write_weights};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tch::Tensor;

/// Beginning of the names of the tensors of the Gaussians' optimizer in a file.
pub(super) const GAUSSIANS: &str = "gaussians.";
/// Beginning of the names of the tensors of the corrections of the photos in a file.
const CORRECTIONS: &str = "corrections.";
/// Key of the metadata under which the file has the [`Record`].
const RECORD: &str = "refinement";

/// How far an optimization has come.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct TrainProgress {
    /// Number of steps done.
    pub steps: u64,
    /// Time that the optimization took.
    pub time: Duration,
    /// Position in the sequence of random numbers.
    pub random: u128,
}

/// What a state has besides tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// Names of the photos that were matched.
    pub photos: Vec<String>,
    /// Origin and scale of the local frame that the Gaussians are in.
    pub frame: [f64; 4],
    /// Where the optimization has ended.
    pub progress: TrainProgress,
    /// Total time, with reading the photos and everything else.
    pub total: Duration,
    /// Depth of the scene, the unit of lengths.
    pub depth: f64,
    /// `true` if the plane sweep's depths were used.
    pub has_depths: bool,
    /// `true` if the Gaussians are optimized for antialiased rendering.
    pub antialiased: bool,
    /// `true` if the optimization began with a splat, whose number of Gaussians stays.
    pub from_splat: bool,
    /// How the Gaussians have grown.
    pub growth: Growth,
}

/// Growth of the Gaussians' number and of their spherical harmonics.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Growth {
    /// Number of Gaussians at the start of the optimization.
    pub first_count: i64,
    /// Degree of the spherical harmonics at the start and at the end of the optimization.
    pub degrees: [i64; 2],
    /// Degree that the last step used.
    pub degree: i64,
    /// Number of steps in the average of the parameters.
    pub averaged_steps: u64,
}

/// State of a refinement: parameters of the Gaussians and of the corrections, the moments of their optimizers, and how far the optimization
/// has come. It is valid for the capture, the photos and the corrections that it was made with.
#[derive(Debug)]
pub struct RefineState {
    pub(super) record: Record,
    /// Parameters of the Gaussians, their averages and their moments.
    pub(super) gaussians: BTreeMap<String, Tensor>,
    /// Parameters of the corrections of the photos and their moments.
    pub(super) corrections: BTreeMap<String, Tensor>,
    /// File for error messages.
    pub(super) file: PathBuf,
}

impl RefineState {
    /// Returns the path of the state that belongs to the splat at `path`: `room.state.safetensors` for `room.ply`.
    pub fn path_for(splat: &Path) -> PathBuf {
        splat.with_extension("state.safetensors")
    }

    /// Reads a state.
    ///
    /// # Errors
    /// Returns an error if the file can't be read or isn't a state.
    pub fn read(path: &Path) -> Result<Self> {
        let weights = read_weights(path)?;
        let record = weights.metadata.get(RECORD).and_then(|text| serde_json::from_str(text).ok());
        let record = record.ok_or_else(|| {
            let field = format!("the metadata {RECORD}");
            Error::input(path, field, "missing or invalid", "that of a refinement's state")
        })?;
        let with_prefix = |prefix: &str| {
            let tensors = weights.tensors.iter();
            let named =
                |(name, t): (&String, &Tensor)| Some((name.strip_prefix(prefix)?.into(), t.shallow_clone()));
            tensors.filter_map(named).collect()
        };
        let (gaussians, corrections) = (with_prefix(GAUSSIANS), with_prefix(CORRECTIONS));
        Ok(RefineState { record, gaussians, corrections, file: path.to_owned() })
    }

    /// Writes the state to a safetensors file, atomically.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let record = serde_json::to_string(&self.record).expect("numbers and names");
        let tensors = [(GAUSSIANS, &self.gaussians), (CORRECTIONS, &self.corrections)];
        let named = tensors.into_iter().flat_map(|(prefix, tensors)| {
            tensors.iter().map(move |(name, t)| (format!("{prefix}{name}"), t.shallow_clone()))
        });
        write_weights(path, &named.collect(), HashMap::from([(RECORD.into(), record)]))
    }

    /// Returns the number of steps that led to the state.
    pub fn steps(&self) -> u64 {
        self.record.progress.steps
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> usize {
        self.gaussians.get("value.means").map_or(0, |means| means.size()[1] as usize)
    }

    /// Returns `true` if it has corrections of exposures.
    pub(super) fn has_exposures(&self) -> bool {
        self.corrections.contains_key("value.exposures")
    }
}
