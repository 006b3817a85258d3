//! Checkpoints: one folder per step.
//!
//! `RUN/checkpoints/step-00001000/` has `model.safetensors` (weights and configuration), `optimizer.safetensors`, and `state.json` with the
//! step, the position in the data, and the checksums of the other files. The state is written last and removed first: a folder without it is
//! no checkpoint. `RUN/best` is a link to the checkpoint with the best validation score, whose state has this score. Random number
//! generators need no state: the random numbers of a sample depend only on the seed, which is part of the configuration, and on the
//! sample's position in the data.

use super::trainer::Trainer;
use crate::error::{Error, Result};
use crate::io::{
    InputFiles, WeightsFile, checksum, read_weights, replace_link, sync_dir, write_json, write_weights,
};
use crate::model::Precision;
use crate::reconstruct::save_model;
use serde::{Deserialize, Serialize};
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

const FOLDER: &str = "checkpoints";
const BEST: &str = "best";
const PREFIX: &str = "step-";
/// Name of the file in a checkpoint's folder that has the weights.
pub const MODEL_FILE: &str = "model.safetensors";
const OPTIMIZER_FILE: &str = "optimizer.safetensors";
const STATE_FILE: &str = "state.json";
const LOCK_FILE: &str = ".lock";
/// Files of a checkpoint. The state comes first, because without it there is no checkpoint.
const FILES: [&str; 3] = [STATE_FILE, MODEL_FILE, OPTIMIZER_FILE];

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct State {
    /// Number of steps done.
    pub step: u64,
    /// Number of samples drawn, which is the position in the data.
    samples: u64,
    files: Files,
    /// Validation score, if it was the best one so far.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    validation: Option<Validation>,
}

/// Size in bytes and CRC-32 of each of a checkpoint's other files.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Files {
    #[serde(rename = "model.safetensors")]
    model: (u64, u32),
    #[serde(rename = "optimizer.safetensors")]
    optimizer: (u64, u32),
}

/// Validation score of a checkpoint.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Validation {
    /// PSNR in dB.
    pub psnr: f64,
    /// Settings that the score depends on. Scores with other settings can't be compared.
    #[serde(rename = "asked")]
    pub settings: String,
}

/// Returns the folder name of the checkpoint after `step` steps.
fn folder_name(step: u64) -> String {
    format!("{PREFIX}{step:08}")
}

/// Lists the run's checkpoints, oldest first.
///
/// # Errors
/// Returns an error if a folder can't be read.
pub fn list_checkpoints(run: &Path) -> Result<Vec<PathBuf>> {
    let mut folders = list_folders(run)?;
    folders.retain(|folder| folder.join(STATE_FILE).exists());
    Ok(folders)
}

/// Lists the folders of the run's checkpoints, including incomplete ones, in order of their steps.
fn list_folders(run: &Path) -> Result<Vec<PathBuf>> {
    let folder = run.join(FOLDER);
    if !folder.is_dir() {
        return Ok(vec![]);
    }
    let mut found = vec![];
    for entry in fs::read_dir(&folder).map_err(Error::read(&folder))? {
        let path = entry.map_err(Error::read(&folder))?.path();
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let step = name.strip_prefix(PREFIX).and_then(|digits| digits.parse::<u64>().ok());
        // Folders with other names aren't ours.
        if let Some(step) = step.filter(|&step| name == folder_name(step)) {
            found.push((step, path));
        }
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// Returns the run's newest checkpoint.
///
/// # Errors
/// Returns an error if there is no checkpoint, a folder can't be read, or the checkpoint is damaged.
pub fn latest_checkpoint(run: &Path) -> Result<PathBuf> {
    let none = || {
        Error::input(run, "the run", "without a checkpoint", "a folder that `globalsplat train --out` made")
    };
    let latest = list_checkpoints(run)?.pop().ok_or_else(none)?;
    check(&latest)?;
    Ok(latest)
}

/// Returns the run's checkpoint with the best validation score.
///
/// # Errors
/// Returns an error if the run has no best checkpoint, or if it is damaged.
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
pub(super) fn add_checkpoints(run: &Path, inputs: &mut InputFiles) {
    [FOLDER, BEST].iter().for_each(|folder| inputs.add_folder(&run.join(folder)));
}

/// Removes what a run left that was killed during a save.
pub(super) fn remove_incomplete(run: &Path) -> Result<()> {
    let is_incomplete = |folder: &PathBuf| !folder.join(STATE_FILE).exists();
    list_folders(run)?.into_iter().filter(is_incomplete).try_for_each(|folder| remove(&folder))
}

/// Returns the validation PSNR of the run's best checkpoint in dB, or `None` if there is no best checkpoint.
///
/// # Errors
/// Returns an error if the checkpoint can't be read or is damaged, or if its score was measured with settings other than `settings`.
pub(super) fn best_score(run: &Path, settings: &str) -> Result<Option<f64>> {
    let best = run.join(BEST);
    if !best.is_dir() {
        return Ok(None);
    }
    match check(&best)?.validation {
        Some(validation) if validation.settings == settings => Ok(Some(validation.psnr)),
        found => {
            let found = found.map_or("missing".into(), |validation| format!("of {}", validation.settings));
            Err(Error::input(&best, "the validation", found, format!("one of {settings}")))
        }
    }
}

/// Makes `checkpoint` the run's best checkpoint, with the score `validation`.
///
/// # Errors
/// Returns an error if files can't be written. The previous best checkpoint then stays the best one.
pub(super) fn keep_best(run: &Path, checkpoint: &Path, validation: Validation) -> Result<()> {
    let state = State { validation: Some(validation), ..read_state(checkpoint)? };
    write_json(&checkpoint.join(STATE_FILE), &state)?;
    let target = checkpoint.strip_prefix(run).expect("a checkpoint of the run");
    replace_link(&run.join(BEST), target)
}

impl Trainer {
    /// Returns the folder in which [`Trainer::save`] stores the current state.
    pub(super) fn checkpoint(&self, run: &Path) -> PathBuf {
        run.join(FOLDER).join(folder_name(self.step))
    }

    /// Saves a checkpoint under `run` and returns its folder. Removes the oldest checkpoints beyond those to keep.
    ///
    /// # Errors
    /// Returns an error if files can't be written. Older checkpoints then stay complete.
    pub(super) fn save(&self, run: &Path) -> Result<PathBuf> {
        let path = self.checkpoint(run);
        remove(&path)?;
        if let Err(e) = self.write_checkpoint(&path) {
            let _ = remove(&path);
            return Err(e);
        }
        prune_checkpoints(run, &path, self.config.train.keep_checkpoints)?;
        Ok(path)
    }

    fn write_checkpoint(&self, folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).map_err(Error::write(folder))?;
        save_model(&folder.join(MODEL_FILE), &self.vs, &self.config, self.stage(), Precision::F32)?;
        write_weights(&folder.join(OPTIMIZER_FILE), &self.optimizer.state(), Default::default())?;
        let [model, optimizer] =
            [MODEL_FILE, OPTIMIZER_FILE].map(|name| size_and_checksum(&folder.join(name)));
        let files = Files { model: model?, optimizer: optimizer? };
        let state = State { step: self.step, samples: self.samples, files, validation: None };
        write_json(&folder.join(STATE_FILE), &state)?;
        folder.parent().map(sync_dir);
        Ok(())
    }

    /// Loads a checkpoint, for which [`check`] returned `state`. After an error, the weights and the optimizer's state may be those of the
    /// checkpoint, so that the trainer can't be used any more.
    ///
    /// # Errors
    /// Returns an error if files can't be read or were written for another model.
    pub(super) fn load(&mut self, checkpoint: &Path, state: &State) -> Result<()> {
        let file = checkpoint.join(MODEL_FILE);
        WeightsFile::open(&file)?.load_into(&self.vs)?;
        let file = checkpoint.join(OPTIMIZER_FILE);
        self.optimizer.load_state(&file, &read_weights(&file)?.tensors)?;
        (self.step, self.samples) = (state.step, state.samples);
        Ok(())
    }
}

/// Removes the oldest checkpoints beyond the `kept` newest ones, but never `latest` or the best one.
pub(super) fn prune_checkpoints(run: &Path, latest: &Path, kept: usize) -> Result<()> {
    let best = fs::read_link(run.join(BEST)).map(|target| run.join(target)).ok();
    let mut others = list_checkpoints(run)?;
    others.retain(|other| other != latest && best.as_ref() != Some(other));
    let surplus = (others.len() + 1).saturating_sub(kept);
    others[..surplus].iter().try_for_each(|old| remove(old))
}

/// Removes a checkpoint's files, and its folder unless it has other files. If that fails, what is left is no checkpoint.
fn remove(folder: &Path) -> Result<()> {
    let unless = |expected: &[ErrorKind], removed: io::Result<()>| match removed {
        Err(e) if !expected.contains(&e.kind()) => Err(Error::write(folder)(e)),
        _ => Ok(()),
    };
    for name in FILES {
        // A process that was killed while it wrote the file left the partial one.
        for file in [name, &format!(".{name}.globalsplat-partial")] {
            unless(&[ErrorKind::NotFound], fs::remove_file(folder.join(file)))?;
        }
    }
    unless(&[ErrorKind::NotFound, ErrorKind::DirectoryNotEmpty], fs::remove_dir(folder))
}

/// Checks that a checkpoint is complete and its files have not changed since they were written. Returns its state.
pub(super) fn check(checkpoint: &Path) -> Result<State> {
    let state = read_state(checkpoint)?;
    for (name, (bytes, crc)) in [(MODEL_FILE, state.files.model), (OPTIMIZER_FILE, state.files.optimizer)] {
        let file = checkpoint.join(name);
        let found = size_and_checksum(&file)?;
        if found != (bytes, crc) {
            let found = format!("damaged ({} bytes, checksum {:08x})", found.0, found.1);
            return Err(Error::input(&file, "the file", found, format!("{bytes} bytes, checksum {crc:08x}")));
        }
    }
    Ok(state)
}

fn read_state(checkpoint: &Path) -> Result<State> {
    let file = checkpoint.join(STATE_FILE);
    let state = fs::read(&file).map_err(Error::read(&file))?;
    let expected = "what globalsplat train writes";
    serde_json::from_slice(&state)
        .map_err(|e| Error::input(&file, "the file", format!("broken ({e})"), expected))
}

/// Returns the size and CRC-32 of a file.
fn size_and_checksum(path: &Path) -> Result<(u64, u32)> {
    let size = fs::metadata(path).map_err(Error::read(path))?.len();
    Ok((size, checksum([path])?))
}

/// Lock that limits a run's folder to one training process; two would overwrite each other's checkpoints. It is released when it is dropped, or when the process ends for any reason.
#[derive(Debug)]
pub(super) struct RunLock {
    _file: File,
}

impl RunLock {
    /// Returns `true` if a run ever locked the folder `run`.
    pub(super) fn was_ever_locked(run: &Path) -> bool {
        run.join(LOCK_FILE).exists()
    }

    /// Locks the folder `run`, which must exist.
    ///
    /// # Errors
    /// Returns an error that gives the ID of the other process if the folder is locked.
    pub(super) fn take(run: &Path) -> Result<Self> {
        let path = run.join(LOCK_FILE);
        let options = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = options.map_err(Error::write(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = file.read_to_string(&mut holder);
                let found = format!("in use by process {}", holder.trim());
                return Err(Error::input(
                    run,
                    "the run",
                    found,
                    "a run that no other process trains (choose another --out)",
                ));
            }
            Err(TryLockError::Error(e)) => return Err(Error::write(&path)(e)),
        }
        let written = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
        written.map_err(Error::write(&path))?;
        Ok(RunLock { _file: file })
    }
}
