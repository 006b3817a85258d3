//! Raw data of Polycam (spec 10.4): `keyframes/cameras/NAME.json` has the pose and the intrinsics of `keyframes/images/NAME.jpg`. The first
//! three rows of the camera-to-world matrix, with OpenGL axes, are `t_00` to `t_23`. `corrected_cameras` are preferred, with
//! `corrected_images` if there are such.

use super::transforms_json::{describe_value, from_opengl};
use super::{CaptureOpener, folder_name, read_json};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose, check_cameras};
use crate::geometry::{Camera, Intrinsics};
use crate::photos::{find_photos, natural_order};
use globalsplat_files::{Error, Result, parent_of};
use serde_json::Value;
use std::io;
use std::iter::once;
use std::path::{Path, PathBuf};
use std::slice;

/// Folder of the photos and their cameras.
const KEYFRAMES: &str = "keyframes";

/// Recognizes a folder with [`KEYFRAMES`], or these.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let keyframes = if path.ends_with(KEYFRAMES) { path.to_owned() } else { path.join(KEYFRAMES) };
    let [corrected, original] = ["corrected_cameras", "cameras"].map(|name| keyframes.join(name));
    let (cameras, names) =
        match original.is_dir() && cameras_in(&corrected).is_ok_and(|files| files.is_empty()) {
            false if corrected.is_dir() => (corrected, ["corrected_images", "images"]),
            _ if original.is_dir() => (original, ["images", "corrected_images"]),
            _ => return None,
        };
    let [first, second] = names.map(|name| keyframes.join(name));
    let images = if second.is_dir() && !first.is_dir() { second } else { first };
    Some(Box::new(move |purpose| read(&keyframes, &cameras, images, purpose)))
}

/// Returns the files in the folder `cameras`, ordered by name, with numbers in names compared by value.
fn cameras_in(cameras: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(cameras)?.flatten().map(|entry| entry.path()).collect();
    let is_hidden =
        |file: &PathBuf| file.file_name().unwrap_or_default().as_encoded_bytes().starts_with(b".");
    files.retain(|file| file.extension().is_some_and(|extension| extension == "json") && !is_hidden(file));
    files.sort_by(natural_order);
    Ok(files)
}

/// Returns `true` if raw data of Polycam are in the folder `path`.
pub fn is_polycam(path: &Path) -> bool {
    find(path).is_some()
}

/// Reads the files in the folder `cameras` in their order. Frames with a missing photo are left out.
fn read(keyframes: &Path, cameras: &Path, images: PathBuf, purpose: Purpose) -> Result<Capture> {
    let files = cameras_in(cameras).map_err(Error::read(cameras))?;
    let stem = |file: &PathBuf| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let names: Vec<String> = files.iter().map(stem).collect();
    let photos = find_photos(slice::from_ref(&images), &names);
    let (mut frames, mut changes) = (vec![], Changes::default());
    for ((file, name), photo) in files.iter().zip(names).zip(photos) {
        let declared = images.join(format!("{name}.jpg"));
        let Some(photo) = changes.photo(&name, photo, purpose, declared) else { continue };
        let name = photo.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let camera = read_camera(file)?;
        let camera = Camera { c2w: changes.remove_scale(&name, camera.c2w), ..camera };
        check_cameras(file, once(&camera))?;
        frames.push(Frame::pinhole(ImageLocation::File(photo), name, camera));
    }
    Capture::new(folder_name(parent_of(keyframes)), cameras.to_owned(), frames, changes, purpose)
}

fn read_camera(file: &Path) -> Result<Camera> {
    let json: Value = read_json(
        file,
        "no JSON",
        "{\"t_00\", …, \"t_23\", \"fx\", \"fy\", \"cx\", \"cy\", \"width\", \"height\"}",
    )?;
    let get = |key: &str, expected: &str, is_valid: fn(f64) -> bool| {
        let value = json.get(key);
        let number = value.and_then(Value::as_f64).filter(|number| is_valid(*number));
        number.ok_or_else(|| Error::input(file, key, describe_value(value), expected))
    };
    let number = |key: &str| get(key, "a number", |_| true);
    let side = |key: &str| {
        let side = get(key, "a number of pixels", |side| side.fract() == 0. && (1. ..4e9).contains(&side));
        side.map(|side| side as u32)
    };
    let mut entries = [0.; 16];
    for (i, entry) in entries[..12].iter_mut().enumerate() {
        *entry = number(&format!("t_{}{}", i / 4, i % 4))?;
    }
    entries[15] = 1.;
    let intrinsics =
        Intrinsics { fx: number("fx")?, fy: number("fy")?, cx: number("cx")?, cy: number("cy")? };
    Ok(Camera { intrinsics, c2w: from_opengl(&entries), width: side("width")?, height: side("height")? })
}
