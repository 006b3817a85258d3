//! Procedural rooms, photographed by our own rasterizer, as captures on disk.

use super::formats::write_cameras_json;
use crate::error::{Error, Result};
use crate::io::{Splat, replace_dir, write_png, write_splat};
use crate::render::render_views;
use crate::scene::ImageSize;
use crate::synth::Room;
use std::path::Path;

/// Writes one capture at `path`: `cameras.json`, `images/`, and the room itself as `truth.ply`.
///
/// # Errors
/// The system's refusal to write.
pub fn write_room(path: &Path, seed: u64, frames: usize, size: ImageSize) -> Result<()> {
    let Room { gaussians, cameras } = Room::new(seed, frames, size);
    let rendered = render_views(&gaussians, &cameras)?;
    let names: Vec<String> = (0..frames).map(|i| format!("images/{i:03}.png")).collect();
    replace_dir(path, |folder| {
        let images = folder.join("images");
        std::fs::create_dir(&images).map_err(Error::write(&images))?;
        for (name, view) in names.iter().zip(&rendered) {
            write_png(&folder.join(name), &view.rgb)?;
        }
        write_splat(&folder.join("truth.ply"), &Splat::of(&gaussians)?)?;
        write_cameras_json(&folder.join("cameras.json"), &names, &cameras)
    })
}
