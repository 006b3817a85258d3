//! Files that a command reads, which its outputs must not replace.

use crate::{Error, Result};
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

    /// Adds those of `files` that exist.
    pub fn add_all(&mut self, files: impl IntoIterator<Item = impl AsRef<Path>>) {
        files.into_iter().for_each(|file| self.add(file.as_ref()));
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
    fn files_are_recognized_by_any_path_and_links() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let at = |name: &str| folder.path().join(name);
        ["a.ply", "b.ply", "other.ply"].iter().for_each(|name| fs::write(at(name), "").expect("a file"));
        let mut inputs = InputFiles::default();
        inputs.add_all([at("a.ply"), at("b.ply"), at("missing.ply")]);
        let roundabout = folder.path().join(".").join("b.ply");
        assert!([at("a.ply"), at("b.ply"), roundabout].iter().all(|file| inputs.check_file(file).is_err()));
        assert!(["other.ply", "missing.ply"].iter().all(|name| inputs.check_file(&at(name)).is_ok()));
        fs::hard_link(at("a.ply"), at("link.ply")).expect("a link");
        assert!(inputs.check_file(&at("link.ply")).is_err());
    }
}
