//! Atomic writes: files appear complete or not at all. A temporary file lies beside its final path, as `.NAME.globalsplat-partial`, with `-1`,
//! `-2`, … appended if there is such a file: another process may be writing it, or a process that was killed left it.

use crate::{Error, Result};
use serde::Serialize;
use std::fs::{self, File, FileType, Metadata};
use std::io::{self, BufWriter, ErrorKind, Write};
#[cfg(unix)]
use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};
#[cfg(windows)]
use std::os::windows::fs::symlink_file as symlink;
use std::path::{Path, PathBuf};
use tempfile::{NamedTempFile, TempPath};

/// Suffix of files that are being written.
const PARTIAL: &str = "globalsplat-partial";
/// Maximum length in bytes of the part of a temporary name that is taken from the final one, which may be as long as the file system
/// allows.
const NAME_BYTES: usize = 48;

/// Writes `path` through a temporary file beside it: readers see the old file or the new one, never a part, and a full disk leaves the old
/// one unchanged. Links are followed, and the new file has the permissions of the old one.
///
/// # Errors
/// Returns the error of `fill`, or an error if something other than a regular file is at `path` or the file can't be written.
pub fn write_atomically(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    write_temporary(path, fill)?.persist()
}

/// Writes a file like [`write_atomically`], but leaves it under its temporary name until [`PartialFile::persist`] is called.
///
/// # Errors
/// Returns the errors of [`write_atomically`].
pub fn write_temporary(path: &Path, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<PartialFile> {
    let partial = PartialFile::create(path)?;
    let mut writer = BufWriter::new(partial.temporary.as_file());
    fill(&mut writer)?;
    writer.into_inner().map_err(|e| Error::write(path)(e.into_error()))?;
    Ok(partial)
}

/// Writes a file with these `contents`, like [`write_atomically`].
///
/// # Errors
/// Returns the errors of [`write_atomically`].
pub fn write_file(path: &Path, contents: impl AsRef<[u8]>) -> Result<()> {
    write_files([(path, contents.as_ref())])
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
    write_file(path, serde_json::to_vec_pretty(value).expect("numbers and texts"))
}

/// Makes `path` a symbolic link to `target`, atomically. A link or file that was there is replaced.
///
/// # Errors
/// Returns an error if a folder is at `path`, or if the link can't be created.
pub fn replace_link(path: &Path, target: &Path) -> Result<()> {
    let ((), link) = create_temporary(path, |place| symlink(target, place)).map_err(Error::write(path))?;
    rename(link, path).map_err(Error::write(path))
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
        let (file, place) =
            create_temporary(&target, |place| File::create_new(place)).map_err(Error::write(path))?;
        let temporary = NamedTempFile::from_parts(file, place);
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
        rename(temporary.into_temp_path(), &target).map_err(Error::write(&path))
    }
}

/// Checks that a file could be written at `path`, and creates its folder if necessary. Call it before the work starts.
///
/// # Errors
/// Returns a request error that names the path if something other than a regular file is there, or if the file can't be written.
pub fn check_writable_file(path: &Path) -> Result<()> {
    let target = target_of(path, Metadata::is_file, "the name of a file").map_err(refused)?;
    let created = fs::create_dir_all(parent_of(&target)).and_then(|()| probe(&target));
    created.map_err(Error::write(path)).map_err(refused)
}

/// Checks that files could be written in the folder `path`, and creates it if necessary.
///
/// # Errors
/// Returns a request error that names the path if something other than a folder is there, or if the folder can't be written.
pub fn check_writable_dir(path: &Path) -> Result<()> {
    let folder = target_of(path, Metadata::is_dir, "the name of a folder").map_err(refused)?;
    let created = fs::create_dir_all(&folder).and_then(|()| probe(&folder.join("globalsplat-probe")));
    created.map_err(Error::write(path)).map_err(refused)
}

/// Creates a temporary file for `target` and removes it again.
fn probe(target: &Path) -> io::Result<()> {
    let (_file, place) = create_temporary(target, |place| File::create_new(place))?;
    fs::remove_file(&place)?;
    // It would be removed again on drop, although it may be another process's by then.
    let _ = place.keep();
    Ok(())
}

/// Converts a write error into a request error, unless the disk is full.
fn refused(e: Error) -> Error {
    match e {
        Error::Write { ref source, .. } if source.kind() != ErrorKind::StorageFull => {
            Error::request(e.to_string())
        }
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
    match kind {
        #[cfg(unix)]
        _ if kind.is_fifo() => "a FIFO",
        #[cfg(unix)]
        _ if kind.is_socket() => "a socket",
        _ if kind.is_dir() => "a folder",
        _ if kind.is_file() => "a file",
        _ => "a device",
    }
}

fn writable_by_owner(mut permissions: fs::Permissions) -> fs::Permissions {
    #[cfg(unix)]
    permissions.set_mode(permissions.mode() & 0o777 | 0o200);
    #[cfg(windows)]
    permissions.set_readonly(false);
    permissions
}

/// Calls `create` with the first temporary path for `target` at which there is nothing. Returns what it created, and its path, which is
/// removed on drop.
fn create_temporary<T>(target: &Path, create: impl Fn(&Path) -> io::Result<T>) -> io::Result<(T, TempPath)> {
    let mut number = 0;
    loop {
        let place = temporary_path(target, number);
        match create(&place) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => number += 1,
            created => return Ok((created?, TempPath::try_from_path(place)?)),
        }
    }
}

/// Renames what lies at `temporary` to `target`, and syncs the folder's entries to the disk.
fn rename(temporary: TempPath, target: &Path) -> io::Result<()> {
    fs::rename(&temporary, target)?;
    let _ = temporary.keep();
    sync_dir(parent_of(target));
    Ok(())
}

/// Returns a temporary path for `target`, one for each `number`.
fn temporary_path(target: &Path, number: u32) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    let ends = 0..=name.len().min(NAME_BYTES);
    let end = ends.rev().find(|&end| name.is_char_boundary(end)).unwrap_or(0);
    let ending = if number == 0 { String::new() } else { format!("-{number}") };
    target.with_file_name(format!(".{}.{PARTIAL}{ending}", &name[..end]))
}

/// Returns the folder of `path`; for a bare file name, `.`.
pub fn parent_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Syncs the entries of a folder to the disk, without which a new or renamed one may be lost in a power cut. Best effort: not every file
/// system supports it.
pub fn sync_dir(path: &Path) {
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

    #[test]
    fn the_parent_of_a_name_alone_is_the_working_folder() {
        assert_eq!(parent_of(Path::new("cameras.json")), Path::new("."));
        assert_eq!(parent_of(Path::new("room/cameras.json")), Path::new("room"));
        assert_eq!(parent_of(Path::new("/cameras.json")), Path::new("/"));
    }

    #[test]
    fn writers_of_one_file_have_names_of_their_own() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("room.ply");
        let first = PartialFile::create(&file).unwrap();
        let second = PartialFile::create(&file).unwrap();
        assert_eq!(names(root.path()), [".room.ply.globalsplat-partial", ".room.ply.globalsplat-partial-1"]);
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
            write_file(&file, "text").unwrap();
            assert_eq!(names(root.path()), [name]);
            fs::remove_file(file).unwrap();
        }
        #[cfg(unix)]
        assert!(check_writable_file(&root.path().join("x".repeat(256))).unwrap_err().is_invalid_request());
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_anything_else_is_refused() {
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
            write_file(&at(link), "new").unwrap();
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
            (at("loop"), "can't be written"),
            #[cfg(target_os = "linux")]
            ("/proc/self/exe".into(), "an open file of a process"),
        ] {
            for error in [check_writable_file(&path).unwrap_err(), write_file(&path, "new").unwrap_err()] {
                assert!(error.to_string().contains(found), "{error}");
            }
            assert!(check_writable_file(&path).unwrap_err().is_invalid_request());
        }
        for file in ["fifo", "below/file"] {
            assert!(check_writable_dir(&at(file)).unwrap_err().to_string().contains("the name of a folder"));
        }
        assert_eq!(names(root.path()), ["below", "dangling", "fifo", "loop", "socket", "to_fifo", "twice"]);
    }

    /// Windows replaces no file that another program has open for itself.
    #[cfg(windows)]
    #[test]
    fn a_file_in_use_stays_as_it_is() {
        use std::os::windows::fs::OpenOptionsExt;
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("room.ply");
        fs::write(&file, "old").unwrap();
        let in_use = fs::OpenOptions::new().read(true).share_mode(0).open(&file).unwrap();
        let error = write_file(&file, "new").unwrap_err().to_string();
        assert!(error.contains("room.ply") && error.contains("can't be written"), "{error}");
        drop(in_use);
        assert_eq!((names(root.path()), fs::read(&file).unwrap()), (vec!["room.ply".into()], b"old".into()));
        // The name of a device.
        assert!(check_writable_file(&root.path().join("NUL")).unwrap_err().is_invalid_request());
    }

    #[cfg(unix)]
    #[test]
    fn permissions_are_preserved() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("private");
        for (before, after) in [(0o600, 0o600), (0o400, 0o600), (0o664, 0o664)] {
            fs::write(&file, "old").unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(before)).unwrap();
            write_file(&file, "new").unwrap();
            assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, after);
            fs::remove_file(&file).unwrap();
        }
    }
}
