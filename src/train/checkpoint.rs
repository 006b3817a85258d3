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
    FolderLock, InputFiles, WeightsFile, checksum, parent_of, read_weights, replace_link, sync_dir,
    write_json, write_weights,
};
use crate::model::Precision;
use crate::reconstruct::save_model;
use serde::{Deserialize, Serialize};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

const FOLDER: &str = "checkpoints";
const BEST: &str = "best";
const PREFIX: &str = "step-";
/// Name of the file in a checkpoint's folder that has the weights.
pub const MODEL_FILE: &str = "model.safetensors";
const OPTIMIZER_FILE: &str = "optimizer.safetensors";
const STATE_FILE: &str = "state.json";
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
    inputs.add_folder(&run.join(FOLDER));
}

/// Removes what a run left that was killed during a save.
///
/// # Errors
/// Returns an error if a file can't be removed, or if something other than a link is where the best checkpoint's has to be.
pub(super) fn remove_incomplete(run: &Path) -> Result<()> {
    let best = run.join(BEST);
    if best.exists() && !best.is_symlink() {
        let expected = "a link that training makes: move it away";
        return Err(Error::input(best, "the best checkpoint", "a file or folder", expected));
    }
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

    /// Saves a checkpoint under `run`, unless the run has that of this step, and returns its folder. Removes the oldest checkpoints beyond
    /// those to keep.
    ///
    /// # Errors
    /// Returns an error if files can't be written. Older checkpoints then stay complete.
    pub(super) fn save(&self, run: &Path) -> Result<PathBuf> {
        let path = self.checkpoint(run);
        if check(&path).is_ok_and(|state| (state.step, state.samples) == (self.step, self.samples)) {
            return Ok(path);
        }
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
        sync_dir(parent_of(folder));
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

/// Removes the oldest checkpoints beyond the `kept` newest ones up to `latest`, but never the best one. Later ones are damaged, and replaced
/// when the run has come so far.
pub(super) fn prune_checkpoints(run: &Path, latest: &Path, kept: usize) -> Result<()> {
    let best = fs::read_link(run.join(BEST)).map(|target| run.join(target)).ok();
    let mut others = list_checkpoints(run)?;
    others.retain(|other| other.as_path() < latest && best.as_ref() != Some(other));
    let surplus = (others.len() + 1).saturating_sub(kept);
    others[..surplus].iter().try_for_each(|old| remove(old))
}

/// Removes a checkpoint's files, also those that a killed process left under their temporary names, and its folder unless it has other files.
/// The state goes first: after an error, the checkpoint is complete or none.
fn remove(folder: &Path) -> Result<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    let names = fs::read_dir(folder).map_err(Error::read(folder))?.flatten();
    let names: Vec<String> = names.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    for own in FILES {
        let is_own = |name: &&String| *name == own || name.starts_with(&format!(".{own}."));
        for name in names.iter().filter(is_own) {
            fs::remove_file(folder.join(name)).map_err(Error::write(folder))?;
        }
    }
    match fs::remove_dir(folder) {
        Err(e) if e.kind() != ErrorKind::DirectoryNotEmpty => Err(Error::write(folder)(e)),
        _ => Ok(()),
    }
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

/// Locks the folder of a run, which must exist: two training processes would overwrite each other's checkpoints.
///
/// # Errors
/// Returns an error that gives the ID of the other process if the folder is locked.
pub(super) fn lock(run: &Path) -> Result<FolderLock> {
    FolderLock::try_take(run)?.map_err(|holder| {
        let expected = "a run that no other process trains (choose another --out)";
        Error::input(run, "the run", format!("in use by process {holder}"), expected)
    })
}
