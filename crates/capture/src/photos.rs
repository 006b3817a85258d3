//! Files of photos and masks: the search for those that a capture names, folders of photos without poses, and the order and forms of names.

use crate::formats::polycam::is_polycam;
use crate::geo::GEO_FILE;
use crate::pixels::{PHOTO_EXTENSIONS, SUPPORTED_IMAGES, read_image_size};
use globalsplat_files::{Error, Result, relative_name};
use rayon::prelude::*;
use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Component, Path, PathBuf};

/// Name of the folder of masks, beside or in the folder of photos.
pub const MASKS_FOLDER: &str = "masks";

/// Reduction factors of the folders of smaller photos that tools create next to `images`: `images_2` and so on.
const REDUCTIONS: [Option<u32>; 4] = [None, Some(2), Some(4), Some(8)];

/// Maximum number of leading folders of a name that may be skipped.
const MAX_SKIPPED_FOLDERS: usize = 16;

/// Minimum number of photos of a capture.
const MIN_PHOTOS: usize = 2;

/// Looks for the photos `names` below `bases` and returns the path of each photo that exists.
///
/// A name may come from another machine: with backslashes, without its extension or with one in different case, below a folder that
/// doesn't exist here, or in `images` when only `images_2`, `images_4` or `images_8` exists. One rule applies to all names: the
/// first that finds two photos without mapping different names to the same photo.
pub(crate) fn find_photos(bases: &[PathBuf], names: &[impl AsRef<str>]) -> Vec<Option<PathBuf>> {
    let deepest = names.iter().map(|name| parts(name.as_ref()).count()).max().unwrap_or(0);
    let rules = bases.iter().flat_map(|base| {
        (0..deepest.clamp(1, MAX_SKIPPED_FOLDERS))
            .flat_map(move |skipped| REDUCTIONS.map(|reduction| (base, skipped, reduction)))
    });
    let mut best = (0, vec![None; names.len()]);
    for (base, skipped, reduction) in rules {
        let find = |name| find_photo(base, name, skipped, reduction);
        let found: Vec<_> = names.iter().map(|name| find(name.as_ref())).collect();
        let pairs =
            names.iter().zip(&found).filter_map(|(name, photo)| Some((name.as_ref(), photo.as_ref()?)));
        let (named, photos): (BTreeSet<&str>, BTreeSet<&PathBuf>) = pairs.unzip();
        let (count, is_ambiguous) = (photos.len(), photos.len() < named.len());
        if count > best.0 && !(is_ambiguous && skipped > 0) {
            best = (count, found);
            if count >= MIN_PHOTOS {
                break;
            }
        }
    }
    best.1
}

/// Looks for the masks of the photos `names` in `folders`: files with the name of the photo, with the extension of an image added or
/// in place of its own, or either after `_mask`. Photos of the same name but for the extension share a mask. Returns one path,
/// or `None`, for each photo.
pub fn find_masks(folders: &[PathBuf], names: &[impl AsRef<str>]) -> Vec<Option<PathBuf>> {
    if !folders.iter().any(|folder| folder.is_dir()) {
        return vec![None; names.len()];
    }
    let names: Vec<String> = names.iter().map(|name| portable(name.as_ref())).collect();
    let stem = |name: &String| Path::new(name).with_extension("").to_string_lossy().into_owned();
    let stems: Vec<String> = names.iter().map(stem).collect();
    let [with_words, with_word] =
        [&names, &stems].map(|names| names.iter().map(|name| format!("{name}_mask")).collect());
    let found = [names, stems, with_words, with_word].map(|names: Vec<String>| find_photos(folders, &names));
    (0..found[0].len()).map(|photo| found.iter().find_map(|masks| masks[photo].clone())).collect()
}

/// Looks for masks like [`find_masks`] in a folder that has to have some.
///
/// # Errors
/// Fails if the folder can't be read or has no mask for any photo.
pub fn find_masks_in(folder: &Path, names: &[impl AsRef<str>]) -> Result<Vec<Option<PathBuf>>> {
    std::fs::read_dir(folder).map_err(Error::read(folder))?;
    let masks = find_masks(&[folder.to_owned()], names);
    if masks.iter().all(Option::is_none) {
        let expected = format!("{}.png", names.first().map_or("photo.jpg", AsRef::as_ref));
        return Err(Error::input(folder, "the folder", "without a mask for any photo", expected));
    }
    Ok(masks)
}

/// Returns the name with `/` as the separator.
pub(crate) fn portable(name: &str) -> String {
    name.replace('\\', "/")
}

fn parts(name: &str) -> impl Iterator<Item = &str> {
    name.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".")
}

/// Looks for the photo `name` below `base`, without its first `skipped` folders, in a folder of smaller photos if there is a `reduction`.
fn find_photo(base: &Path, name: &str, skipped: usize, reduction: Option<u32>) -> Option<PathBuf> {
    if (skipped, reduction) == (0, None)
        && !name.is_empty()
        && let Some(photo) = file_at(base.join(name))
    {
        return Some(photo);
    }
    let mut parts = parts(name).skip(skipped).peekable();
    let first = parts.next()?;
    let folder = match reduction {
        None => first.to_string(),
        Some(factor) => parts.peek().map(|_| format!("{first}_{factor}"))?,
    };
    let mut path = base.join(folder);
    path.extend(parts);
    file_at(path)
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

/// Names of files that systems leave in folders, beside hidden ones.
const SYSTEM_FILES: [&str; 2] = ["Thumbs.db", "desktop.ini"];

/// Names of files and folders in Polycam's raw data whose pictures aren't photos.
const POLYCAM_PICTURES: [&str; 3] = ["thumbnail.jpg", "depth", "confidence"];

/// File extensions of videos, in lower case.
const VIDEO_EXTENSIONS: [&str; 16] = [
    "mp4", "mov", "m4v", "mkv", "webm", "avi", "mts", "m2ts", "360", "insv", "3gp", "wmv", "mpg", "mpeg",
    "ts", "flv",
];

/// The photos in a folder and its subfolders.
#[derive(Debug)]
pub struct PhotoList {
    /// Paths of the photos, with numbers in paths compared by value.
    pub photos: Vec<PathBuf>,
    /// Paths of the other files relative to the folder, in the same order.
    pub others: Vec<String>,
    /// Line about the other files, if there are any.
    pub warning: Option<String>,
}

/// Lists the photos in `folder` and its subfolders, as COLMAP does.
///
/// A photo is a file whose contents begin as those of an image, whatever format its extension names, and whose extension is that of a
/// photo in any case, or missing. So a text file named `.jpg` is none, and neither is a camera's raw file, whose contents begin as those
/// of a TIFF. Hidden files and folders, files of the system, [`GEO_FILE`], folders named `masks`, and Polycam's depths and thumbnails are ignored.
///
/// # Errors
/// Fails if a folder can't be read, or if there is no photo.
pub fn list_photos(folder: &Path) -> Result<PhotoList> {
    let mut files = vec![];
    collect_files(folder, &mut files)?;
    files.sort_by(natural_order);
    let (photos, others): (Vec<_>, Vec<_>) = files.into_par_iter().partition(|file| is_photo(file));
    if photos.is_empty() {
        let found = format!("without photos, of {} files", others.len());
        let video = others.iter().find(|file| has_extension(file, &VIDEO_EXTENSIONS));
        let video = video.map_or(String::new(), |file| format!(", or one video itself: {}", file.display()));
        return Err(Error::input(
            folder,
            "the folder",
            found,
            format!("photos, each {SUPPORTED_IMAGES}{video}"),
        ));
    }
    let others: Vec<String> = others.iter().map(|file| relative_name(file, folder)).collect();
    let warning = describe_photos(folder, &others, |count| {
        format!("{count} of {} files are no photos and left out", count + photos.len())
    });
    Ok(PhotoList { photos, others, warning })
}

/// Adds the files below `folder`. Links to folders count as files, so that no folder is visited twice.
fn collect_files(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let others = if is_polycam(folder) { &POLYCAM_PICTURES[..] } else { &[] };
    for entry in std::fs::read_dir(folder).map_err(Error::read(folder))? {
        let entry = entry.map_err(Error::read(folder))?;
        let name = entry.file_name();
        let is_known = SYSTEM_FILES.iter().chain(others).any(|known| name == *known) || name == GEO_FILE;
        if name.as_encoded_bytes().starts_with(b".") || is_known {
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
    // Opening anything but a file, such as a pipe, may block.
    (file.extension().is_none() || has_extension(file, &PHOTO_EXTENSIONS))
        && file.is_file()
        && read_image_size(file).is_ok()
}

/// Returns `true` if the extension of `file` is one of `known` in any case.
fn has_extension(file: &Path, known: &[&str]) -> bool {
    let extension = file.extension().unwrap_or_default();
    known.iter().any(|known| extension.eq_ignore_ascii_case(known))
}

/// Compares names or paths folder by folder. Within a folder's name, runs of digits are compared by their numeric value, however
/// long, and everything else byte by byte. Leading zeros break ties.
pub(crate) fn natural_order<Name: AsRef<OsStr> + ?Sized>(a: &Name, b: &Name) -> Ordering {
    let [mut folders_of_a, mut folders_of_b] =
        [a, b].map(|name| name.as_ref().as_encoded_bytes().split(|&byte| byte == b'/'));
    loop {
        // Compare a folder completely, including zeros, before its contents, so that the contents of different folders never
        // interleave.
        match (folders_of_a.next(), folders_of_b.next()) {
            (Some(a), Some(b)) if a == b => {}
            (Some(a), Some(b)) => return tokens(a).cmp(tokens(b)).then_with(|| a.cmp(b)),
            (a, b) => return a.is_some().cmp(&b.is_some()),
        }
    }
}

/// Splits a name into tokens to compare: bytes, and numbers. A number has the byte `0`, its number of digits, and its digits, the
/// latter two without leading zeros.
fn tokens(mut rest: &[u8]) -> impl Iterator<Item = (u8, usize, &[u8])> {
    std::iter::from_fn(move || {
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let (token, after) = rest.split_at_checked(digits.max(1))?;
        rest = after;
        if digits == 0 {
            return Some((token[0], 0, &token[..0]));
        }
        let zeros = token.iter().take_while(|&&digit| digit == b'0').count();
        Some((b'0', digits - zeros, &token[zeros..]))
    })
}

/// Returns a line about the photos `names` of `file`, of which `describe` tells something, given their number. Returns `None` without
/// photos.
pub(crate) fn describe_photos(
    file: &Path,
    names: &[impl AsRef<str>],
    describe: impl FnOnce(usize) -> String,
) -> Option<String> {
    (!names.is_empty())
        .then(|| format!("{}: {}: {}", file.display(), describe(names.len()), format_names(names, 3)))
}

/// Formats the first `count` of `names` and the number of the remaining ones.
pub fn format_names(names: &[impl AsRef<str>], count: usize) -> String {
    let shown = names.iter().take(count).map(AsRef::as_ref).collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(count) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

/// Returns the name of the part `suffix` of photo `name`, with `suffix` before the name's extension.
pub(crate) fn part_name(name: &str, suffix: &str) -> String {
    let start = name.rfind('/').map_or(0, |slash| slash + 1);
    let end = name[start..].rfind('.').filter(|&dot| dot > 0).map_or(name.len(), |dot| start + dot);
    match suffix {
        "" => name.into(),
        _ => format!("{}@{suffix}{}", &name[..end], &name[end..]),
    }
}

/// Returns a unique name without extension for each of `names`, such that no two of the names followed by one of `suffixes` are equal. The
/// names are relative to the deepest folder that contains all of them. They keep their extensions if they aren't unique otherwise, and
/// numbers replace them if they aren't even then.
pub(crate) fn unique_stems(names: &[&str], suffixes: &[&str]) -> Vec<String> {
    let plain = |part: Component| match part {
        Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
        Component::ParentDir => Some("up".to_string()),
        _ => None,
    };
    let paths: Vec<Vec<String>> =
        names.iter().map(|name| Path::new(name).components().filter_map(plain).collect()).collect();
    let shared = |path: &Vec<String>| {
        let folders = path[..path.len().saturating_sub(1)].iter();
        folders.zip(&paths[0]).take_while(|(folder, first)| folder == first).count()
    };
    let skipped = paths.iter().map(shared).min().unwrap_or(0);
    let below = |path: &Vec<String>| path[skipped..].join("/");
    let stem = |path: &Vec<String>| Path::new(&below(path)).with_extension("").to_string_lossy().into_owned();
    let choices: [Vec<String>; 2] = [paths.iter().map(stem).collect(), paths.iter().map(below).collect()];
    let is_unique = |names: &Vec<String>| {
        let files =
            names.iter().flat_map(|name| suffixes.iter().map(move |suffix| format!("{name}{suffix}")));
        files.collect::<BTreeSet<_>>().len() == names.len() * suffixes.len()
    };
    let numbers = || (0..names.len()).map(|index| format!("{index:06}")).collect();
    choices.into_iter().find(is_unique).unwrap_or_else(numbers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use globalsplat_files::is_same_file;

    #[test]
    fn photos_are_found_however_their_paths_are_written() {
        let files = ["images/a b (1).png", "images/c.JPG"];
        let reduced = ["images_8/1/a.png", "images_8/1/b.png", "images_4/1/a.png", "images_4/1/b.png"];
        let thinned = ["images/a.png", "images/b.png", "images_2/a.png", "images_2/b.png", "images_2/c.png"];
        type Names<'a> = &'a [&'a str];
        let cases: [(Names, Names, &[Option<usize>]); 10] = [
            (&files, &files, &[Some(0), Some(1)]),
            (&files, &[".\\images\\a b (1)", "images\\c.jpg"], &[Some(0), Some(1)]),
            (&files, &["C:\\room\\images\\a b (1).png", "C:\\room\\images\\c.JPG"], &[Some(0), Some(1)]),
            (&files, &["/home/room/images/a b (1).png", "/home/room/images/c.JPG"], &[Some(0), Some(1)]),
            (&files, &["room/images/a b (1).PNG", "room/images/c"], &[Some(0), Some(1)]),
            (&["a.png", "b.png"], &["images/a.png", "images/b.png"], &[Some(0), Some(1)]),
            (&["a.png"], &["", "images"], &[None, None]),
            (&reduced, &["images/1/a.png", "images/1/b.png"], &[Some(2), Some(3)]),
            // A photo that was removed from one folder isn't taken from another.
            (&thinned, &["images/a.png", "images/b.png", "images/c.png"], &[Some(0), Some(1), None]),
            // One photo isn't that of two names.
            (&["0.png", "1.png"], &["left/0.png", "right/0.png", "left/1.png"], &[None, None, None]),
        ];
        for (files, names, expected) in cases {
            let folder = tempfile::tempdir().unwrap();
            let paths: Vec<PathBuf> = files.iter().map(|file| folder.path().join(file)).collect();
            for path in &paths {
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(path, b"").unwrap();
            }
            let found = find_photos(&[folder.path().to_owned()], names);
            assert_eq!(found.len(), expected.len());
            for (found, index) in found.into_iter().zip(expected) {
                // The same file, in the case of the name where the file system ignores it.
                let is_expected = match (&found, index) {
                    (Some(photo), Some(index)) => is_same_file(photo, &paths[*index]),
                    (found, index) => found.is_none() && index.is_none(),
                };
                assert!(is_expected, "{names:?}: {found:?}");
            }
        }
    }

    #[test]
    fn numbers_count_and_folders_stay_together() {
        let (nines, googol) = ("9".repeat(100), "1".to_string() + &"0".repeat(100));
        let names = [
            "", "-", "0", "00", "01", "1", "2.png", "10.png", "0099", &nines, &googol, "a", "a/r_2",
            "a/r_10", "a/r_10/b", "a 9", "a 10", "a-b/r_1", "a01/d", "a1/c", "a1/d", "a2", "é2", "é10",
            "写真2", "写真10",
        ];
        for (i, &a) in names.iter().enumerate() {
            assert!(natural_order(a, a).is_eq(), "{a}");
            for &b in &names[i + 1..] {
                assert!(natural_order(a, b).is_lt() && natural_order(b, a).is_gt(), "{a} {b}");
            }
        }
    }

    #[test]
    fn pictures_are_named_as_photos_and_none_twice() {
        let (one, depth): (&[&str], &[&str]) = (&[""], &["", "_depth"]);
        let cases: [(&[&str], &[&str], &[&str]); 12] = [
            (&["images/000.png", "images/001.png"], one, &["000", "001"]),
            (&["./images/left/0.png", "./images/right/0.png"], one, &["left/0", "right/0"]),
            (&["left/0.png", "1.png"], one, &["left/0", "1"]),
            (&["a/0.png", "a/0.jpg"], one, &["0.png", "0.jpg"]),
            (&["0.v1.png", "0.v2.png"], one, &["0.v1", "0.v2"]),
            (&["../a/0.png", "b/0.png"], one, &["up/a/0", "b/0"]),
            (&["0.png", "0.png"], one, &["000000", "000001"]),
            (&["000000", "000001"], one, &["000000", "000001"]),
            (&[], one, &[]),
            (&["x.png", "y.png"], depth, &["x", "y"]),
            (&["x.png", "x_depth.png"], depth, &["x.png", "x_depth.png"]),
            (&["x", "x_depth"], depth, &["000000", "000001"]),
        ];
        for (names, suffixes, expected) in cases {
            assert_eq!(unique_stems(names, suffixes), expected, "{names:?}");
        }
    }
}
