//! State of a refinement, from which another one continues.

use super::gaussian_params::{NAMES, shapes};
use super::options::{Budget, RefineOptions};
use crate::error::{Error, Result};
use crate::io::{read_weights, write_weights};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, HashMap};
use std::fmt::Debug;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tch::{Kind, Tensor};

/// Beginning of the names of the tensors of the Gaussians' optimizer in a file.
const GAUSSIANS: &str = "gaussians.";
/// Beginning of the names of the tensors of the corrections of the photos in a file.
const CORRECTIONS: &str = "corrections.";
/// Key of the metadata under which the file has the [`Record`].
const RECORD: &str = "refinement";
/// Key of the metadata under which the file has [`RefineState::sources`].
const SOURCES: &str = "sources";
/// Maximum number of steps, which float64 represents exactly.
const MAX_STEPS: u64 = 1 << 53;
/// Maximum total time: ten years.
const MAX_TIME: Duration = Duration::from_secs(10 * 365 * 24 * 3600);

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
    /// Names of the photos that were matched, and the checksum of each with its camera and mask.
    pub photos: Vec<(String, u32)>,
    /// Number of pixels along the longest side of the photos.
    pub side: u32,
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
    /// Options that can't be changed, by name.
    pub settings: BTreeMap<String, Value>,
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
    /// Descriptions of what the initial Gaussians came from, such as the checksum of a file. Set it before [`RefineState::write`];
    /// [`RefineState::check_source`] compares.
    pub sources: Vec<String>,
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
        let record = parse_metadata(path, &weights.metadata, RECORD)?;
        let sources = parse_metadata(path, &weights.metadata, SOURCES)?;
        let with_prefix = |prefix: &str| {
            let tensors = weights.tensors.iter();
            let named =
                |(name, t): (&String, &Tensor)| Some((name.strip_prefix(prefix)?.into(), t.shallow_clone()));
            tensors.filter_map(named).collect()
        };
        let (gaussians, corrections) = (with_prefix(GAUSSIANS), with_prefix(CORRECTIONS));
        let state = RefineState { record, gaussians, corrections, file: path.to_owned(), sources };
        state.check().map(|()| state)
    }

    /// Checks every field that a file may have wrong.
    fn check(&self) -> Result<()> {
        let Record { photos, frame, progress, total, depth, growth, .. } = &self.record;
        let Growth { first_count, degrees, degree, averaged_steps } = growth;
        let count = match self.gaussians.get("value.means").map(Tensor::size).as_deref() {
            Some(&[1, count, 3]) if count > 0 => count,
            // No other shape is valid.
            _ => return self.check_tensor(GAUSSIANS, "value.means", &[1, 1, 3]),
        };
        let is_below_2_68 = progress.random >> 68 == 0;
        let rules: [(&str, bool, &dyn Debug, &str); 11] = [
            ("photos", !photos.is_empty(), photos, "one or more"),
            (
                "frame",
                frame.iter().all(|x| x.is_finite()) && frame[3] > 0.,
                frame,
                "finite numbers, the last one above 0",
            ),
            ("depth", *depth > 0. && depth.is_finite(), depth, "a finite number above 0"),
            ("steps", progress.steps <= MAX_STEPS, &progress.steps, "at most 2^53"),
            ("random", is_below_2_68, &progress.random, "below 2^68"),
            ("total", *total <= MAX_TIME, total, "at most ten years"),
            ("time", progress.time <= *total, &progress.time, "at most the total time"),
            (
                "degrees",
                0 <= degrees[0] && degrees.is_sorted() && degrees[1] <= 3,
                degrees,
                "two numbers of 0 to 3 that don't decrease",
            ),
            (
                "degree",
                (degrees[0]..=degrees[1]).contains(degree),
                degree,
                "one of the degrees, or between them",
            ),
            (
                "first_count",
                (1..=count).contains(first_count),
                first_count,
                "1 up to the number of Gaussians",
            ),
            (
                "averaged_steps",
                *averaged_steps <= progress.steps,
                averaged_steps,
                "at most the number of steps",
            ),
        ];
        if let Some((field, _, found, expected)) = rules.iter().find(|(_, is_met, ..)| !is_met) {
            return Err(Error::input(&self.file, *field, format!("{found:?}"), *expected));
        }
        let average = (*averaged_steps > 0).then_some("average");
        for kind in ["value", "first", "second"].into_iter().chain(average) {
            for (name, shape) in NAMES.iter().zip(shapes(count, degrees[1])) {
                self.check_tensor(GAUSSIANS, &format!("{kind}.{name}"), &shape)?;
            }
        }
        self.check_tensor(GAUSSIANS, "steps", &[1])?;
        for (name, columns) in [("poses", 6), ("exposures", 3)] {
            if self.corrections.contains_key(&format!("value.{name}")) {
                for kind in ["value", "first", "second"] {
                    self.check_tensor(
                        CORRECTIONS,
                        &format!("{kind}.{name}"),
                        &[photos.len() as i64, columns],
                    )?;
                }
                self.check_tensor(CORRECTIONS, "steps", &[1])?;
            }
        }
        Ok(())
    }

    /// Checks the shape, the type and the numbers of a tensor.
    fn check_tensor(&self, group: &str, key: &str, shape: &[i64]) -> Result<()> {
        let tensors = if group == GAUSSIANS { &self.gaussians } else { &self.corrections };
        let kind = if key == "steps" { Kind::Int64 } else { Kind::Float };
        let refuse = |found: String, expected: String| {
            Err(Error::input(&self.file, format!("tensor {group}{key}"), found, expected))
        };
        let describe = |kind: Kind, shape: &[i64]| format!("{kind:?} of shape {shape:?}");
        let Some(t) = tensors.get(key) else { return refuse("missing".into(), describe(kind, shape)) };
        if t.kind() != kind || t.size() != shape {
            return refuse(describe(t.kind(), &t.size()), describe(kind, shape));
        }
        let is_any = |t: Tensor| t.any().int64_value(&[]) == 1;
        match key {
            "steps" if t.int64_value(&[0]) != self.steps() as i64 => {
                refuse(t.int64_value(&[0]).to_string(), format!("{}, the number of steps", self.steps()))
            }
            _ if is_any(t.isfinite().logical_not()) => refuse("not finite".into(), "finite numbers".into()),
            _ if key.starts_with("second") && is_any(t.lt(0)) => refuse("below 0".into(), "0 or more".into()),
            _ => Ok(()),
        }
    }

    /// Returns an error if a refinement with `options` can't continue from the state: if an option differs, or if the budget has been used up.
    pub(super) fn check_options(&self, options: &RefineOptions) -> Result<()> {
        let Record { settings, antialiased, progress, total, .. } = &self.record;
        let refuse = |field: &str, found: String, expected: String| {
            Err(Error::input(&self.file, field, found, expected))
        };
        if options.antialiased && !antialiased {
            return refuse("antialiased", "false".into(), "true, as requested".into());
        }
        for (name, expected) in options.fixed_settings() {
            if settings.get(&name) != Some(&expected) {
                let found = settings.get(&name).map_or("missing".into(), Value::to_string);
                return refuse(&name, found, format!("{expected}, as requested"));
            }
        }
        if let Some(count) = options.gaussians.filter(|&count| count < self.count()) {
            return refuse(
                "the number of Gaussians",
                self.count().to_string(),
                format!("at most {count}, as requested"),
            );
        }
        let (used, expected) = match options.budget() {
            Budget::Steps(steps) if steps <= progress.steps => {
                (format!("{} steps", progress.steps), "more steps in all")
            }
            Budget::Time(time) if time <= *total => {
                (format!("{:.0} s", total.as_secs_f64()), "more time in all")
            }
            _ => return Ok(()),
        };
        refuse("the refinement", format!("one of {used} already"), expected.into())
    }

    /// Returns an error if none of [`RefineState::sources`] is `source`.
    ///
    /// # Errors
    /// Returns an error that names the first source.
    pub fn check_source(&self, source: &str) -> Result<()> {
        if self.sources.iter().any(|known| known == source) {
            return Ok(());
        }
        let found = self.sources.first().map_or("missing", String::as_str);
        Err(Error::input(&self.file, "the source of the Gaussians", found, source))
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
        let sources = serde_json::to_string(&self.sources).expect("texts");
        let metadata = HashMap::from([(RECORD.into(), record), (SOURCES.into(), sources)]);
        write_weights(path, &named.collect(), metadata)
    }

    /// Returns the number of steps that led to the state.
    pub fn steps(&self) -> u64 {
        self.record.progress.steps
    }

    /// Returns the number of Gaussians.
    pub fn count(&self) -> usize {
        self.gaussians.get("value.means").map_or(0, |means| means.size()[1] as usize)
    }

    /// Returns the parameters `name` of the corrections, which have `shape`.
    ///
    /// # Errors
    /// Returns an error if they are missing or have another shape.
    pub(super) fn correction(&self, name: &str, shape: &[i64]) -> Result<&Tensor> {
        let key = format!("value.{name}");
        self.check_tensor(CORRECTIONS, &key, shape).map(|()| &self.corrections[&key])
    }

    /// Returns `true` if it has corrections of exposures.
    pub(super) fn has_exposures(&self) -> bool {
        self.corrections.contains_key("value.exposures")
    }
}

/// Parses the entry `key` of the `metadata` of the state at `path`.
fn parse_metadata<T: for<'a> Deserialize<'a>>(
    path: &Path,
    metadata: &HashMap<String, String>,
    key: &str,
) -> Result<T> {
    let parsed = metadata.get(key).map(|text| serde_json::from_str(text));
    let found = match parsed {
        Some(Ok(value)) => return Ok(value),
        Some(Err(e)) => format!("invalid ({e})"),
        None => "missing".into(),
    };
    Err(Error::input(path, format!("the metadata {key}"), found, "that of a refinement's state"))
}
