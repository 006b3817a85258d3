//! Folders of photos without poses.

use super::MASKS_FOLDER;
use super::natural::natural_order;
use crate::capture::format_names;
use crate::pixels::{PHOTO_EXTENSIONS, SUPPORTED_IMAGES, read_image_size};
use globalsplat_files::{Error, Result};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Names of files that systems leave in folders, beside hidden ones.
const SYSTEM_FILES: [&str; 2] = ["Thumbs.db", "desktop.ini"];

/// The photos in a folder and its subfolders.
#[derive(Debug)]
pub struct PhotoList {
    /// Paths of the photos, with numbers in paths compared by value.
    pub photos: Vec<PathBuf>,
    /// Paths of the other files, in the same order.
    pub others: Vec<PathBuf>,
    folder: PathBuf,
}

impl PhotoList {
    /// Returns a line about the files that are no photos, if there are any.
    pub fn warning(&self) -> Option<String> {
        let name = |path: &PathBuf| path.strip_prefix(&self.folder).unwrap_or(path).display().to_string();
        let names: Vec<String> = self.others.iter().map(name).collect();
        (!names.is_empty()).then(|| {
            let (count, all) = (names.len(), names.len() + self.photos.len());
            let names = format_names(names.iter().map(String::as_str));
            format!("{}: {count} of {all} files are no photos and left out: {names}", self.folder.display())
        })
    }
}

/// Lists the photos in `folder` and its subfolders, as COLMAP does.
///
/// A photo is a file whose contents begin as those of an image, whatever format its extension names, and whose extension is that of a
/// photo in any case, or missing. So a text file named `.jpg` is none, and neither is a camera's raw file, whose contents begin as those
/// of a TIFF. Hidden files and folders, files of the system, and folders named `masks` are ignored.
///
/// # Errors
/// Fails if a folder can't be read, or if there is no photo.
pub fn list_photos(folder: &Path) -> Result<PhotoList> {
    let mut files = vec![];
    collect_files(folder, &mut files)?;
    files.sort_by(natural_order);
    let are_photos: Vec<bool> = files.par_iter().map(|file| is_photo(file)).collect();
    let (mut photos, mut others) = (vec![], vec![]);
    for (file, is_photo) in files.into_iter().zip(are_photos) {
        if is_photo { photos.push(file) } else { others.push(file) }
    }
    if photos.is_empty() {
        let found = format!("without photos, of {} files", others.len());
        return Err(Error::input(folder, "the folder", found, format!("photos, each {SUPPORTED_IMAGES}")));
    }
    Ok(PhotoList { photos, others, folder: folder.to_owned() })
}

/// Adds the files below `folder`. Links to folders count as files, so that no folder is visited twice.
fn collect_files(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(Error::read(folder))? {
        let entry = entry.map_err(Error::read(folder))?;
        let name = entry.file_name();
        if name.as_encoded_bytes().starts_with(b".") || SYSTEM_FILES.iter().any(|system| name == *system) {
            continue;
        }
        match entry.file_type().map_err(Error::read(entry.path()))?.is_dir() {
            false => files.push(entry.path()),
            true if name == MASKS_FOLDER => {}
            true => collect_files(&entry.path(), files)?,
        }
    }
    Ok(())
}

fn is_photo(file: &Path) -> bool {
    let is_known =
        |extension: &str| PHOTO_EXTENSIONS.iter().any(|known| known.eq_ignore_ascii_case(extension));
    let extension = file.extension().map(|extension| extension.to_string_lossy());
    // Opening anything but a file, such as a pipe, may block.
    extension.is_none_or(|extension| is_known(&extension)) && file.is_file() && read_image_size(file).is_ok()
}
