//! Captures of LLFF (spec 10.4): `poses_bounds.npy` [photos, 17] has a row for each photo in `images` by the order of their names: a matrix
//! [3, 5] of the camera's axes down, right and back, its center, and (height, width, focal length) in pixels, then the nearest and the
//! farthest depth.

use super::{CaptureOpener, file_in, folder_name};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose, check_cameras};
use crate::geometry::{Camera, Intrinsics};
use crate::npy::read_npy;
use crate::photos::{MASKS_FOLDER, find_masks, list_photos};
use glam::{DMat4, DVec3};
use globalsplat_files::{Error, Result, parent_of};
use std::ffi::OsStr;
use std::iter::once;
use std::path::{Path, PathBuf};

const POSES: &str = "poses_bounds.npy";
/// Folder of the photos, or `images_N` of photos that are 1/N as large.
const PHOTOS: &str = "images";
/// Numbers of a photo: the matrix, row by row, and the bounds.
const NUMBERS: usize = 3 * 5 + 2;

/// Recognizes a folder with [`POSES`], or this file.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let file = if path.ends_with(POSES) { path.to_owned() } else { file_in(path, POSES)? };
    Some(Box::new(move |purpose| read(&file, purpose)))
}

fn read(file: &Path, purpose: Purpose) -> Result<Capture> {
    let (shape, numbers) = read_npy(file)?;
    let [count, NUMBERS] = shape[..] else {
        let expected = format!("[photos, {NUMBERS}]");
        return Err(Error::input(file, "the shape", format!("{shape:?}"), expected));
    };
    let folder = parent_of(file);
    let (photos, masks) = match purpose {
        Purpose::Photos => photos_and_masks(folder)?,
        Purpose::Cameras(_) => {
            ((0..count).map(|i| PathBuf::from(i.to_string())).collect(), vec![None; count])
        }
    };
    if photos.len() != count {
        let expected = format!("{}, as many as there are photos", photos.len());
        return Err(Error::input(file, "the number of poses", count, expected));
    }
    let (mut frames, mut changes) = (vec![], Changes::default());
    for ((photo, mask), numbers) in photos.into_iter().zip(masks).zip(numbers.chunks_exact(NUMBERS)) {
        let name = photo.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let camera = parse_camera(numbers);
        if camera.width == 0 || camera.height == 0 {
            let (field, found) =
                (format!("the size of view {}", frames.len()), format!("{:?}", [numbers[4], numbers[9]]));
            return Err(Error::input(file, field, found, "a height and width in pixels"));
        }
        let camera = Camera { c2w: changes.remove_scale(&name, camera.c2w), ..camera };
        check_cameras(file, once(&camera))?;
        frames.push(Frame { mask, ..Frame::pinhole(ImageLocation::File(photo), name, camera) });
    }
    Capture::new(folder_name(folder), file.to_owned(), frames, changes, purpose)
}

/// Returns the photos by the order of their names, as Python sorts them, and their masks: in `masks`, or `NAME_mask` beside the photo.
fn photos_and_masks(folder: &Path) -> Result<(Vec<PathBuf>, Vec<Option<PathBuf>>)> {
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_os_string();
    let factor = |path: &PathBuf| {
        let rest = path.file_name()?.to_str()?.strip_prefix(PHOTOS)?;
        if rest.is_empty() { Some(1) } else { rest.strip_prefix('_')?.parse().ok() }
    };
    let entries = std::fs::read_dir(folder).map_err(Error::read(folder))?.flatten().map(|entry| entry.path());
    let folders = entries.filter(|path| path.is_dir()).filter_map(|path| Some((factor(&path)?, path)));
    let Some((_, images)) = folders.min() else {
        return Err(Error::input(folder, "the folder", "without photos", "images, or images_4 and the like"));
    };
    let mut photos = list_photos(&images)?.photos;
    photos.sort_by_key(name);
    let stem = |path: &PathBuf| path.file_stem().and_then(OsStr::to_str).unwrap_or_default().to_owned();
    let stems: Vec<String> = photos.iter().map(stem).collect();
    let is_mask = |photo: &PathBuf| {
        stem(photo).strip_suffix("_mask").is_some_and(|masked| stems.iter().any(|stem| stem == masked))
    };
    let (masks, photos): (Vec<_>, Vec<_>) = photos.into_iter().partition(is_mask);
    let names: Vec<_> = photos.iter().map(|photo| name(photo).to_string_lossy().into_owned()).collect();
    let own = find_masks(&[folder.join(MASKS_FOLDER)], &names);
    let beside = |photo: &PathBuf| {
        let wanted = format!("{}_mask", stem(photo));
        masks.iter().find(|mask| stem(mask) == wanted).cloned()
    };
    let masks = photos.iter().zip(own).map(|(photo, own)| own.or_else(|| beside(photo))).collect();
    Ok((photos, masks))
}

/// Returns the camera that the numbers of a photo describe, with OpenCV axes.
fn parse_camera(numbers: &[f64]) -> Camera {
    let column = |index: usize| DVec3::new(numbers[index], numbers[5 + index], numbers[10 + index]);
    let [down, right, back, center, size] = [0, 1, 2, 3, 4].map(column);
    let c2w = DMat4::from_cols(right.extend(0.), down.extend(0.), -back.extend(0.), center.extend(1.));
    let [height, width, focal] = size.to_array();
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: width / 2., cy: height / 2. };
    Camera { intrinsics, c2w, width: width as u32, height: height as u32 }
}
