//! Search for the photos that a capture's file names.

use crate::pixels::PHOTO_EXTENSIONS;
use globalsplat_files::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Reduction factors of the folders of smaller photos that tools create next to `images`: `images_2` and so on.
const REDUCED: [u32; 3] = [2, 4, 8];

/// Maximum number of leading folders of a name that may be skipped.
const MAX_SKIPPED_FOLDERS: usize = 16;

/// Minimum number of photos of a capture.
const MIN_PHOTOS: usize = 2;

/// Rule for turning names into paths: below `base`, without the first `skipped` folders, in a folder of smaller photos if
/// `reduced`.
#[derive(Clone, Copy)]
struct Rule<'a> {
    base: &'a Path,
    skipped: usize,
    reduced: Option<u32>,
}

/// Looks for the photos `names` below `bases` and returns the path of each photo that exists.
///
/// A name may come from another machine: with backslashes, without its extension or with one in different case, below a folder that
/// doesn't exist here, or in `images` when only `images_2`, `images_4` or `images_8` exists. One rule applies to all names: the
/// first that finds two photos without mapping different names to the same photo.
pub(super) fn find_photos(bases: &[PathBuf], names: &[&str]) -> Vec<Option<PathBuf>> {
    let deepest = names.iter().map(|name| parts(name).count()).max().unwrap_or(0);
    let reductions = || std::iter::once(None).chain(REDUCED.map(Some));
    let rules = bases.iter().flat_map(|base| {
        (0..deepest.clamp(1, MAX_SKIPPED_FOLDERS))
            .flat_map(move |skipped| reductions().map(move |reduced| Rule { base, skipped, reduced }))
    });
    let mut best = (0, vec![None; names.len()]);
    for rule in rules {
        let found: Vec<_> = names.iter().map(|name| rule.find(name)).collect();
        let there = || names.iter().zip(&found).filter(|(_, photo)| photo.is_some());
        let photos = there().map(|(_, photo)| photo).collect::<BTreeSet<_>>().len();
        let is_ambiguous = photos < there().map(|(name, _)| name).collect::<BTreeSet<_>>().len();
        if photos > best.0 && !(is_ambiguous && rule.skipped > 0) {
            best = (photos, found);
            if photos >= MIN_PHOTOS {
                break;
            }
        }
    }
    best.1
}

/// Looks for the masks of the photos `names` in `folders`: files with the name of the photo, with the extension of an image added or
/// in place of its own. Photos of the same name but for the extension share a mask. Returns one path, or `None`, for each photo.
pub fn find_masks(folders: &[PathBuf], names: &[&str]) -> Vec<Option<PathBuf>> {
    if !folders.iter().any(|folder| folder.is_dir()) {
        return vec![None; names.len()];
    }
    let names: Vec<String> = names.iter().map(|name| portable(name)).collect();
    let stem = |name: &String| Path::new(name).with_extension("").to_string_lossy().into_owned();
    let stems: Vec<String> = names.iter().map(stem).collect();
    let find = |names: &[String]| find_photos(folders, &names.iter().map(String::as_str).collect::<Vec<_>>());
    find(&names).into_iter().zip(find(&stems)).map(|(mask, by_stem)| mask.or(by_stem)).collect()
}

/// Looks for masks like [`find_masks`] in a folder that has to have some.
///
/// # Errors
/// Fails if the folder can't be read or has no mask for any photo.
pub fn find_masks_in(folder: &Path, names: &[&str]) -> Result<Vec<Option<PathBuf>>> {
    std::fs::read_dir(folder).map_err(Error::read(folder))?;
    let masks = find_masks(&[folder.to_owned()], names);
    if masks.iter().all(Option::is_none) {
        let expected = format!("{}.png", names.first().unwrap_or(&"photo.jpg"));
        return Err(Error::input(folder, "the folder", "without a mask for any photo", expected));
    }
    Ok(masks)
}

/// Returns the name with `/` as the separator.
pub(super) fn portable(name: &str) -> String {
    name.replace('\\', "/")
}

fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".")
}

impl Rule<'_> {
    fn find(&self, name: &str) -> Option<PathBuf> {
        let as_written = match (self.skipped, self.reduced) {
            (0, None) if !name.is_empty() => file_at(self.base.join(name)),
            _ => None,
        };
        as_written.or_else(|| {
            let mut parts = parts(name).skip(self.skipped).peekable();
            let first = parts.next()?;
            let mut path = self.base.to_owned();
            match self.reduced {
                None => path.push(first),
                Some(factor) if parts.peek().is_some() => path.push(format!("{first}_{factor}")),
                Some(_) => return None,
            }
            path.extend(parts);
            file_at(path)
        })
    }
}

/// Returns the file at `path`, or the photo whose name differs only in the case of its extension or has an additional extension.
fn file_at(path: PathBuf) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path);
    }
    let extension = path.extension().unwrap_or_default();
    let recased = [extension.to_ascii_lowercase(), extension.to_ascii_uppercase()];
    let recased = recased.map(|extension| path.with_extension(extension));
    let complete = |extension: &str| {
        let mut path = path.clone().into_os_string();
        path.push(format!(".{extension}"));
        PathBuf::from(path)
    };
    let extensions = PHOTO_EXTENSIONS.iter();
    let complete = extensions.flat_map(|known| [complete(known), complete(&known.to_ascii_uppercase())]);
    recased.into_iter().chain(complete).find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the paths, relative to a folder with `files`, that are found for `names`.
    fn found(files: &[&str], names: &[&str]) -> Vec<Option<String>> {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let file = folder.path().join(file);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, b"").unwrap();
        }
        let base = folder.path().to_owned();
        let below = |path: PathBuf| path.strip_prefix(&base).unwrap().to_str().unwrap().to_string();
        find_photos(std::slice::from_ref(&base), names).into_iter().map(|path| path.map(below)).collect()
    }

    fn all(names: &[&str]) -> Vec<Option<String>> {
        names.iter().map(|name| Some(name.to_string())).collect()
    }

    #[test]
    fn photos_are_found_however_their_paths_are_written() {
        let files = ["images/a b (1).png", "images/c.JPG"];
        for names in [
            ["images/a b (1).png", "images/c.JPG"],
            ["./images/a b (1)", "images\\c.jpg"],
            ["C:\\Users\\me\\room\\images\\a b (1).png", "C:\\Users\\me\\room\\images\\c.JPG"],
            ["/home/me/room/images/a b (1).png", "/home/me/room/images/c.JPG"],
            ["room/images/a b (1).PNG", "room/images/c"],
        ] {
            assert_eq!(found(&files, &names), all(&files), "{names:?}");
        }
        assert_eq!(found(&["a.png", "b.png"], &["images/a.png", "images/b.png"]), all(&["a.png", "b.png"]));
        assert_eq!(found(&["a.png"], &["", "images"]), [None, None]);
    }

    #[test]
    fn downscaled_folders_replace_missing_photos() {
        let names = ["images/1/a.png", "images/1/b.png"];
        let reduced = ["images_8/1/a.png", "images_8/1/b.png", "images_4/1/a.png", "images_4/1/b.png"];
        assert_eq!(found(&reduced, &names), all(&reduced[2..]));
        // A photo that was removed from one folder isn't taken from another.
        let files = ["images/a.png", "images/b.png", "images_2/a.png", "images_2/b.png", "images_2/c.png"];
        let names = ["images/a.png", "images/b.png", "images/c.png"];
        assert_eq!(found(&files, &names), [all(&names[..2]), vec![None]].concat());
    }

    #[test]
    fn one_photo_is_not_matched_twice() {
        assert_eq!(
            found(&["0.png", "1.png"], &["left/0.png", "right/0.png", "left/1.png"]),
            [None, None, None]
        );
    }
}
