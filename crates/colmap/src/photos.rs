//! Photos of a folder, checked and brought into a capture's folder of images.

use crate::progress::{Progress, Reporter, Step};
use crate::record::Record;
use globalsplat_capture::{
    GEO_FILE, GeoPosition, MASKS_FOLDER, decode_upright, encode_photo, encode_upright, exif_focal,
    exif_position, find_masks, find_masks_in, fit_mask, gray_to_rgb, is_equirectangular, list_photos,
    read_geo_positions, read_image_size,
};
use globalsplat_files::{
    Error, Result, checksum, is_same_file, parent_of, real_path, relative_name, write_file,
};
use image::imageops::thumbnail;
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Maximum difference between values of a photo that shows nothing, such as one taken with the lens cap on.
const BLANK: u8 = 8;

/// Number of pixels above which photos are reduced. COLMAP decodes a photo on each core, and reduces it further.
pub(crate) const MAX_PIXELS: u64 = 128_000_000;

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

/// File of a photo's mask, as it was found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct FoundMask {
    pub file: PathBuf,
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
    /// `true` if the photo in the folder has more than [`MAX_PIXELS`].
    #[serde(default)]
    pub is_reduced: bool,
    /// Position that the file's EXIF data tell.
    #[serde(default)]
    pub position: Option<GeoPosition>,
    /// `true` if the photo that was found isn't opaque, which makes a mask.
    #[serde(default)]
    pub has_alpha: bool,
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
        Ok(FoundPhoto { name: relative_name(path, folder), bytes, checksum: checksum([path])? })
    };
    let found = list.photos.par_iter().map(describe).collect::<Result<_>>()?;
    Ok((found, list.warning))
}

/// Returns the masks of the photos `found` in `source`, by the names of the photos: those in the folder `masks`, or in a folder
/// [`MASKS_FOLDER`] among the photos, without those that calls have written to the capture in `out`, by its record `old`.
///
/// # Errors
/// Returns an error if `masks` is the folder of the photos or of the capture's images, or has no mask for any photo, or if a mask can't be
/// read.
pub(crate) fn find_photo_masks(
    source: &Path,
    found: &[FoundPhoto],
    masks: Option<&Path>,
    out: &Path,
    old: Option<&Record>,
) -> Result<BTreeMap<String, FoundMask>> {
    let names: Vec<&str> = found.iter().map(|photo| photo.name.as_str()).collect();
    let files = match masks {
        Some(folder) if is_same_file(folder, source) || is_same_file(folder, &out.join("images")) => {
            let expected = "a folder of masks, named like the photos";
            return Err(Error::input(folder, "the folder of masks", "that of the photos", expected));
        }
        Some(folder) => find_masks_in(folder, &names)?,
        None => find_masks(&[source.join(MASKS_FOLDER)], &names),
    };
    let own_folder = real_path(&out.join(MASKS_FOLDER));
    let is_own = |file: &PathBuf| {
        let file = real_path(file);
        let is_inside = file.starts_with(&own_folder);
        is_inside && old.is_some_and(|old| old.own_masks.contains(&relative_name(&file, &own_folder)))
    };
    let describe = |(name, file): (&str, Option<PathBuf>)| {
        let file = file.filter(|file| !is_own(file))?;
        Some(checksum([&file]).map(|checksum| (name.to_string(), FoundMask { file, checksum })))
    };
    let described: BTreeMap<_, _> =
        names.into_iter().zip(files).filter_map(describe).collect::<Result<_>>()?;
    match masks.filter(|_| described.is_empty()) {
        Some(folder) => {
            let expected = "the masks that they were made of";
            Err(Error::input(folder, "the folder of masks", "one of masks that `capture` wrote", expected))
        }
        None => Ok(described),
    }
}

/// Returns the positions of the photos `found` in `folder`, by their names, that a file [`GEO_FILE`] in the folder or beside it lists.
///
/// # Errors
/// Returns an error if the file violates its format, or lists none of the photos.
pub(crate) fn find_positions(folder: &Path, found: &[FoundPhoto]) -> Result<BTreeMap<String, GeoPosition>> {
    let files = [folder.join(GEO_FILE), parent_of(folder).join(GEO_FILE)];
    let Some(file) = files.into_iter().find(|file| file.is_file()) else { return Ok(BTreeMap::new()) };
    let listed = read_geo_positions(&file)?;
    let position = |photo: &FoundPhoto| {
        let (_, name) = photo.name.rsplit_once('/').unwrap_or(("", &photo.name));
        listed.get(&photo.name).or(listed.get(name)).map(|position| (photo.name.clone(), *position))
    };
    let positions: BTreeMap<_, _> = found.iter().filter_map(position).collect();
    match positions.is_empty() {
        true => {
            Err(Error::input(file, "the list of photos", "without any of the folder's", "names as IMG_1.jpg"))
        }
        false => Ok(positions),
    }
}

/// Copies the photos of `record`, which are in `source`, into the folder `images` of the capture in `out`. On file systems that can share
/// the contents of files, copies take no space. COLMAP reads pixels as they are stored: photos that EXIF says to rotate are written
/// upright, those that aren't JPEGs or PNGs are converted, and those of more than [`MAX_PIXELS`] are reduced. Masks, which are files or
/// the opacity of a converted photo, are written to the folder [`MASKS_FOLDER`] beside `images`, each of the size of its photo. If some
/// photos have masks, all others get a white one, without which COLMAP would leave them out. Returns the photos in the order in which they
/// were found, and those that aren't used.
///
/// # Errors
/// Returns an error if a file can't be written, if a mask can't be read, if a mask would replace one that no call has written, or if
/// `source` is `images` and a photo in it would need another name or other contents.
pub(crate) fn import_photos(
    source: &Path,
    out: &Path,
    images: &Path,
    record: &mut Record,
    reporter: &mut Reporter,
) -> Result<(Vec<Photo>, Vec<SkippedPhoto>)> {
    let found = record.found.clone();
    let all_names: Vec<&str> = found.iter().map(|photo| photo.name.as_str()).collect();
    let (mut photos, mut skipped, mut distinct) = (vec![], vec![], vec![]);
    let mut first_of = HashMap::new();
    for photo in &found {
        let first = *first_of.entry((photo.bytes, photo.checksum)).or_insert(&photo.name);
        if *first == photo.name {
            distinct.push((&photo.name, record.masks.get(&photo.name).map(|mask| mask.file.clone())));
        } else {
            let (name, reason) = (photo.name.clone(), format!("identical to {first}"));
            skipped.push(SkippedPhoto { name, reason });
        }
    }
    let is_in_place = is_same_file(source, images);
    // Where the file system ignores case, another spelling leads to the same folder.
    fs::create_dir_all(images).map_err(Error::write(images))?;
    let ignores_case = is_same_file(images, &images.with_file_name("IMAGES"));
    let (mut names, mut unmasked) = (HashSet::new(), vec![]);
    let (mut done, large) = (skipped.len(), Mutex::new(()));
    // Few photos at a time, for progress and memory.
    for few in distinct.chunks(2 * rayon::current_num_threads()) {
        let inspect = |(name, mask): &(&String, Option<PathBuf>)| {
            inspect(source, name, mask.as_deref(), &all_names, MAX_PIXELS, &large)
        };
        let inspected: Vec<_> = few.par_iter().map(inspect).collect();
        let mut masks = vec![];
        for ((name, mask_file), inspected) in few.iter().zip(inspected) {
            let path = source.join(name);
            let Inspected { mut photo, contents, mask } = match inspected {
                Ok(inspected) => inspected,
                Err(reason) => {
                    skipped.push(SkippedPhoto { name: name.to_string(), reason });
                    continue;
                }
            };
            photo.name = list_name(photo.name, &mut names, ignores_case);
            if is_in_place && (contents.is_some() || photo.name != **name) {
                let found = "one that COLMAP can't read as it is, by its name, format, rotation or size";
                let expected = "an output whose images aren't the photos themselves";
                return Err(Error::input(path, "the photo", found, expected));
            }
            let target = images.join(&photo.name);
            if let Some(contents) = contents {
                write_with_folder(&target, &contents)?;
            } else if !is_in_place {
                copy(&path, &target)?;
            }
            match mask? {
                Some(contents) => masks.push((photo.clone(), contents, mask_file.as_deref())),
                None => unmasked.push(photo.clone()),
            }
            photos.push(photo);
        }
        write_masks(out, record, masks)?;
        done += few.len();
        reporter.report(Progress { step: Step::Photos, done, total: found.len() })?;
    }
    let mask_file = |photo: &Photo| out.join(MASKS_FOLDER).join(mask_name(photo));
    for photo in unmasked.iter().filter(|photo| record.own_masks.remove(&mask_name(photo))) {
        // Another call has written it.
        let file = mask_file(photo);
        match fs::remove_file(&file) {
            Err(why) if why.kind() != ErrorKind::NotFound => return Err(Error::write(&file)(why)),
            _ => {}
        }
    }
    if photos.iter().any(|photo| mask_file(photo).exists()) {
        unmasked.retain(|photo| !mask_file(photo).exists());
        let white = |photo: Photo| {
            let pixels = RgbImage::from_pixel(photo.width, photo.height, Rgb([u8::MAX; 3]));
            Ok((photo, encode_photo(&pixels, false)?, None))
        };
        write_masks(out, record, unmasked.into_iter().map(white).collect::<Result<_>>()?)?;
    }
    Ok((photos, skipped))
}

/// Returns the name of a photo's mask, as COLMAP looks for it.
fn mask_name(photo: &Photo) -> String {
    format!("{}.png", photo.name)
}

/// Writes the masks of photos, given by their contents and by the files that they are made of, to the capture in `out`. The record names
/// them first, so that calls know their own. A file that lies there already as the mask that it is made of stays.
fn write_masks(out: &Path, record: &mut Record, masks: Vec<(Photo, Vec<u8>, Option<&Path>)>) -> Result<()> {
    let mut new = vec![];
    for (photo, contents, file) in masks {
        let name = mask_name(&photo);
        let target = out.join(MASKS_FOLDER).join(&name);
        if file.is_some_and(|file| is_same_file(file, &target)) {
            if read_image_size(&target)? != (photo.width, photo.height) {
                let expected = "one of the size of its photo, or --masks with another folder";
                return Err(Error::input(target, "the mask", "of another size", expected));
            }
        } else if target.exists() && !record.own_masks.contains(&name) {
            let expected = "a capture without masks, or with those that it wrote";
            return Err(Error::input(target, "the mask", "one that no capture wrote", expected));
        } else {
            new.push((name, target, contents));
        }
    }
    let known = record.own_masks.len();
    record.own_masks.extend(new.iter().map(|(name, ..)| name.clone()));
    if record.own_masks.len() > known {
        record.write(out)?;
    }
    new.iter().try_for_each(|(_, target, contents)| write_with_folder(target, contents))
}

/// Returns a name that COLMAP's lists can hold, and that differs from `taken`, to which it is added; `ignores_case` if the file system takes
/// `A.jpg` and `a.jpg` for one. Replaced by `_` are white space, which ends a name there, a `#` at the start, which begins a comment, and a `\`,
/// which COLMAP takes for a `/`.
fn list_name(name: String, taken: &mut HashSet<String>, ignores_case: bool) -> String {
    let mut safe = name.replace(|c: char| c.is_whitespace() || c.is_control() || c == '\\', "_");
    if safe.starts_with('#') {
        safe.replace_range(..1, "_");
    }
    while !taken.insert(if ignores_case { safe.to_lowercase() } else { safe.clone() }) {
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

/// Decodes the photo `name` in `source` and its mask in the file `mask`; returns why it can't be used if it is damaged or shows nothing.
/// Its name is changed to none of `all_names`. Its sides are divided by a whole number if it has more than `max_pixels`; only one such
/// photo is decoded at a time, while `large` is locked.
fn inspect(
    source: &Path,
    name: &str,
    mask: Option<&Path>,
    all_names: &[&str],
    max_pixels: u64,
    large: &Mutex<()>,
) -> Result<Inspected, String> {
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
    let area = f64::from(width) * f64::from(height);
    let divisor = (area / max_pixels as f64).sqrt().ceil().max(1.) as u32;
    let is_reduced = divisor > 1;
    let _alone = is_reduced.then(|| large.lock());
    let mut decoded = decode_upright(&encoded, path).map_err(refuse)?;
    let upright = decoded.pixels.dimensions();
    if is_reduced {
        let (width, height) = (upright.0.div_ceil(divisor), upright.1.div_ceil(divisor));
        decoded.pixels = thumbnail(&decoded.pixels, width, height);
        decoded.alpha = decoded.alpha.map(|alpha| thumbnail(&alpha, width, height));
    }
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
    let is_readable = (is_png || is_jpeg) && !decoded.is_turned && !is_reduced;
    let encode = || match is_png {
        true => encode_photo(&pixels, false),
        false => encode_upright(&pixels, &encoded),
    };
    let contents = (!is_readable).then(encode).transpose().map_err(refuse)?;
    let has_alpha = decoded.alpha.is_some();
    let levels = match (mask, decoded.alpha) {
        // COLMAP compares a mask with its photo pixel by pixel.
        (Some(file), _) => read_upright_mask(file, upright, pixels.dimensions()).map(Some),
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
        focal: exif_focal(&encoded).map(|focal| focal / f64::from(divisor)),
        is_equirectangular: is_equirectangular(&encoded),
        is_reduced,
        has_alpha,
        position: exif_position(&encoded),
    };
    Ok(Inspected { photo, contents, mask })
}

/// Reads the mask `file` at `size` = (width, height). The mask has the size of its `upright` photo, or both sides by one factor.
fn read_upright_mask(file: &Path, upright: (u32, u32), size: (u32, u32)) -> Result<RgbImage> {
    let mask = decode_upright(&fs::read(file).map_err(Error::read(file))?, file)?.pixels;
    let found = mask.dimensions();
    let [(w, h), (width, height)] = [found, upright].map(|(w, h)| (f64::from(w), f64::from(h)));
    // Each side of the mask may be rounded.
    if (w * height - h * width).abs() <= (width + height) / 2. {
        return Ok(fit_mask(mask, size));
    }
    let expected = format!("{}×{} pixels as its upright photo, or both by one factor", upright.0, upright.1);
    Err(Error::input(file, "the mask", format!("{}×{} pixels", found.0, found.1), expected))
}

/// Writes a file, and its folder.
fn write_with_folder(target: &Path, contents: &[u8]) -> Result<()> {
    fs::create_dir_all(parent_of(target)).map_err(Error::write(target))?;
    write_file(target, contents)
}

/// Copies the file `source` to `target`.
fn copy(source: &Path, target: &Path) -> Result<()> {
    fs::create_dir_all(parent_of(target)).map_err(Error::write(target))?;
    // A file that an earlier call left may be a link, and copying would change what it links to.
    let _ = fs::remove_file(target);
    fs::copy(source, target).map(drop).map_err(Error::write(target))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_photos_are_reduced_with_their_masks() {
        let folder = tempfile::tempdir().unwrap();
        let [photo, mask] = ["a.png", "mask.png"].map(|name| folder.path().join(name));
        RgbImage::from_fn(21, 12, |x, _| Rgb([if x < 9 { 0 } else { 200 }; 3])).save(&photo).unwrap();
        RgbImage::from_pixel(42, 24, Rgb([255; 3])).save(&mask).unwrap();
        for (max_pixels, size) in [(252, (21, 12)), (251, (11, 6)), (62, (7, 4))] {
            let inspected = inspect(folder.path(), "a.png", Some(&mask), &[], max_pixels, &Mutex::new(()));
            let Inspected { photo, contents, mask } = inspected.unwrap();
            let is_reduced = size.0 < 21;
            assert_eq!((photo.width, photo.height, photo.is_reduced), (size.0, size.1, is_reduced));
            assert_eq!(contents.is_some(), is_reduced);
            for encoded in contents.iter().chain(&mask.unwrap()) {
                assert_eq!(image::load_from_memory(encoded).unwrap().into_rgb8().dimensions(), size);
            }
        }
    }
}
