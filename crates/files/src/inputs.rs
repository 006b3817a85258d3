//! Files that a command reads, which its outputs must not replace.

use crate::atomic::parent_of;
use crate::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Files that a command reads. Files are compared by identity (device and inode), so other paths and
/// links to an input are recognized.
#[derive(Debug, Clone, Default)]
pub struct InputFiles {
    files: BTreeMap<FileId, InputKind>,
    /// Folders that contain photos.
    photo_folders: BTreeSet<FileId>,
}

#[derive(Debug, Clone, Copy)]
enum InputKind {
    Photo,
    Other,
}

/// Device and inode of a file or folder.
type FileId = (u64, u64);

impl InputFiles {
    /// Adds `file`, if it exists.
    pub fn add(&mut self, file: &Path) {
        self.files.extend(file_id(file).map(|id| (id, InputKind::Other)));
    }

    /// Adds those of `files` that exist.
    pub fn add_all(&mut self, files: impl IntoIterator<Item = impl AsRef<Path>>) {
        files.into_iter().for_each(|file| self.add(file.as_ref()));
    }

    /// Adds every file in `folder` and in its subfolders. Links to files and folders are followed; each folder is read once.
    pub fn add_folder(&mut self, folder: &Path) {
        let (mut pending, mut visited) = (vec![folder.to_owned()], BTreeSet::new());
        while let Some(folder) = pending.pop() {
            if !file_id(&folder).is_some_and(|id| visited.insert(id)) {
                continue;
            }
            for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
                let path = entry.path();
                match path.is_dir() {
                    true => pending.push(path),
                    false => self.add(&path),
                }
            }
        }
    }

    /// Adds the photo `file`, if it exists, and its folder as a folder of photos.
    pub fn add_photo(&mut self, file: &Path) {
        self.files.extend(file_id(file).map(|id| (id, InputKind::Photo)));
        self.photo_folders.extend(file_id(parent_of(file)));
    }

    /// Adds all files and folders of `others`.
    pub fn extend(&mut self, others: InputFiles) {
        self.files.extend(others.files);
        self.photo_folders.extend(others.photo_folders);
    }

    /// Checks that a file written at `path` would replace none of the inputs.
    ///
    /// # Errors
    /// Returns [`Error::Input`] if `path` is one of the inputs.
    pub fn check_file(&self, path: &Path) -> Result<()> {
        match file_id(path).and_then(|id| self.files.get(&id)) {
            None => Ok(()),
            Some(InputKind::Photo) => Err(Error::input(
                path,
                "the output",
                "a photo of the capture",
                "a path that isn't an input photo",
            )),
            Some(InputKind::Other) => {
                Err(Error::input(path, "the output", "a file that this command reads", "another name"))
            }
        }
    }

    /// Checks that the output folder `path` is not a folder of photos.
    ///
    /// # Errors
    /// Returns [`Error::Input`] if `path` is a folder of photos.
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

fn file_id(path: &Path) -> Option<FileId> {
    use std::os::unix::fs::MetadataExt;
    fs::metadata(path).ok().map(|file| (file.dev(), file.ino()))
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

    #[test]
    fn the_folder_of_a_photo_without_a_folder_in_its_path_is_the_current_one() {
        let mut inputs = InputFiles::default();
        inputs.add_photo(Path::new("photo.png"));
        let current = std::env::current_dir().expect("a current folder");
        assert!(
            [Path::new("."), current.as_path()].iter().all(|folder| inputs.check_folder(folder).is_err())
        );
        let other = tempfile::tempdir().expect("a temporary folder");
        inputs.check_folder(other.path()).expect("no folder of photos");
    }

    #[test]
    fn links_to_folders_are_followed_once() {
        use std::os::unix::fs::symlink;
        let root = tempfile::tempdir().expect("a temporary folder");
        let at = |name: &str| root.path().join(name);
        fs::create_dir_all(at("run/below")).expect("folders");
        fs::create_dir(at("elsewhere")).expect("a folder");
        let files = ["run/a", "run/below/b", "elsewhere/c"];
        files.iter().for_each(|name| fs::write(at(name), "").expect("a file"));
        symlink(at("elsewhere"), at("run/link")).expect("a link");
        // Links back to a folder above, and to nothing.
        symlink(at("run"), at("elsewhere/loop")).expect("a link");
        symlink(at("missing"), at("run/dangling")).expect("a link");
        let mut inputs = InputFiles::default();
        inputs.add_folder(&at("run"));
        assert!(files.iter().all(|file| inputs.check_file(&at(file)).is_err()));
        inputs.check_file(&at("missing")).expect("no input");
    }
}
