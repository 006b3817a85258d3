//! Atomic writes: files and folders appear complete or not at all. Only what the program created is removed: temporary files and folders
//! that bear its name, and, from a folder that is replaced, the files that the program is known to create.
//!
//! A temporary file or folder lies beside its final path, as `.NAME.globalsplat-partial`, with `-1`, `-2`, … appended if other processes
//! write to the same path. Its process holds a lock on it. A temporary file without a lock was left by a process that was killed: the next
//! process that writes to the same path removes it.

use crate::{Error, Result};
use serde::Serialize;
use std::fs::{self, File, FileType, Metadata, OpenOptions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use tempfile::{NamedTempFile, TempPath};

/// Suffix of files and folders that are being written.
const PARTIAL: &str = "globalsplat-partial";
/// Suffix of folders that were moved out of the way.
const OLD: &str = "globalsplat-old";
/// Maximum length in bytes of the part of a temporary name that is taken from the final one, which may be as long as the file system
/// allows.
const NAME_BYTES: usize = 48;

/// Writes `path` through a temporary file beside it: readers see the old file or the new one, never a part, and a full disk leaves the old
/// one unchanged. Links are followed, and the new file has the permissions of the old one.
///
/// # Errors
/// Returns the error of `fill`, or an error if something other than a regular file is at `path` or the file can't be written.
pub fn write_atomically<E: From<Error>>(
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> Result<(), E>,
) -> Result<(), E> {
    Ok(write_temporary(path, fill)?.persist()?)
}

/// Writes a file like [`write_atomically`], but leaves it under its temporary name until [`PartialFile::persist`] is called.
///
/// # Errors
/// Returns the errors of [`write_atomically`].
pub fn write_temporary<E: From<Error>>(
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> Result<(), E>,
) -> Result<PartialFile, E> {
    let partial = PartialFile::create(path)?;
    let mut writer = BufWriter::new(partial.temporary.as_file());
    fill(&mut writer)?;
    writer.into_inner().map_err(|e| Error::write(path)(e.into_error()))?;
    Ok(partial)
}

/// Writes `files`, which are paths and contents, like [`write_atomically`]. No file is replaced before all of them are written.
///
/// # Errors
/// Returns the errors of [`write_atomically`].
pub fn write_files<'a>(files: impl IntoIterator<Item = (impl AsRef<Path>, &'a [u8])>) -> Result<()> {
    let mut partials = vec![];
    for (path, contents) in files {
        let path = path.as_ref();
        partials
            .push(write_temporary(path, |writer| writer.write_all(contents).map_err(Error::write(path)))?);
    }
    partials.into_iter().try_for_each(PartialFile::persist)
}

/// Writes `value`, which consists of numbers, strings, lists and maps with string keys, as pretty-printed JSON, atomically.
///
/// # Errors
/// Returns an error if the file can't be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let json = serde_json::to_vec_pretty(value).expect("numbers and texts");
    write_files([(path, &json[..])])
}

/// Replaces the folder at `path` by one that `fill` creates: it is filled under a temporary name and then renamed. `own_entries` lists the
/// names of the entries that such a folder has; all other entries of the old folder are kept in the new one. No other process may write to the
/// folder meanwhile.
///
/// # Errors
/// Returns the error of `fill`, or an error if something other than a folder is at `path` or the folder can't be written.
pub fn replace_dir<E: From<Error>>(
    path: &Path,
    own_entries: &[&str],
    fill: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), E> {
    let target = target_of(path, Metadata::is_dir, "the name of a folder")?;
    fs::create_dir_all(parent_of(&target)).map_err(Error::write(path))?;
    let (temporary, retired) = (temporary_path(&target, 0), old_name(&target));
    unless_missing(fs::remove_dir_all(&temporary)).map_err(Error::write(path))?;
    fs::create_dir(&temporary).map_err(Error::write(path))?;
    let swap = || {
        recover_dir(&retired, &target, own_entries)?;
        if target.exists() {
            fs::rename(&target, &retired).map_err(Error::write(path))?;
        }
        fs::rename(&temporary, &target).map_err(Error::write(path))?;
        recover_dir(&retired, &target, own_entries)
    };
    let filled = fill(&temporary);
    sync_dir(&temporary);
    let result = filled.and_then(|()| Ok(swap()?));
    if result.is_err() {
        let _ = fs::remove_dir_all(&temporary);
        if !target.exists() {
            let _ = fs::rename(&retired, &target);
        }
        return result;
    }
    sync_dir(parent_of(&target));
    Ok(())
}

/// Moves the folder `retired` back to `path`, from which it was moved away. If another folder has taken this path, the entries `own_entries`,
/// which belong to the program, are removed from `retired` instead, and its other entries are moved to the other folder. No-op if `retired`
/// doesn't exist.
fn recover_dir(retired: &Path, path: &Path, own_entries: &[&str]) -> Result<()> {
    if !retired.is_dir() {
        return Ok(());
    }
    if !path.exists() {
        return fs::rename(retired, path).map_err(Error::write(path));
    }
    for entry in fs::read_dir(retired).map_err(Error::read(retired))? {
        let name = entry.map_err(Error::read(retired))?.file_name();
        let to = path.join(&name);
        if !own_entries.iter().any(|own| name == *own) && !to.exists() {
            fs::rename(retired.join(&name), &to).map_err(Error::write(&to))?;
        }
    }
    remove_own_entries(retired, own_entries)
}

/// Removes the folder at `path`, whose entries `own_entries` belong to the program, in one step: if the removal fails, the folder is either
/// complete or under the name of a partial one. If it has other entries, they stay in the folder under its name.
///
/// # Errors
/// Returns an error if the folder can't be read or removed.
pub fn remove_dir(path: &Path, own_entries: &[&str]) -> Result<()> {
    for entry in fs::read_dir(path).map_err(Error::read(path))? {
        let name = entry.map_err(Error::read(path))?.file_name();
        if !own_entries.iter().any(|own| name == *own) {
            return remove_own_entries(path, own_entries);
        }
    }
    let temporary = temporary_path(path, 0);
    unless_missing(fs::remove_dir_all(&temporary)).map_err(Error::write(&temporary))?;
    fs::rename(path, &temporary).map_err(Error::write(path))?;
    fs::remove_dir_all(&temporary).map_err(Error::write(&temporary))
}

/// Removes `own_entries` from `folder`, and the folder itself if it has no other entries.
fn remove_own_entries(folder: &Path, own_entries: &[&str]) -> Result<()> {
    for name in own_entries {
        let path = folder.join(name);
        let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        unless_missing(removed).map_err(Error::write(&path))?;
    }
    match fs::remove_dir(folder) {
        Err(e) if e.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
        removed => unless_missing(removed).map_err(Error::write(folder)),
    }
}

/// Repairs what [`replace_dir`] and [`remove_dir`] left in `folder` when their process was killed: folders that were moved away are
/// restored unless another one has taken their path, and partially filled or removed folders are deleted. No-op if `folder` doesn't exist.
///
/// # Errors
/// Returns an error if an entry can't be read, renamed or removed.
pub fn recover_dirs(folder: &Path, own_entries: &[&str]) -> Result<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(folder).map_err(Error::read(folder))? {
        let left = entry.map_err(Error::read(folder))?.path();
        let name = left.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(name) = name.strip_prefix('.').filter(|_| left.is_dir()) else { continue };
        if let Some(name) = name.strip_suffix(&format!(".{OLD}")) {
            recover_dir(&left, &folder.join(name), own_entries)?;
        } else if name.contains(&format!(".{PARTIAL}")) {
            fs::remove_dir_all(&left).map_err(Error::write(&left))?;
        }
    }
    Ok(())
}

/// A file that is written beside its final path, and removed on drop unless it is persisted.
#[derive(Debug)]
pub struct PartialFile {
    /// Path in error messages.
    path: PathBuf,
    /// Final path: `path` with links followed.
    target: PathBuf,
    /// Open file, initially empty, at a temporary path that only this process uses.
    pub temporary: NamedTempFile,
}

impl PartialFile {
    /// Creates the temporary file for the file at `path`. If it replaces a file, it has the permissions of that file, and its owner may
    /// write it.
    ///
    /// # Errors
    /// Returns an error if something other than a regular file is at `path`, or if the file can't be written.
    pub fn create(path: &Path) -> Result<Self> {
        let target = target_of(path, Metadata::is_file, "the name of a file")?;
        let temporary = claim(&target).map_err(Error::write(path))?;
        if let Ok(replaced) = fs::metadata(&target) {
            // Best effort: some file systems have no permissions.
            let _ = temporary.as_file().set_permissions(writable_by_owner(replaced.permissions()));
        }
        Ok(PartialFile { path: path.to_owned(), target, temporary })
    }

    /// Renames the file to its final path.
    ///
    /// # Errors
    /// Returns an error if the file can't be written.
    pub fn persist(self) -> Result<()> {
        let PartialFile { path, target, temporary } = self;
        temporary.as_file().sync_all().map_err(Error::write(&path))?;
        temporary.persist(&target).map_err(|e| Error::write(&path)(e.error))?;
        sync_dir(parent_of(&target));
        Ok(())
    }
}

/// Checks that a file could be written at `path`, and creates its folder if necessary. Call it before the work starts.
///
/// # Errors
/// Returns a request error that names the path if something other than a regular file is there, or if the file can't be written.
pub fn check_writable_file(path: &Path) -> Result<()> {
    let parent = match target_of(path, Metadata::is_file, "the name of a file") {
        Ok(target) => parent_of(&target).to_owned(),
        Err(e) => return Err(refused(e)),
    };
    fs::create_dir_all(parent).map_err(Error::write(path)).map_err(refused)?;
    probe(path, path)
}

/// Checks that files could be written in the folder `path`, and creates it if necessary.
///
/// # Errors
/// Returns a request error that names the path if something other than a folder is there, or if the folder can't be written.
pub fn check_writable_dir(path: &Path) -> Result<()> {
    let folder = target_of(path, Metadata::is_dir, "the name of a folder").map_err(refused)?;
    fs::create_dir_all(&folder).map_err(Error::write(path)).map_err(refused)?;
    probe(&folder.join("globalsplat-probe"), path)
}

/// Creates a file beside `file` and removes it again; errors name the path `named`.
fn probe(file: &Path, named: &Path) -> Result<()> {
    let named_so = |e: Error| match e {
        Error::Write { source, .. } => Error::write(named)(source),
        other => other,
    };
    let removed = PartialFile::create(file).map_err(named_so).map(|partial| partial.temporary.close());
    removed.and_then(|removed| unless_missing(removed).map_err(Error::write(named))).map_err(refused)
}

/// Converts a write error into a request error, unless the disk is full.
fn refused(e: Error) -> Error {
    match e {
        // Disk space may become available later.
        full if full.is_out_of_space() => full,
        Error::Write { .. } => Error::request(e.to_string()),
        other => other,
    }
}

/// Checks that `path` is a regular file or doesn't exist.
///
/// # Errors
/// Returns a request error that names the path.
pub fn check_regular(path: &Path) -> Result<()> {
    target_of(path, Metadata::is_file, "the name of a file").map(drop).map_err(refused)
}

/// Returns the path that a write to `path` changes: links are followed, even if their target doesn't exist yet.
///
/// # Errors
/// Returns an error if `is_expected` returns `false` for what is at `path`, for example for a device.
fn target_of(path: &Path, is_expected: fn(&Metadata) -> bool, expected: &str) -> Result<PathBuf> {
    let refuse = |found: &str| Err(Error::input(path, "the output", found, expected));
    match fs::metadata(path) {
        Ok(there) if is_expected(&there) => {}
        Ok(there) => return refuse(kind_name(there.file_type())),
        Err(e) if e.kind() == ErrorKind::NotFound => {}
        Err(e) => return Err(Error::write(path)(e)),
    }
    let mut target = path.to_owned();
    while let Ok(link) = fs::read_link(&target) {
        // /dev/stdout and /dev/fd/1 are such links.
        if parent_of(&target).canonicalize().is_ok_and(|folder| folder.starts_with("/proc")) {
            return refuse("an open file of a process");
        }
        target = parent_of(&target).join(link);
    }
    Ok(target)
}

fn kind_name(kind: FileType) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    match kind {
        _ if kind.is_fifo() => "a FIFO",
        _ if kind.is_socket() => "a socket",
        _ if kind.is_block_device() || kind.is_char_device() => "a device",
        _ if kind.is_dir() => "a folder",
        _ => "a file",
    }
}

fn writable_by_owner(mut permissions: fs::Permissions) -> fs::Permissions {
    use std::os::unix::fs::PermissionsExt;
    permissions.set_mode(permissions.mode() & 0o777 | 0o200);
    permissions
}

/// Creates a temporary file beside `target` for this process alone. It stays locked until the returned file is closed. Files that killed
/// processes left at the temporary paths are removed.
fn claim(target: &Path) -> io::Result<NamedTempFile> {
    let remove_abandoned = |number| remove_abandoned(&temporary_path(target, number)).unwrap_or(false);
    let mut number = 0;
    loop {
        let place = temporary_path(target, number);
        match OpenOptions::new().write(true).create_new(true).open(&place) {
            Ok(file) => {
                // On file systems without locks, no process takes it for abandoned, and abandoned files stay.
                let _ = file.lock();
                // Another process may have found it before it was locked, and removed it.
                if is_at(&file, &place) {
                    (number + 1..).take_while(|later| remove_abandoned(*later)).for_each(drop);
                    return Ok(NamedTempFile::from_parts(file, TempPath::try_from_path(place)?));
                }
            }
            Err(e) if e.kind() == ErrorKind::AlreadyExists => number += u32::from(!remove_abandoned(number)),
            Err(e) => return Err(e),
        }
    }
}

/// Returns a temporary path for `target`, one for each `number`.
fn temporary_path(target: &Path, number: u32) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    let ends = 0..=name.len().min(NAME_BYTES);
    let end = ends.rev().find(|&end| name.is_char_boundary(end)).unwrap_or(0);
    let ending = if number == 0 { String::new() } else { format!("-{number}") };
    target.with_file_name(format!(".{}.{PARTIAL}{ending}", &name[..end]))
}

/// Removes the temporary file at `place` unless a process uses it. Returns `true` if it was removed.
fn remove_abandoned(place: &Path) -> io::Result<bool> {
    if !place.symlink_metadata()?.is_file() {
        return Ok(false);
    }
    let file = File::open(place)?;
    if file.try_lock().is_err() || !is_at(&file, place) {
        return Ok(false);
    }
    unless_missing(fs::remove_file(place))?;
    Ok(true)
}

/// Returns `true` if `file` is the file at `place`.
fn is_at(file: &File, place: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |metadata: Metadata| (metadata.dev(), metadata.ino());
    let there = place.symlink_metadata().map(id);
    file.metadata().map(id).is_ok_and(|own| there.is_ok_and(|there| there == own))
}

/// Returns the path to which the folder at `path` is moved while it is replaced.
fn old_name(path: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{OLD}"));
    path.with_file_name(name)
}

/// Ignores the error that there was nothing to remove.
fn unless_missing(removed: io::Result<()>) -> io::Result<()> {
    match removed {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(e),
        _ => Ok(()),
    }
}

/// Returns the folder of `path`; for a bare file name, `.`.
pub fn parent_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Syncs the entries of a folder to the disk, without which a rename may be lost in a power cut. Best effort: not every file system
/// supports it.
fn sync_dir(path: &Path) {
    if let Ok(dir) = File::open(path) {
        let _ = dir.sync_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn write(path: &Path, text: &str) -> Result<()> {
        write_files([(path, text.as_bytes())])
    }

    #[test]
    fn the_parent_of_a_name_alone_is_the_working_folder() {
        assert_eq!(parent_of(Path::new("cameras.json")), Path::new("."));
        assert_eq!(parent_of(Path::new("room/cameras.json")), Path::new("room"));
        assert_eq!(parent_of(Path::new("/cameras.json")), Path::new("/"));
    }

    #[test]
    fn a_folder_goes_as_one_and_foreign_files_stay() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("step");
        // A partial removal from before must not get in the way.
        fs::create_dir_all(root.path().join(".step.globalsplat-partial/model")).unwrap();
        for (entries, left) in [(&["model", "state"][..], &[][..]), (&["model", "notes", "state"], &["step"])]
        {
            fs::create_dir_all(&folder).unwrap();
            entries.iter().for_each(|name| fs::write(folder.join(name), name).unwrap());
            remove_dir(&folder, &["model", "state"]).unwrap();
            assert_eq!(names(root.path()), left);
        }
        assert_eq!(names(&folder), ["notes"]);
    }

    #[test]
    fn writers_of_one_file_have_names_of_their_own() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("room.ply");
        let partial = [".room.ply.globalsplat-partial", ".room.ply.globalsplat-partial-1"];
        // Left by processes that were killed.
        partial.iter().for_each(|left| fs::write(root.path().join(left), "left").unwrap());
        let first = PartialFile::create(&file).unwrap();
        assert_eq!(names(root.path()), partial[..1]);
        let second = PartialFile::create(&file).unwrap();
        assert_eq!(names(root.path()), partial);
        for (writer, text) in [(second, b"second".as_slice()), (first, b"first")] {
            writer.temporary.as_file().write_all(text).unwrap();
            writer.persist().unwrap();
            assert_eq!(fs::read(&file).unwrap(), text);
        }
        drop(PartialFile::create(&file).unwrap());
        assert_eq!(names(root.path()), ["room.ply"]);
    }

    #[test]
    fn names_may_be_as_long_as_the_file_system_allows() {
        let root = tempfile::tempdir().unwrap();
        for name in ["x".repeat(255), "é".repeat(127)] {
            let file = root.path().join(&name);
            check_writable_file(&file).unwrap();
            write(&file, "text").unwrap();
            assert_eq!(names(root.path()), [name]);
            fs::remove_file(file).unwrap();
        }
        assert!(check_writable_file(&root.path().join("x".repeat(256))).unwrap_err().is_invalid_request());
    }

    #[test]
    fn links_are_followed_and_anything_else_is_refused() {
        use std::os::unix::fs::symlink;
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        fs::create_dir(at("below")).unwrap();
        fs::write(at("below/file"), "old").unwrap();
        for (target, link) in [
            ("file", "below/link"),
            ("below/link", "twice"),
            ("below/new", "dangling"),
            ("fifo", "to_fifo"),
            ("loop", "loop"),
        ] {
            symlink(target, at(link)).unwrap();
        }
        for (link, target) in [("twice", "below/file"), ("dangling", "below/new")] {
            check_writable_file(&at(link)).unwrap();
            write(&at(link), "new").unwrap();
            assert!(at(link).is_symlink(), "{link}");
            assert_eq!(fs::read(at(target)).unwrap(), b"new");
        }
        assert!(at("below/link").is_symlink());
        assert_eq!(names(&at("below")), ["file", "link", "new"]);

        let fifo = std::ffi::CString::new(at("fifo").to_str().unwrap()).unwrap();
        assert_eq!(unsafe { libc::mkfifo(fifo.as_ptr(), 0o600) }, 0);
        let _listener = std::os::unix::net::UnixListener::bind(at("socket")).unwrap();
        for (path, found) in [
            (at("fifo"), "a FIFO"),
            (at("to_fifo"), "a FIFO"),
            (at("socket"), "a socket"),
            (at("below"), "a folder"),
            ("/dev/null".into(), "a device"),
            ("/proc/self/exe".into(), "an open file of a process"),
            (at("loop"), "can't be written"),
        ] {
            for error in [check_writable_file(&path).unwrap_err(), write(&path, "new").unwrap_err()] {
                assert!(error.to_string().contains(found), "{error}");
            }
            assert!(check_writable_file(&path).unwrap_err().is_invalid_request());
        }
        for file in ["fifo", "below/file"] {
            assert!(check_writable_dir(&at(file)).unwrap_err().to_string().contains("the name of a folder"));
        }
        assert_eq!(names(root.path()), ["below", "dangling", "fifo", "loop", "socket", "to_fifo", "twice"]);
    }

    #[test]
    fn permissions_are_preserved() {
        use std::os::unix::fs::PermissionsExt;
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("private");
        for (before, after) in [(0o600, 0o600), (0o400, 0o600), (0o664, 0o664)] {
            fs::write(&file, "old").unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(before)).unwrap();
            write(&file, "new").unwrap();
            assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, after);
            fs::remove_file(&file).unwrap();
        }
    }
}
