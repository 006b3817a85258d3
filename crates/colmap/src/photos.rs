//! Photos of a folder, checked and brought into a capture's folder of images.

use crate::progress::{Progress, Reporter, Step};
use globalsplat_capture::{
    MASKS_FOLDER, decode_photo, encode_photo, exif_focal, find_masks, find_masks_in, gray_to_rgb,
    is_equirectangular, list_photos, read_image_size, read_mask,
};
use globalsplat_files::{Error, Result, checksum, parent_of, write_file};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Maximum difference between values of a photo that shows nothing, such as one taken with the lens cap on.
const BLANK: u8 = 8;

/// A photo of the given folder, as it was found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct FoundPhoto {
    /// Path relative to the folder, with `/` as the separator.
    pub name: String,
    /// Size of the file.
    pub bytes: u64,
    /// CRC-32 of its contents.
    pub checksum: u32,
}

/// A photo in the folder of images that COLMAP reads.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Photo {
    /// Path relative to the folder of images. It has no spaces, which separate names in COLMAP's lists.
    pub name: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Focal length that the file's EXIF data tell, in pixels.
    pub focal: Option<f64>,
    /// `true` if the file's XMP data declare a panorama of 360°.
    pub is_equirectangular: bool,
}

/// A photo that isn't used.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SkippedPhoto {
    /// Path relative to the folder of photos.
    pub name: String,
    /// Why the photo isn't used, in a few words.
    pub reason: String,
}

/// Returns the photos in `folder` and its subfolders, in order of their names, and a line about the other files, if there are any.
///
/// # Errors
/// Returns an error if a folder or a photo can't be read, or if there is no photo.
pub(crate) fn find_photos(folder: &Path) -> Result<(Vec<FoundPhoto>, Option<String>)> {
    let list = list_photos(folder)?;
    let describe = |path: &PathBuf| {
        let bytes = fs::metadata(path).map_err(Error::read(path))?.len();
        let name = path.strip_prefix(folder).unwrap_or(path).to_string_lossy();
        Ok(FoundPhoto { name: name.into_owned(), bytes, checksum: checksum([path])? })
    };
    let found = list.photos.par_iter().map(describe).collect::<Result<_>>()?;
    Ok((found, list.warning))
}

/// Brings the photos `found` in `source` into the folder `images`, by a hard link where the file system allows it. COLMAP
/// reads pixels as they are stored: photos that EXIF says to rotate are written upright, and those that aren't JPEGs or PNGs are
/// converted. Masks, which are files in `masks` or the opacity of a converted photo, are written to the folder [`MASKS_FOLDER`] beside `images`,
/// each of the size of its photo. Returns the photos in the order in which they were found, and those that aren't used.
///
/// # Errors
/// Returns an error if a file can't be written, if a mask can't be read, if `masks` is given and has none for any photo, or if `source` is
/// `images` and a photo in it would need another name or other contents.
pub(crate) fn import_photos(
    source: &Path,
    found: &[FoundPhoto],
    masks: Option<&Path>,
    images: &Path,
    reporter: &mut Reporter,
) -> Result<(Vec<Photo>, Vec<SkippedPhoto>)> {
    let all_names: Vec<&str> = found.iter().map(|photo| photo.name.as_str()).collect();
    let mask_files = match masks {
        Some(folder) => find_masks_in(folder, &all_names)?,
        None => find_masks(&[source.join(MASKS_FOLDER)], &all_names),
    };
    let (mut photos, mut skipped, mut distinct) = (vec![], vec![], vec![]);
    let mut first_of = HashMap::new();
    for (photo, mask) in found.iter().zip(&mask_files) {
        let first = *first_of.entry((photo.bytes, photo.checksum)).or_insert(&photo.name);
        if *first == photo.name {
            distinct.push((&photo.name, mask));
        } else {
            let (name, reason) = (photo.name.clone(), format!("identical to {first}"));
            skipped.push(SkippedPhoto { name, reason });
        }
    }
    let is_in_place = is_same_folder(source, images);
    let mut names = HashSet::new();
    let mut done = skipped.len();
    // Few photos at a time, for progress and memory.
    for few in distinct.chunks(2 * rayon::current_num_threads()) {
        let inspected: Vec<_> =
            few.par_iter().map(|(name, mask)| inspect(source, name, mask.as_deref(), &all_names)).collect();
        for (&(name, _), inspected) in few.iter().zip(inspected) {
            let path = source.join(name);
            let Inspected { mut photo, contents, mask } = match inspected {
                Ok(inspected) => inspected,
                Err(reason) => {
                    skipped.push(SkippedPhoto { name: name.clone(), reason });
                    continue;
                }
            };
            photo.name = list_name(photo.name, &mut names);
            if is_in_place && (contents.is_some() || photo.name != *name) {
                let found = "one that COLMAP can't read as it is, by its name, format or rotation";
                let expected = "an output whose images aren't the photos themselves";
                return Err(Error::input(path, "the photo", found, expected));
            }
            let target = images.join(&photo.name);
            if let Some(contents) = contents {
                write_with_folder(&target, &contents)?;
            } else if !is_in_place {
                link(&path, &target)?;
            }
            let target = images.with_file_name(MASKS_FOLDER).join(format!("{}.png", photo.name));
            if let Some(mask) = mask? {
                write_with_folder(&target, &mask)?;
            } else if !is_in_place {
                // A run with other masks may have left one.
                let _ = fs::remove_file(target);
            }
            photos.push(photo);
        }
        done += few.len();
        reporter.report(Progress { step: Step::Photos, done, total: found.len() })?;
    }
    Ok((photos, skipped))
}

/// Returns `true` if both paths lead to the same folder.
pub(crate) fn is_same_folder(a: &Path, b: &Path) -> bool {
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
}

/// Returns a name that COLMAP's lists can hold, and that differs from `taken`, to which it is added.
fn list_name(name: String, taken: &mut HashSet<String>) -> String {
    let mut safe = name.replace(|c: char| c.is_whitespace() || c.is_control(), "_");
    while !taken.insert(safe.clone()) {
        safe.insert(safe.rfind('/').map_or(0, |slash| slash + 1), '_');
    }
    safe
}

/// A photo that was decoded.
struct Inspected {
    /// The upright photo. Its name has the extension of the file that COLMAP reads.
    photo: Photo,
    /// Contents of a file that COLMAP reads, if the photo's own isn't one.
    contents: Option<Vec<u8>>,
    /// PNG of the photo's mask, or of its opacity, if it has one and `contents` lacks it.
    mask: Result<Option<Vec<u8>>>,
}

/// Decodes the photo `name` in `source` and its mask in the file `mask`; returns why it can't be used if it is damaged or shows nothing. Its
/// name is changed to none of `all_names`.
fn inspect(source: &Path, name: &str, mask: Option<&Path>, all_names: &[&str]) -> Result<Inspected, String> {
    let path = &source.join(name);
    let refuse = |why: Error| match why {
        Error::Input { found, .. } => found,
        other => other.to_string(),
    };
    let encoded = fs::read(path).map_err(|why| match name.contains(char::REPLACEMENT_CHARACTER) {
        true => "named in another encoding than UTF-8".to_string(),
        false => format!("unreadable ({why})"),
    })?;
    let (width, height) = read_image_size(path).map_err(refuse)?;
    // Declaring the sides in the other order has the photo rotated if its EXIF says so.
    let decoded = decode_photo(&encoded, path, (height, width)).map_err(refuse)?;
    let pixels = decoded.pixels;
    let (darkest, brightest) =
        pixels.iter().fold((u8::MAX, u8::MIN), |(low, high), &value| (low.min(value), high.max(value)));
    if brightest - darkest <= BLANK {
        return Err("of a single color".into());
    }
    // COLMAP goes by the extension.
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    let is_png = decoded.is_png && extension == "png";
    let is_jpeg = decoded.is_jpeg && (extension == "jpg" || extension == "jpeg");
    let is_readable = (is_png || is_jpeg) && pixels.dimensions() == (width, height);
    let contents = (!is_readable).then(|| encode_photo(&pixels, !is_png)).transpose().map_err(refuse)?;
    let levels = match (mask, decoded.alpha) {
        // COLMAP compares a mask with its photo pixel by pixel.
        (Some(file), _) => check_aspect(file, pixels.dimensions())
            .and_then(|()| read_mask(file, pixels.dimensions()))
            .map(Some),
        (None, Some(alpha)) if !is_readable => Ok(Some(gray_to_rgb(&alpha))),
        (None, _) => Ok(None),
    };
    let mask = levels.and_then(|levels| levels.map(|levels| encode_photo(&levels, false)).transpose());
    let jpeg_name = Path::new(name).with_extension("jpg").to_string_lossy().into_owned();
    let name = match is_png || is_jpeg {
        true => name.to_string(),
        false if all_names.contains(&jpeg_name.as_str()) => format!("{name}.jpg"),
        false => jpeg_name,
    };
    let photo = Photo {
        name,
        width: pixels.width(),
        height: pixels.height(),
        focal: exif_focal(&encoded),
        is_equirectangular: is_equirectangular(&encoded),
    };
    Ok(Inspected { photo, contents, mask })
}

/// Checks that the mask `file` has `size` = (width, height), the size of its photo, or both sides by one factor.
fn check_aspect(file: &Path, size: (u32, u32)) -> Result<()> {
    let found = read_image_size(file)?;
    let [(w, h), (width, height)] = [found, size].map(|(w, h)| (f64::from(w), f64::from(h)));
    // Each side of the mask may be rounded.
    if (w * height - h * width).abs() <= (width + height) / 2. {
        return Ok(());
    }
    let expected = format!("{}×{} pixels as its upright photo, or both by one factor", size.0, size.1);
    Err(Error::input(file, "the mask", format!("{}×{} pixels", found.0, found.1), expected))
}

/// Writes a file, and its folder.
fn write_with_folder(target: &Path, contents: &[u8]) -> Result<()> {
    fs::create_dir_all(parent_of(target)).map_err(Error::write(target))?;
    write_file(target, contents)
}

/// Links `target` to the file `source`, copying it if it can't be linked.
fn link(source: &Path, target: &Path) -> Result<()> {
    let source = source.canonicalize().map_err(Error::read(source))?;
    fs::create_dir_all(parent_of(target)).map_err(Error::write(target))?;
    // A link that an earlier run left may be to another file.
    let _ = fs::remove_file(target);
    if fs::hard_link(&source, target).is_err() {
        fs::copy(&source, target).map_err(Error::write(target))?;
    }
    Ok(())
}
