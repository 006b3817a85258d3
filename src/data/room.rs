//! Procedural rooms, rendered by this crate's rasterizer, as captures on disk.

use super::gaussian_room::Room;
use crate::error::{Error, Result};
use crate::io::{lock_parent, replace_dir, write_png, write_splat};
use crate::render::render_views;
use crate::scene::ImageSize;
use glam::DVec3;
use globalsplat_capture::write_cameras_json;
use std::path::Path;

const PHOTOS: &str = "images";
const TRUTH: &str = "truth.ply";
/// All entries of a room's folder.
const FILES: [&str; 3] = ["cameras.json", TRUTH, PHOTOS];

/// Writes one capture at `path`: `cameras.json`, `images/`, and the room itself as `ground_truth.ply`. An existing room is replaced.
///
/// # Errors
/// Fails if anything other than a room exists at `path`, or if a file can't be written.
pub fn write_room(path: &Path, seed: u64, frames: usize, size: ImageSize) -> Result<()> {
    check_free(path)?;
    let Room { gaussians, cameras } = Room::new(seed, frames, size);
    let rendered = render_views(&gaussians, &cameras)?;
    let names: Vec<String> = (0..frames).map(|i| format!("{PHOTOS}/{}", photo_name(i))).collect();
    replace_dir(path, &FILES, |folder| {
        let images = folder.join(PHOTOS);
        std::fs::create_dir(&images).map_err(Error::write(&images))?;
        for (name, view) in names.iter().zip(&rendered) {
            write_png(&folder.join(name), &view.rgb)?;
        }
        write_splat(&folder.join(TRUTH), &gaussians.to_splat(DVec3::ZERO)?)?;
        Ok(write_cameras_json(&folder.join("cameras.json"), &names, &cameras)?)
    })
}

fn photo_name(index: usize) -> String {
    format!("{index:03}.png")
}

/// Checks that `path` doesn't exist, or contains a room and nothing else.
fn check_free(path: &Path) -> Result<()> {
    let _swapping = lock_parent(path);
    if !path.exists() {
        return Ok(());
    }
    let names = |folder: &Path| -> Result<Vec<String>> {
        let entries = std::fs::read_dir(folder).map_err(Error::read(folder))?;
        let name = |entry: std::io::Result<std::fs::DirEntry>| {
            Ok(entry.map_err(Error::read(folder))?.file_name().to_string_lossy().into_owned())
        };
        entries.map(name).collect()
    };
    let refuse = |found: String| {
        Err(Error::input(path, "the output", found, "a name that is free, or a room made before"))
    };
    if !path.is_dir() {
        return refuse("a file".into());
    }
    let (found, photos) = (names(path)?, path.join(PHOTOS));
    if let Some(other) = found.iter().find(|name| !FILES.contains(&name.as_str())) {
        return refuse(format!("a folder with {other} in it"));
    }
    if !found.is_empty() && !found.iter().any(|name| name == TRUTH) {
        return refuse(format!("a capture without {TRUTH}"));
    }
    let is_ours = |name: &&String| {
        let index = name.strip_suffix(".png").and_then(|index| index.parse().ok());
        index.is_some_and(|index| **name == photo_name(index))
    };
    match photos.is_dir().then(|| names(&photos)).transpose()?.iter().flatten().find(|name| !is_ours(name)) {
        Some(other) => refuse(format!("a folder with {PHOTOS}/{other} in it")),
        None => Ok(()),
    }
}
