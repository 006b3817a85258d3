//! Tests of captures: formats, lenses, photos and masks.

mod formats;
mod lenses;
mod masks;
mod photo_folders;
mod photos;

use globalsplat_capture::{Capture, Result, open_capture};
use globalsplat_test_kit::formats::{HEIGHT, WIDTH, cameras, in_images, names, transforms};
use image::{Rgb, RgbImage};
use serde_json::Value;
use std::path::{MAIN_SEPARATOR_STR, Path};
use tempfile::TempDir;

/// Writes photos called `names`, whose pixels differ from photo to photo.
fn write_photos(folder: &Path, names: &[String]) {
    for (i, name) in names.iter().enumerate() {
        let photo = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb([x as u8 * 9, y as u8 * 12, (40 * i) as u8]));
        let file = folder.join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        photo.save(file).unwrap();
    }
}

/// Returns a folder with photos in `images` and no description of them.
fn photos_alone() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_photos(&folder.path().join("images"), &names());
    folder
}

/// Writes a `transforms.json` of [`cameras`] in `folder`, after `change` of its contents, and opens it.
fn open_transforms(folder: &Path, change: impl FnOnce(&mut Value)) -> Result<Capture> {
    let mut contents = transforms(&in_images(&names()), &cameras());
    change(&mut contents);
    let file = folder.join("transforms.json");
    std::fs::write(&file, contents.to_string()).unwrap();
    open_capture(&file)
}

/// Asserts that `result` is an error whose message contains all of `parts`.
#[track_caller]
fn assert_refused<T>(result: Result<T>, parts: &[&str]) {
    let error = result.err().expect("an error").to_string().replace(MAIN_SEPARATOR_STR, "/");
    parts.iter().for_each(|part| assert!(error.contains(part), "{part:?} is not in: {error}"));
}

/// Asserts that `capture` has exactly one warning, of one line, and that it contains all of `parts`.
#[track_caller]
fn assert_warns(capture: &Capture, parts: &[&str]) {
    let [line] = capture.warnings() else { panic!("{:?}", capture.warnings()) };
    let line = line.replace(MAIN_SEPARATOR_STR, "/");
    parts.iter().for_each(|part| assert!(line.contains(part), "{part:?} is not in: {line}"));
    assert!(!line.contains('\n'), "{line}");
}
