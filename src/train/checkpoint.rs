//! Checkpoints: a folder per step, whole or not there.
//!
//! `RUN/checkpoints/step-00001000/`: `model.safetensors` (weights, with the configuration), `optimizer.safetensors`, and
//! `state.json`, which holds the step, the position in the data, and the others' checksums. `RUN/best/` is the one that
//! validation found best, with its score. Random numbers need no state: those of a sample depend on the seed, which is part
//! of the configuration, and on its position in the data alone.

use super::trainer::Trainer;
use crate::error::{Error, Result};
use crate::io::{
    Inputs, WeightsFile, read_weights, recover_dirs, remove_dir, replace_dir, write_atomically, write_weights,
};
use crate::reconstruct::{ModelDtype, save_model};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use tch::Tensor;

const FOLDER: &str = "checkpoints";
const BEST: &str = "best";
const PREFIX: &str = "step-";
/// The weights of a checkpoint, in its folder.
pub const MODEL_FILE: &str = "model.safetensors";
const OPTIMIZER_FILE: &str = "optimizer.safetensors";
const STATE_FILE: &str = "state.json";
/// All that a checkpoint's folder has of ours. The state comes first, without which there is no checkpoint.
const FILES: [&str; 3] = [STATE_FILE, MODEL_FILE, OPTIMIZER_FILE];
/// Those whose checksums the state has, in the order of their names.
const CHECKED_FILES: [&str; 2] = [MODEL_FILE, OPTIMIZER_FILE];

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct State {
    /// Steps done.
    pub step: u64,
    /// Samples drawn: the position in the data.
    samples: u64,
    /// Sizes in bytes and CRC-32 of the other files, by their names.
    files: BTreeMap<String, (u64, u32)>,
    /// Of the best checkpoint: what validation found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    validation: Option<Validation>,
}

/// What makes a checkpoint the best one.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Validation {
    /// In dB.
    pub psnr: f64,
    /// What the score depends on: scores by other settings can't be compared.
    #[serde(rename = "asked")]
    pub settings: String,
}

/// Of the checkpoint after so many steps.
fn folder_name(step: u64) -> String {
    format!("{PREFIX}{step:08}")
}

/// The run's checkpoints, oldest first.
///
/// # Errors
/// A folder that can't be read.
pub fn list_checkpoints(run: &Path) -> Result<Vec<PathBuf>> {
    let folder = run.join(FOLDER);
    if !folder.is_dir() {
        return Ok(vec![]);
    }
    let mut found = vec![];
    for entry in fs::read_dir(&folder).map_err(Error::read(&folder))? {
        let path = entry.map_err(Error::read(&folder))?.path();
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let step = name.strip_prefix(PREFIX).and_then(|digits| digits.parse::<u64>().ok());
        // A name that we don't give is somebody's own.
        if let Some(step) = step.filter(|&step| name == folder_name(step)) {
            found.push((step, path));
        }
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// The newest one.
///
/// # Errors
/// None there, a folder that can't be read, or a checkpoint that was damaged.
pub fn latest_checkpoint(run: &Path) -> Result<PathBuf> {
    let none = || {
        Error::input(run, "the run", "without a checkpoint", "a folder that `globalsplat train --out` made")
    };
    let latest = list_checkpoints(run)?.pop().ok_or_else(none)?;
    check(&latest)?;
    Ok(latest)
}

/// The one that validation found best.
///
/// # Errors
/// A run that has none, or whose best checkpoint was damaged.
pub fn best_checkpoint(run: &Path) -> Result<PathBuf> {
    let best = run.join(BEST);
    match best.is_dir() {
        true => check(&best).map(|_| best),
        false => {
            let expected = "one with held-out views (data.holdout) or scenes (data.validation)";
            Err(Error::input(run, "the run", "without a best checkpoint", expected))
        }
    }
}

/// Adds the files of the run's checkpoints to `inputs`.
pub(super) fn add_checkpoints(run: &Path, inputs: &mut Inputs) {
    [FOLDER, BEST].iter().for_each(|folder| inputs.add_folder(&run.join(folder)));
}

/// A checkpoint as it is told to people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Kept {
    /// Its folder in the run's.
    pub name: String,
    /// Steps done.
    pub step: u64,
    /// Of its files together.
    pub bytes: u64,
    /// Seconds since it was saved.
    pub age: u64,
    /// Of the best checkpoint: what validation found, in dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
}

/// The run's checkpoints, oldest first, and its best one. What is being replaced meanwhile is left out.
pub(super) fn kept(run: &Path) -> (Vec<Kept>, Option<Kept>) {
    let told = |path: &PathBuf| {
        let state = read_state(path).ok()?;
        let saved = fs::metadata(path.join(STATE_FILE)).and_then(|file| file.modified()).ok()?;
        Some(Kept {
            name: path.strip_prefix(run).unwrap_or(path).display().to_string(),
            step: state.step,
            bytes: state.files.values().map(|(bytes, _)| bytes).sum(),
            // A clock that was set back.
            age: saved.elapsed().unwrap_or_default().as_secs(),
            psnr: state.validation.map(|validation| validation.psnr),
        })
    };
    let checkpoints = list_checkpoints(run).unwrap_or_default();
    (checkpoints.iter().filter_map(told).collect(), told(&run.join(BEST)))
}

/// Puts right what a run that was killed within a save left.
///
/// # Errors
/// The system's refusal.
pub(super) fn recover(run: &Path) -> Result<()> {
    recover_dirs(run, &FILES)?;
    recover_dirs(&run.join(FOLDER), &FILES)
}

/// What validation, by `settings`, found the run's best checkpoint to be worth, in dB.
///
/// # Errors
/// One that can't be read, or was found by other settings.
pub(super) fn best_score(run: &Path, settings: &str) -> Result<Option<f64>> {
    let best = run.join(BEST);
    if !best.is_dir() {
        return Ok(None);
    }
    match check(&best)?.validation {
        Some(validation) if validation.settings == settings => Ok(Some(validation.psnr)),
        found => {
            let found = found.map_or("absent".into(), |validation| format!("of {}", validation.settings));
            Err(Error::input(&best, "the validation", found, format!("one of {settings}")))
        }
    }
}

/// Makes `checkpoint` the run's best one, for what validation found. The files are shared where the file system can.
///
/// # Errors
/// The system's refusal to write; the best one before is left whole.
pub(super) fn keep_best(run: &Path, checkpoint: &Path, validation: Validation) -> Result<()> {
    let state = State { validation: Some(validation), ..read_state(checkpoint)? };
    replace_dir(&run.join(BEST), &FILES, |folder| {
        for name in state.files.keys() {
            let (from, to) = (checkpoint.join(name), folder.join(name));
            if fs::hard_link(&from, &to).is_err() {
                fs::copy(&from, &to).map_err(Error::write(&to))?;
                fs::File::open(&to).and_then(|file| file.sync_all()).map_err(Error::write(&to))?;
            }
        }
        write_state(folder, &state)
    })
}

impl Trainer {
    /// Where [`Trainer::save`] puts the state as it is.
    pub(super) fn checkpoint(&self, run: &Path) -> PathBuf {
        run.join(FOLDER).join(folder_name(self.step))
    }

    /// Saves a checkpoint under `run`, with the state of `optimizer`, drops the oldest beyond those to keep, and returns where it is.
    ///
    /// # Errors
    /// The system's refusal to write; older checkpoints are left whole.
    pub(super) fn save(&self, run: &Path, optimizer: &BTreeMap<String, Tensor>) -> Result<PathBuf> {
        let path = self.checkpoint(run);
        replace_dir(&path, &FILES, |folder| {
            save_model(&folder.join(MODEL_FILE), &self.vs, &self.config, self.stage(), ModelDtype::F32)?;
            write_weights(&folder.join(OPTIMIZER_FILE), optimizer, Default::default())?;
            let files = CHECKED_FILES.map(|name| Ok((name.into(), checksum(&folder.join(name))?)));
            let files = files.into_iter().collect::<Result<_>>()?;
            let (step, samples) = (self.step, self.samples);
            write_state(folder, &State { step, samples, files, validation: None })
        })?;
        drop_surplus(run, &path, self.config.train.keep_checkpoints)?;
        Ok(path)
    }

    /// Goes on from a checkpoint, which [`check`] found whole and of `state`. Weights that don't fit it leave the trainer
    /// unusable, all else as it was.
    ///
    /// # Errors
    /// Files that can't be read, or were written for another model.
    pub(super) fn load(&mut self, checkpoint: &Path, state: &State) -> Result<()> {
        let file = checkpoint.join(MODEL_FILE);
        WeightsFile::open(&file)?.load_into(&self.vs)?;
        let file = checkpoint.join(OPTIMIZER_FILE);
        self.optimizer.load_state(&file, &read_weights(&file)?.tensors)?;
        (self.step, self.samples) = (state.step, state.samples);
        Ok(())
    }
}

/// Drops the oldest checkpoints beyond the `kept` last ones, but never `latest`. Broken ones are worth nothing: they don't
/// count, and go with what they are older than.
///
/// # Errors
/// The system's refusal to remove.
pub(super) fn drop_surplus(run: &Path, latest: &Path, kept: usize) -> Result<()> {
    let mut others = list_checkpoints(run)?;
    others.retain(|other| other != latest);
    let (whole, broken): (Vec<_>, Vec<_>) = others.into_iter().partition(|other| seems_whole(other));
    let surplus = (whole.len() + 1).saturating_sub(kept);
    let useless = broken.iter().filter(|broken| broken.as_path() < latest);
    for old in whole.iter().take(surplus).chain(useless) {
        remove_dir(old, &FILES)?;
    }
    Ok(())
}

/// Whether a checkpoint is whole: its files are as they were written.
///
/// # Errors
/// What is missing or damaged.
pub(super) fn check(checkpoint: &Path) -> Result<State> {
    let state = read_state(checkpoint)?;
    for (name, (bytes, crc)) in &state.files {
        let file = checkpoint.join(name);
        let found = checksum(&file)?;
        if found != (*bytes, *crc) {
            let found = format!("damaged ({} bytes, checksum {:08x})", found.0, found.1);
            return Err(Error::input(&file, "the file", found, format!("{bytes} bytes, checksum {crc:08x}")));
        }
    }
    Ok(state)
}

/// Whether a checkpoint's files are there and as long as they were. [`check`] reads all of them.
fn seems_whole(checkpoint: &Path) -> bool {
    let is_long = |(name, (bytes, _)): (&String, &(u64, u32))| {
        fs::metadata(checkpoint.join(name)).is_ok_and(|file| file.len() == *bytes)
    };
    read_state(checkpoint).is_ok_and(|state| state.files.iter().all(is_long))
}

fn read_state(checkpoint: &Path) -> Result<State> {
    let file = checkpoint.join(STATE_FILE);
    let state = fs::read(&file).map_err(Error::read(&file))?;
    let expected = "what globalsplat train writes";
    let state: State = serde_json::from_slice(&state)
        .map_err(|e| Error::input(&file, "the file", format!("broken ({e})"), expected))?;
    let names: Vec<&str> = state.files.keys().map(String::as_str).collect();
    match names == CHECKED_FILES {
        true => Ok(state),
        false => {
            let expected = format!("{CHECKED_FILES:?}");
            Err(Error::input(&file, "the names in files", format!("{names:?}"), expected))
        }
    }
}

fn write_state(checkpoint: &Path, state: &State) -> Result<()> {
    let (file, json) = (checkpoint.join(STATE_FILE), serde_json::to_vec(state).expect("numbers and names"));
    write_atomically(&file, |writer| writer.write_all(&json).map_err(Error::write(&file)))
}

/// A file's size and CRC-32.
fn checksum(path: &Path) -> Result<(u64, u32)> {
    let mut file = fs::File::open(path).map_err(Error::read(path))?;
    let (mut buffer, mut hasher, mut size) = (vec![0; 1 << 20], crc32fast::Hasher::new(), 0);
    loop {
        match file.read(&mut buffer).map_err(Error::read(path))? {
            0 => return Ok((size, hasher.finalize())),
            count => {
                hasher.update(&buffer[..count]);
                size += count as u64;
            }
        }
    }
}
