//! Raw data of Polycam (spec 10.4): `keyframes/cameras/NAME.json` has the pose and the intrinsics of `keyframes/images/NAME.jpg`. The first three
//! rows of the camera-to-world matrix, with OpenGL axes, are `t_00` to `t_23`. `corrected_cameras` and `corrected_images` are preferred.

use super::transforms_json::{describe_value, from_opengl};
use super::{CaptureOpener, folder_name, read_json};
use crate::capture::{Capture, Changes, Frame, ImageLocation, Purpose, check_cameras};
use crate::geometry::{Camera, Intrinsics};
use crate::photos::{find_photos, natural_order};
use globalsplat_files::{Error, Result, parent_of};
use serde_json::Value;
use std::iter::once;
use std::path::{Path, PathBuf};
use std::slice;

/// Folder of the photos and their cameras.
const KEYFRAMES: &str = "keyframes";

/// Recognizes a folder with [`KEYFRAMES`], or these.
pub(crate) fn find(path: &Path) -> Option<CaptureOpener> {
    let keyframes = if path.ends_with(KEYFRAMES) { path.to_owned() } else { path.join(KEYFRAMES) };
    let kinds = ["corrected_", ""].into_iter();
    let mut folders =
        kinds.map(|kind| ["cameras", "images"].map(|name| keyframes.join(format!("{kind}{name}"))));
    let [cameras, images] = folders.find(|[cameras, _]| cameras.is_dir())?;
    Some(Box::new(move |purpose| read(&keyframes, &cameras, images, purpose)))
}

/// Returns `true` if raw data of Polycam are in the folder `path`.
pub fn is_polycam(path: &Path) -> bool {
    find(path).is_some()
}

/// Reads the files in the folder `cameras`, ordered by name, with numbers in names compared by value. Frames with a missing photo are left out.
fn read(keyframes: &Path, cameras: &Path, images: PathBuf, purpose: Purpose) -> Result<Capture> {
    let entries = std::fs::read_dir(cameras).map_err(Error::read(cameras))?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "json"));
    files.sort_by(natural_order);
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
