//! Files that a command reads, which its outputs must not replace, and what it takes for one file.

use crate::atomic::parent_of;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Files that a command reads, and those of its other outputs. They are compared as [`is_same_file`] does.
#[derive(Debug, Clone, Default)]
pub struct InputFiles {
    photos: BTreeSet<FileId>,
    /// Folders that contain photos.
    photo_folders: BTreeSet<FileId>,
    others: BTreeSet<FileId>,
}

impl InputFiles {
    /// Adds `file`, which need not exist yet.
    pub fn add(&mut self, file: &Path) {
        self.others.insert(FileId::of(file));
    }

    /// Adds all of `files`.
    pub fn add_all(&mut self, files: impl IntoIterator<Item = impl AsRef<Path>>) {
        files.into_iter().for_each(|file| self.add(file.as_ref()));
    }

    /// Adds every file in `folder` and in its subfolders. Links to files and folders are followed; each folder is read once.
    pub fn add_folder(&mut self, folder: &Path) {
        let (mut pending, mut visited) = (vec![folder.to_owned()], BTreeSet::new());
        while let Some(folder) = pending.pop() {
            if !visited.insert(FileId::of(&folder)) {
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

    /// Adds the photo `file`, and its folder as a folder of photos.
    pub fn add_photo(&mut self, file: &Path) {
        self.photos.insert(FileId::of(file));
        self.photo_folders.insert(FileId::of(parent_of(file)));
    }

    /// Adds all files and folders of `others`.
    pub fn extend(&mut self, others: InputFiles) {
        self.photos.extend(others.photos);
        self.others.extend(others.others);
        self.photo_folders.extend(others.photo_folders);
    }

    /// Checks that a file written at `path` would replace none of the inputs.
    ///
    /// # Errors
    /// Returns [`Error::Input`] if `path` is one of the inputs.
    pub fn check_file(&self, path: &Path) -> Result<()> {
        let id = FileId::of(path);
        let (found, expected) = match (self.photos.contains(&id), self.others.contains(&id)) {
            (true, _) => ("a photo of the capture", "a path that isn't an input photo"),
            (false, true) => ("a file that this command reads or writes", "another name"),
            (false, false) => return Ok(()),
        };
        Err(Error::input(path, "the output", found, expected))
    }

    /// Checks that the output folder `path` is not a folder of photos.
    ///
    /// # Errors
    /// Returns [`Error::Input`] if `path` is a folder of photos.
    pub fn check_folder(&self, path: &Path) -> Result<()> {
        if self.photo_folders.contains(&FileId::of(path)) {
            let (found, expected) = ("a folder with the capture's photos", "a folder without them");
            return Err(Error::input(path, "the output", found, expected));
        }
        Ok(())
    }
}

/// Returns `true` if both paths lead to one file or folder: by other names of its folders, or by symbolic links, or on Unix by hard links. A
/// file that doesn't exist yet is the one that a write would create.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    FileId::of(a) == FileId::of(b)
}

/// Returns the absolute path that `path` leads to, without links. What doesn't exist yet keeps its name.
pub fn real_path(path: &Path) -> PathBuf {
    match (path.canonicalize(), fs::read_link(path), path.file_name()) {
        (Ok(real), ..) => real,
        (Err(e), Ok(link), _) if e.kind() == ErrorKind::NotFound => real_path(&parent_of(path).join(link)),
        (_, _, Some(name)) => real_path(parent_of(path)).join(name),
        _ => path.to_owned(),
    }
}

/// Identity of the file or folder that a path leads to, by which two paths are compared.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum FileId {
    /// Device and inode of a file or folder.
    #[cfg(unix)]
    Inode(u64, u64),
    /// Path of [`real_path`].
    Path(PathBuf),
}

impl FileId {
    fn of(path: &Path) -> Self {
        #[cfg(unix)]
        if let Ok(file) = fs::metadata(path) {
            use std::os::unix::fs::MetadataExt;
            return FileId::Inode(file.dev(), file.ino());
        }
        FileId::Path(real_path(path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_recognized_by_any_path_and_links() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let at = |name: &str| folder.path().join(name);
        fs::create_dir_all(at("run/below")).expect("folders");
        fs::create_dir(at("elsewhere")).expect("a folder");
        for name in ["a.ply", "other.ply", "run/a", "run/below/b", "elsewhere/c"] {
            fs::write(at(name), "").expect("a file");
        }
        fs::hard_link(at("a.ply"), at("link.ply")).expect("a link");
        // Links to a folder, back to a folder above, and to nothing.
        #[cfg(unix)]
        for (target, link) in [
            ("elsewhere", "run/link"),
            ("run", "elsewhere/loop"),
            ("missing", "run/dangling"),
            ("run/missing.ply", "new.ply"),
            ("circle", "circle"),
        ] {
            std::os::unix::fs::symlink(at(target), at(link)).expect("a link");
        }
        let mut inputs = InputFiles::default();
        inputs.add_all([at("a.ply"), at("run/missing.ply")]);
        inputs.add_folder(&at("run"));
        inputs.add_photo(Path::new("photo.png"));
        for (name, is_input) in [
            ("./a.ply", true),
            ("link.ply", cfg!(unix)),
            ("run/a", true),
            ("run/below/b", true),
            ("elsewhere/c", cfg!(unix)),
            ("other.ply", false),
            ("run/missing.ply", true),
            ("elsewhere/loop/../run/missing.ply", cfg!(unix)),
            ("new.ply", cfg!(unix)),
            ("run/missing", false),
            ("missing", cfg!(unix)),
            ("missing.ply", false),
            ("circle", false),
            ("no/folder", false),
        ] {
            assert_eq!(inputs.check_file(&at(name)).is_err(), is_input, "{name}");
        }
        // The folder of a photo without a folder in its path is the current one.
        let current = std::env::current_dir().expect("a current folder");
        for (folder, has_photos) in [(Path::new("."), true), (&current, true), (folder.path(), false)] {
            assert_eq!(inputs.check_folder(folder).is_err(), has_photos, "{folder:?}");
        }
    }
}
