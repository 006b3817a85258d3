//! Files and folders that appear whole or not at all. Nothing is removed but what the program made: its temporary files and
//! folders bear its name, and of a folder that is replaced only the files go that it is known to make.

use crate::error::{Error, Result};
use serde::Serialize;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// What is being written.
const PARTIAL: &str = "globalsplat-partial";
/// What has been moved away to make room.
const OLD: &str = "globalsplat-old";

/// Writes `path` by way of a temporary file beside it: a reader sees the older file or the new one, never a part, and a
/// full disk leaves the older one as it was.
///
/// # Errors
/// What `fill` returns, or the system's refusal to write.
pub fn write_atomically(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let temporary = sibling(path, PARTIAL);
    let attempt = || {
        let file = File::create(&temporary).map_err(Error::write(path))?;
        let mut writer = BufWriter::new(file);
        fill(&mut writer)?;
        let file = writer.into_inner().map_err(|e| Error::write(path)(e.into_error()))?;
        file.sync_all().map_err(Error::write(path))?;
        fs::rename(&temporary, path).map_err(Error::write(path))
    };
    let result = attempt();
    if result.is_err() {
        let _ = fs::remove_file(&temporary);
        return result;
    }
    sync_parent(path);
    Ok(())
}

/// Writes `value`, which is made of numbers, texts, lists and maps by names, as JSON that a person can read, whole or not at all.
///
/// # Errors
/// The system's refusal to write.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let json = serde_json::to_vec_pretty(value).expect("numbers and texts");
    write_atomically(path, |writer| writer.write_all(&json).map_err(Error::write(path)))
}

/// Puts the folder that `fill` makes at `path`, whole: it is filled under another name and then renamed. `made` are the names
/// that such a folder has; whatever else is in one that was there before is there afterwards.
///
/// # Errors
/// What `fill` returns, or the system's refusal to write.
pub fn replace_dir(path: &Path, made: &[&str], fill: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let (temporary, retired) = (sibling(path, PARTIAL), sibling(path, OLD));
    let attempt = || {
        remove_dir_if_there(&temporary)?;
        fs::create_dir_all(&temporary).map_err(Error::write(&temporary))?;
        fill(&temporary)?;
        sync_dir(&temporary);
        if retired.is_dir() && !path.exists() {
            fs::rename(&retired, path).map_err(Error::write(path))?;
        }
        retire(&retired, path, made)?;
        if path.exists() {
            fs::rename(path, &retired).map_err(Error::write(path))?;
        }
        fs::rename(&temporary, path).map_err(Error::write(path))?;
        retire(&retired, path, made)
    };
    let result = attempt();
    if result.is_err() {
        let _ = fs::remove_dir_all(&temporary);
        if !path.exists() {
            let _ = fs::rename(&retired, path);
        }
        return result;
    }
    sync_parent(path);
    Ok(())
}

/// Removes the folder `retired`, of whose files `made` are the program's, once the others are in the folder `heir`.
fn retire(retired: &Path, heir: &Path, made: &[&str]) -> Result<()> {
    if !retired.is_dir() {
        return Ok(());
    }
    if heir.is_dir() {
        for entry in fs::read_dir(retired).map_err(Error::read(retired))? {
            let name = entry.map_err(Error::read(retired))?.file_name();
            let to = heir.join(&name);
            if !made.iter().any(|made| name == *made) && !to.exists() {
                fs::rename(retired.join(&name), &to).map_err(Error::write(&to))?;
            }
        }
    }
    remove_made(retired, made)
}

/// Removes the folder at `path`, of whose files `made` are the program's, as one: where it can't be removed, it is all there or
/// under the name of what is half written. What else is in it stays, in a folder of its name.
///
/// # Errors
/// The system's refusal to read or write.
pub fn remove_dir(path: &Path, made: &[&str]) -> Result<()> {
    for entry in fs::read_dir(path).map_err(Error::read(path))? {
        let name = entry.map_err(Error::read(path))?.file_name();
        if !made.iter().any(|made| name == *made) {
            return remove_made(path, made);
        }
    }
    let temporary = sibling(path, PARTIAL);
    remove_dir_if_there(&temporary)?;
    fs::rename(path, &temporary).map_err(Error::write(path))?;
    remove_dir_if_there(&temporary)
}

/// Removes `made` from `folder`, and the folder itself, if nothing else is in it.
fn remove_made(folder: &Path, made: &[&str]) -> Result<()> {
    for name in made {
        let path = folder.join(name);
        let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        unless_missing(removed).map_err(Error::write(&path))?;
    }
    match fs::remove_dir(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::DirectoryNotEmpty => Ok(()),
        removed => unless_missing(removed).map_err(Error::write(folder)),
    }
}

/// Puts right what [`replace_dir`] left in `folder` when its process was ended: folders that it had moved away come back where
/// nothing has taken their place, and those half filled go. Nothing is done where there is no such folder.
///
/// # Errors
/// The system's refusal to read, rename or remove.
pub fn recover_dirs(folder: &Path, made: &[&str]) -> Result<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(folder).map_err(Error::read(folder))? {
        let left = entry.map_err(Error::read(folder))?.path();
        let name = left.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        if !left.is_dir() {
            continue;
        }
        let of = |suffix: &str| {
            let name = name.strip_prefix('.')?.strip_suffix(suffix)?.strip_suffix('.')?;
            Some(folder.join(name))
        };
        match of(OLD) {
            Some(path) if !path.exists() => fs::rename(&left, &path).map_err(Error::write(&path))?,
            Some(path) => retire(&left, &path, made)?,
            None if of(PARTIAL).is_some() => remove_dir_if_there(&left)?,
            None => {}
        }
    }
    Ok(())
}

/// A file that another hand fills, or by and by: at `place` until it is kept, and gone unless it is.
#[derive(Debug)]
pub struct PartialFile {
    path: PathBuf,
    /// Where it is filled.
    pub place: PathBuf,
    kept: bool,
}

impl PartialFile {
    /// What is to become the file at `path`. Nothing is there yet.
    pub fn of(path: &Path) -> Self {
        PartialFile { path: path.to_owned(), place: sibling(path, PARTIAL), kept: false }
    }

    /// Gives it its name.
    ///
    /// # Errors
    /// The system's refusal to write.
    pub fn keep(mut self) -> Result<()> {
        let whole = File::open(&self.place).and_then(|file| file.sync_all());
        whole.and_then(|()| fs::rename(&self.place, &self.path)).map_err(Error::write(&self.path))?;
        self.kept = true;
        sync_parent(&self.path);
        Ok(())
    }
}

impl Drop for PartialFile {
    fn drop(&mut self) {
        if !self.kept {
            let _ = fs::remove_file(&self.place);
        }
    }
}

/// Whether a file could be written at `path`; its folder is made if need be. Call it before the work, not after.
///
/// # Errors
/// A request error that names the path.
pub fn check_writable_file(path: &Path) -> Result<()> {
    if path.is_dir() {
        return Err(Error::input(path, "the output", "a folder", "the name of a file"));
    }
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    probe(parent, path)
}

/// Whether files could be written under the folder `path`, which is made if need be.
///
/// # Errors
/// A request error that names the path.
pub fn check_writable_dir(path: &Path) -> Result<()> {
    if path.is_file() {
        return Err(Error::input(path, "the output", "a file", "the name of a folder"));
    }
    probe(path, path)
}

fn probe(dir: &Path, named: &Path) -> Result<()> {
    let refused = |e: std::io::Error| match Error::write(named)(e) {
        // There may be room later: that is no wrong request.
        full if full.is_disk_full() => full,
        other => Error::Request(other.to_string()),
    };
    fs::create_dir_all(dir).map_err(refused)?;
    // What a process that was ended left of it, the next one removes.
    let file = dir.join(".globalsplat-probe");
    File::create(&file).map_err(refused)?;
    unless_missing(fs::remove_file(&file)).map_err(refused)
}

/// `.name.suffix` beside `path`.
fn sibling(path: &Path, suffix: &str) -> PathBuf {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_file_name(format!(".{name}.{suffix}"))
}

fn remove_dir_if_there(path: &Path) -> Result<()> {
    unless_missing(fs::remove_dir_all(path)).map_err(Error::write(path))
}

/// What isn't there needs no removing.
fn unless_missing(removed: std::io::Result<()>) -> std::io::Result<()> {
    match removed {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e),
        _ => Ok(()),
    }
}

/// A rename is only safe from a power cut once its folder is on the disk. Not every file system can; then it is best effort.
fn sync_parent(path: &Path) {
    sync_dir(path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")));
}

fn sync_dir(path: &Path) {
    if let Ok(dir) = File::open(path) {
        let _ = dir.sync_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_goes_as_one_and_foreign_files_stay() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("step");
        let make = |names: &[&str]| {
            fs::create_dir_all(&folder).unwrap();
            names.iter().for_each(|name| fs::write(folder.join(name), name).unwrap());
        };
        make(&["model", "state"]);
        // Of one that was removed by half before, nothing hinders.
        fs::create_dir_all(sibling(&folder, PARTIAL).join("model")).unwrap();
        remove_dir(&folder, &["model", "state"]).unwrap();
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 0);

        make(&["model", "state", "notes"]);
        remove_dir(&folder, &["model", "state"]).unwrap();
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        assert_eq!(fs::read(folder.join("notes")).unwrap(), b"notes");
    }
}
