//! Photos of a folder, checked and brought into a capture's folder of images.

use globalsplat_capture::{
    MASKS_FOLDER, decode_photo, encode_photo, exif_focal, find_masks, find_masks_in, grey_to_rgb,
    is_equirectangular, list_photos, read_image_size, read_mask,
};
use globalsplat_files::{Error, Result, checksum, parent_of, write_atomically};
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
    Ok((found, list.warning()))
}

/// Photos of a folder after [`import_photos`].
#[derive(Debug, Default)]
pub(crate) struct ImportedPhotos {
    /// Photos in the folder of images, in the order in which they were found.
    pub photos: Vec<Photo>,
    /// Photos that are damaged, show nothing, or are identical to another.
    pub skipped: Vec<SkippedPhoto>,
}

/// Brings the photos `found` in `source` into the folder `images`, by a hard link where the file system allows it. COLMAP
/// reads pixels as they are stored: photos that EXIF says to rotate are written upright, and those that aren't JPEGs or PNGs are
/// converted. Masks, which are files in `masks` or the opacity of a converted photo, are written to the folder [`MASKS_FOLDER`] beside `images`,
/// each of the size of its photo. Returns `None` if `on_photo`, which gets the number of photos that were looked at, returns `false`.
///
/// # Errors
/// Returns an error if a file can't be written, if a mask can't be read, if `masks` is given and has none for any photo, or if `source` is
/// `images` and a photo in it would need another name or other contents.
pub(crate) fn import_photos(
    source: &Path,
    found: &[FoundPhoto],
    masks: Option<&Path>,
    images: &Path,
    on_photo: &mut dyn FnMut(usize) -> bool,
) -> Result<Option<ImportedPhotos>> {
    let mut imported = ImportedPhotos::default();
    let mut first_of = HashMap::new();
    let mut distinct = vec![];
    for photo in found {
        let first = *first_of.entry((photo.bytes, photo.checksum)).or_insert(&photo.name);
        if *first == photo.name {
            distinct.push(photo);
        } else {
            let reason = format!("identical to {first}");
            imported.skipped.push(SkippedPhoto { name: photo.name.clone(), reason });
        }
    }
    let is_in_place =
        source.canonicalize().is_ok_and(|source| images.canonicalize().is_ok_and(|images| images == source));
    let all_names: HashSet<&str> = found.iter().map(|photo| photo.name.as_str()).collect();
    let mask_files = find_mask_files(source, found, masks)?;
    let mut names = HashSet::new();
    let mut done = imported.skipped.len();
    // Few photos at a time, for progress and memory.
    for few in distinct.chunks(2 * rayon::current_num_threads()) {
        let mask_of = |photo: &FoundPhoto| mask_files.get(photo.name.as_str()).map(PathBuf::as_path);
        let read = |photo: &&FoundPhoto| inspect(&source.join(&photo.name), mask_of(photo));
        let read: Vec<_> = few.par_iter().map(read).collect();
        for (photo, inspected) in few.iter().zip(read) {
            match inspected {
                Ok(inspected) => {
                    let path = source.join(&photo.name);
                    let name = match inspected.is_converted {
                        true => converted_name(&photo.name, &all_names),
                        false => photo.name.clone(),
                    };
                    let name = list_name(&name, &mut names);
                    if !is_in_place {
                        place(&path, inspected.contents, &images.join(&name))?;
                    } else if inspected.contents.is_some() || name != photo.name {
                        let found = "one that COLMAP can't read as it is, by its name, format or rotation";
                        let expected = "an output whose images aren't the photos themselves";
                        return Err(Error::input(path, "the photo", found, expected));
                    }
                    let target = images.with_file_name(MASKS_FOLDER).join(format!("{name}.png"));
                    match inspected.mask? {
                        Some(mask) => place(&path, Some(mask), &target)?,
                        // A run with other masks may have left one.
                        None if !is_in_place => drop(fs::remove_file(target)),
                        None => {}
                    }
                    imported.photos.push(Photo {
                        name,
                        width: inspected.width,
                        height: inspected.height,
                        focal: exif_focal(&path),
                        is_equirectangular: is_equirectangular(&path),
                    });
                }
                Err(reason) => imported.skipped.push(SkippedPhoto { name: photo.name.clone(), reason }),
            }
        }
        done += few.len();
        if !on_photo(done) {
            return Ok(None);
        }
    }
    Ok(Some(imported))
}

/// Returns the name of the JPEG that the photo `name` is converted to: with another extension, or with one more if that is the name of
/// another photo.
fn converted_name(name: &str, all_names: &HashSet<&str>) -> String {
    let other = Path::new(name).with_extension("jpg").to_string_lossy().into_owned();
    if all_names.contains(other.as_str()) { format!("{name}.jpg") } else { other }
}

/// Returns the masks of the photos `found`, by the photo's name: those in `masks`, or in the folder [`MASKS_FOLDER`] of `source`.
fn find_mask_files<'a>(
    source: &Path,
    found: &'a [FoundPhoto],
    masks: Option<&Path>,
) -> Result<HashMap<&'a str, PathBuf>> {
    let names: Vec<&str> = found.iter().map(|photo| photo.name.as_str()).collect();
    let files = match masks {
        Some(folder) => find_masks_in(folder, &names)?,
        None => find_masks(&[source.join(MASKS_FOLDER)], &names),
    };
    Ok(names.into_iter().zip(files).filter_map(|(name, file)| Some((name, file?))).collect())
}

/// Returns a name that COLMAP's lists can hold, and that differs from `taken`, to which it is added.
fn list_name(name: &str, taken: &mut HashSet<String>) -> String {
    let is_separator = |c: char| c.is_whitespace() || c.is_control();
    let mut safe: String = name.chars().map(|c| if is_separator(c) { '_' } else { c }).collect();
    while !taken.insert(safe.clone()) {
        let (folder, file) =
            safe.rsplit_once('/').map_or(("", safe.as_str()), |(folder, file)| (folder, file));
        safe = if folder.is_empty() { format!("_{file}") } else { format!("{folder}/_{file}") };
    }
    safe
}

/// A photo that was decoded.
struct Inspected {
    /// Width of the upright pixels.
    width: u32,
    /// Height of the upright pixels.
    height: u32,
    /// Contents of a file that COLMAP reads, if the photo's own isn't one.
    contents: Option<Vec<u8>>,
    /// `true` if the contents are a JPEG, and the file has another extension.
    is_converted: bool,
    /// PNG of the photo's mask, or of its opacity, if it has one and `contents` lacks it.
    mask: Result<Option<Vec<u8>>>,
}

/// Decodes the photo at `path` and its mask in the file `mask`; returns why it can't be used if it is damaged or shows nothing.
fn inspect(path: &Path, mask: Option<&Path>) -> Result<Inspected, String> {
    let refuse = |why: Error| match why {
        Error::Input { found, .. } => found,
        other => other.to_string(),
    };
    let encoded =
        fs::read(path).map_err(|why| match path.to_string_lossy().contains(char::REPLACEMENT_CHARACTER) {
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
    let has_extension = |known: &[&str]| {
        path.extension()
            .is_some_and(|extension| known.iter().any(|known| extension.eq_ignore_ascii_case(known)))
    };
    let is_png = decoded.is_png && has_extension(&["png"]);
    let is_jpeg = decoded.is_jpeg && has_extension(&["jpg", "jpeg"]);
    let is_rotated = pixels.dimensions() != (width, height);
    let is_readable = (is_png || is_jpeg) && !is_rotated;
    let contents = (!is_readable).then(|| encode_photo(&pixels, !is_png)).transpose().map_err(refuse)?;
    let levels = match (mask, decoded.alpha) {
        // COLMAP compares a mask with its photo pixel by pixel.
        (Some(file), _) => check_aspect(file, pixels.dimensions())
            .and_then(|()| read_mask(file, pixels.dimensions()))
            .map(Some),
        (None, Some(alpha)) if !is_readable => Ok(Some(grey_to_rgb(&alpha))),
        (None, _) => Ok(None),
    };
    let mask = levels.and_then(|levels| levels.map(|levels| encode_photo(&levels, false)).transpose());
    Ok(Inspected {
        width: pixels.width(),
        height: pixels.height(),
        contents,
        is_converted: !is_png && !is_jpeg,
        mask,
    })
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

/// Writes `contents` to `target`, or links `target` to the file `source`, copying it if it can't be linked.
fn place(source: &Path, contents: Option<Vec<u8>>, target: &Path) -> Result<()> {
    let source = source.canonicalize().map_err(Error::read(source))?;
    let folder = parent_of(target);
    fs::create_dir_all(folder).map_err(Error::write(folder))?;
    if let Some(contents) = contents {
        return write_atomically(target, |writer| writer.write_all(&contents).map_err(Error::write(target)));
    }
    // A link that an earlier run left may be to another file.
    let _ = fs::remove_file(target);
    if fs::hard_link(&source, target).is_err() {
        fs::copy(&source, target).map_err(Error::write(target))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageFormat, Rgb, RgbImage, Rgba, RgbaImage};

    fn write_photo(path: &Path, seed: u8) {
        let photo = RgbImage::from_fn(16, 8, |x, y| image::Rgb([x as u8 * 9, y as u8 * 9, seed]));
        photo.save_with_format(path, ImageFormat::Png).unwrap();
    }

    fn import(source: &Path, images: &Path) -> ImportedPhotos {
        import_photos(source, &find_photos(source).unwrap().0, None, images, &mut |_| true).unwrap().unwrap()
    }

    #[test]
    fn useless_photos_are_skipped_and_named() {
        let folder = tempfile::tempdir().unwrap();
        let (source, images) = (folder.path().join("photos"), folder.path().join("images"));
        fs::create_dir_all(source.join("b")).unwrap();
        write_photo(&source.join("a 1.png"), 1);
        write_photo(&source.join("a_1.png"), 2);
        write_photo(&source.join("b/2.png"), 3);
        fs::copy(source.join("b/2.png"), source.join("b/3.png")).unwrap();
        RgbImage::from_pixel(16, 8, image::Rgb([3, 3, 3])).save(source.join("black.png")).unwrap();
        fs::write(source.join("cut.png"), &fs::read(source.join("a 1.png")).unwrap()[..60]).unwrap();
        fs::write(source.join("notes.txt"), "no photo").unwrap();
        fs::write(source.join(".hidden.png"), "no photo").unwrap();
        let ImportedPhotos { photos, skipped } = import(&source, &images);
        let names: Vec<&str> = photos.iter().map(|photo| photo.name.as_str()).collect();
        assert_eq!(names, ["a_1.png", "_a_1.png", "b/2.png"]);
        assert_eq!((photos[0].width, photos[0].height), (16, 8));
        assert_eq!(fs::read(images.join("_a_1.png")).unwrap(), fs::read(source.join("a_1.png")).unwrap());
        let skipped: Vec<_> =
            skipped.iter().map(|photo| (photo.name.as_str(), photo.reason.as_str())).collect();
        assert_eq!(skipped[..2], [("b/3.png", "identical to b/2.png"), ("black.png", "of a single color")]);
        assert_eq!((skipped.len(), skipped[2].0), (3, "cut.png"));
        assert!(skipped[2].1.starts_with("undecodable ("), "{}", skipped[2].1);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn photos_named_in_another_encoding_are_skipped() {
        use std::os::unix::ffi::OsStrExt;
        let folder = tempfile::tempdir().unwrap();
        let (source, images) = (folder.path().join("photos"), folder.path().join("images"));
        fs::create_dir_all(&source).unwrap();
        write_photo(&source.join("é.png"), 1);
        write_photo(&source.join(std::ffi::OsStr::from_bytes(b"\xe9.png")), 2);
        let ImportedPhotos { photos, skipped } = import(&source, &images);
        assert_eq!((photos.len(), photos[0].name.as_str()), (1, "é.png"));
        assert_eq!((skipped.len(), skipped[0].reason.as_str()), (1, "named in another encoding than UTF-8"));
    }

    #[test]
    fn photos_that_colmap_may_not_read_are_converted_with_their_opacity() {
        let folder = tempfile::tempdir().unwrap();
        let (source, images) = (folder.path().join("photos"), folder.path().join("images"));
        fs::create_dir_all(&source).unwrap();
        let photo = RgbaImage::from_fn(16, 8, |x, y| {
            Rgba([x as u8 * 15, y as u8 * 30, 90, if x < 8 { 0 } else { 255 }])
        });
        photo.save_with_format(source.join("a.webp"), ImageFormat::WebP).unwrap();
        write_photo(&source.join("a.png"), 1);
        // The contents of a PNG under another extension.
        write_photo(&source.join("b.jpg"), 2);
        // A mask of half the photo's size.
        let masks = source.join("masks");
        fs::create_dir_all(&masks).unwrap();
        RgbImage::from_fn(8, 4, |x, _| Rgb([if x < 4 { 255 } else { 0 }; 3]))
            .save(masks.join("b.png"))
            .unwrap();
        let ImportedPhotos { photos, skipped } = import(&source, &images);
        assert!(skipped.is_empty(), "{skipped:?}");
        let names: Vec<&str> = photos.iter().map(|photo| photo.name.as_str()).collect();
        assert_eq!(names, ["a.png", "a.jpg", "b.jpg.jpg"]);
        let mask = globalsplat_capture::read_image(&folder.path().join("masks/a.jpg.png")).unwrap();
        assert!(mask.enumerate_pixels().all(|(x, _, level)| level[0] == if x < 8 { 0 } else { 255 }));
        let converted = globalsplat_capture::read_image(&images.join("a.jpg")).unwrap();
        let mask = globalsplat_capture::read_image(&folder.path().join("masks/b.jpg.jpg.png")).unwrap();
        assert_eq!((mask.dimensions(), mask.get_pixel(2, 2)[0], mask.get_pixel(13, 5)[0]), ((16, 8), 255, 0));
        assert!(converted.get_pixel(12, 4)[0].abs_diff(180) < 12, "{:?}", converted.get_pixel(12, 4));
    }

    #[test]
    fn masks_of_another_folder_replace_those_of_an_earlier_run() {
        let folder = tempfile::tempdir().unwrap();
        let [source, images, masks] = ["photos", "out/images", "other"].map(|name| folder.path().join(name));
        let import = |masks| import_photos(&source, &find_photos(&source)?.0, masks, &images, &mut |_| true);
        fs::create_dir_all(source.join("masks")).unwrap();
        fs::create_dir_all(&masks).unwrap();
        write_photo(&source.join("a.png"), 1);
        write_photo(&source.join("b.png"), 2);
        write_photo(&source.join("masks/a.png"), 3);
        import(None).unwrap();
        let written = |name: &str| folder.path().join("out/masks").join(name).exists();
        assert_eq!(["a.png.png", "b.png.png"].map(written), [true, false]);
        let error = import(Some(&masks)).unwrap_err().to_string();
        assert!(
            error.ends_with("other: the folder is without a mask for any photo, expected a.png.png"),
            "{error}"
        );
        write_photo(&masks.join("b.png.png"), 2);
        import(Some(&masks)).unwrap();
        assert_eq!(["a.png.png", "b.png.png"].map(written), [false, true]);
        RgbImage::new(8, 16).save(masks.join("b.png.png")).unwrap();
        let error = import(Some(&masks)).unwrap_err().to_string();
        assert!(error.contains("the mask is 8×16 pixels, expected 16×8 pixels"), "{error}");
        fs::write(masks.join("b.png.png"), "no image").unwrap();
        let error = import(Some(&masks)).unwrap_err().to_string();
        assert!(error.contains("b.png.png: the image"), "{error}");
    }

    #[test]
    fn photos_in_the_folder_of_images_are_left_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let images = folder.path().join("images");
        fs::create_dir_all(&images).unwrap();
        write_photo(&images.join("a_1.png"), 1);
        write_photo(&images.join("b.png"), 2);
        let before = fs::read(images.join("a_1.png")).unwrap();
        assert_eq!(import(&images, &images).photos.len(), 2);
        write_photo(&images.join("a 1.png"), 3);
        let error = import_photos(&images, &find_photos(&images).unwrap().0, None, &images, &mut |_| true)
            .unwrap_err();
        assert!(error.to_string().contains("a 1.png: the photo is one that COLMAP can't read"), "{error}");
        assert_eq!(fs::read(images.join("a_1.png")).unwrap(), before);
        assert_eq!(fs::read_dir(&images).unwrap().count(), 3);
    }

    #[test]
    fn rotated_photos_are_written_upright() {
        // EXIF with one entry: orientation (0x0112), a SHORT, is 6, a clockwise turn by 90°.
        let exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
        let folder = tempfile::tempdir().unwrap();
        let (source, images) = (folder.path().join("photos"), folder.path().join("images"));
        fs::create_dir_all(&source).unwrap();
        let photo = RgbImage::from_fn(16, 8, |x, _| image::Rgb([if x < 8 { 0 } else { 250 }; 3]));
        let jpeg = encode_photo(&photo, true).unwrap();
        let length = (exif.len() as u16 + 2).to_be_bytes();
        let rotated = [&jpeg[..2], &[0xff, 0xe1], &length, exif, &jpeg[2..]].concat();
        fs::write(source.join("a.jpg"), rotated).unwrap();
        let ImportedPhotos { photos, skipped } = import(&source, &images);
        assert!(skipped.is_empty(), "{skipped:?}");
        assert_eq!((photos[0].width, photos[0].height), (8, 16));
        let upright = globalsplat_capture::read_image(&images.join("a.jpg")).unwrap();
        assert_eq!(upright.dimensions(), (8, 16));
        assert!(upright.get_pixel(4, 2).0[0] < 50 && upright.get_pixel(4, 13).0[0] > 200);
    }
}
