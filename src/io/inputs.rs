//! Files that a command reads, which its outputs must not replace.

use super::splat::origin_file;
use super::weights_file::weights_files;
use crate::error::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Files that a command reads. They are identified by the file itself, not by its name: an output is refused whatever path or link it uses
/// to name one of them.
#[derive(Debug, Clone, Default)]
pub struct InputFiles {
    files: BTreeMap<FileId, Kind>,
    /// Folders that contain photos.
    photo_folders: BTreeSet<FileId>,
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Photo,
    Other,
}

/// Identifier of a file or folder: device and inode on Unix, the canonical path elsewhere.
#[cfg(unix)]
type FileId = (u64, u64);
#[cfg(not(unix))]
type FileId = std::path::PathBuf;

impl InputFiles {
    /// Adds `file`, if it exists.
    pub fn add(&mut self, file: &Path) {
        self.files.extend(file_id(file).map(|id| (id, Kind::Other)));
    }

    /// Adds the files that hold the weights at `path`: one file, or an index and the files that it names.
    pub fn add_weights(&mut self, path: &Path) {
        weights_files(path).iter().for_each(|file| self.add(file));
    }

    /// Adds the splat `file` and its origin file.
    pub fn add_splat(&mut self, file: &Path) {
        self.add(file);
        self.add(&origin_file(file));
    }

    /// Adds every file in `folder` and in its subfolders.
    pub fn add_folder(&mut self, folder: &Path) {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            match entry.file_type() {
                Ok(kind) if kind.is_dir() => self.add_folder(&entry.path()),
                _ => self.add(&entry.path()),
            }
        }
    }

    /// Adds the photo `file`, if it exists, and its folder as a folder of photos.
    pub fn add_photo(&mut self, file: &Path) {
        self.files.extend(file_id(file).map(|id| (id, Kind::Photo)));
        let folder = file.parent().unwrap_or(file);
        self.photo_folders.extend(file_id(folder));
    }

    /// Adds all files and folders of `others`.
    pub fn extend(&mut self, others: InputFiles) {
        self.files.extend(others.files);
        self.photo_folders.extend(others.photo_folders);
    }

    /// Checks that a file written at `path` would replace none of the inputs.
    ///
    /// # Errors
    /// Returns a request error that names the path.
    pub fn check_file(&self, path: &Path) -> Result<()> {
        match file_id(path).and_then(|id| self.files.get(&id)) {
            None => Ok(()),
            Some(Kind::Photo) => {
                Err(Error::input(path, "the output", "a photo of the capture", "another name: photos stay"))
            }
            Some(Kind::Other) => {
                Err(Error::input(path, "the output", "a file that this command reads", "another name"))
            }
        }
    }

    /// Checks that the output folder `path` is not a folder of photos.
    ///
    /// # Errors
    /// Returns a request error that names the path.
    pub fn check_folder(&self, path: &Path) -> Result<()> {
        match file_id(path).is_some_and(|id| self.photo_folders.contains(&id)) {
            false => Ok(()),
            true => Err(Error::input(
                path,
                "the output",
                "a folder with the capture's photos",
                "a folder without them",
            )),
        }
    }
}

#[cfg(unix)]
fn file_id(path: &Path) -> Option<FileId> {
    use std::os::unix::fs::MetadataExt;
    fs::metadata(path).ok().map(|file| (file.dev(), file.ino()))
}

#[cfg(not(unix))]
fn file_id(path: &Path) -> Option<FileId> {
    path.canonicalize().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_splat_is_its_file_and_its_origins() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let splat = folder.path().join("room.ply");
        let origin = origin_file(&splat);
        [&splat, &origin].iter().for_each(|file| fs::write(file, "").expect("a file"));
        let mut inputs = InputFiles::default();
        inputs.add_splat(&splat);
        assert!(inputs.check_file(&splat).is_err() && inputs.check_file(&origin).is_err());
        assert!(inputs.check_file(&folder.path().join("other.ply")).is_ok());
    }
}
