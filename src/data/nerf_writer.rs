//! Writes a capture in the layout of NeRF's synthetic scenes, which most other programs read.

use super::write_unless_other;
use crate::error::{Error, Result};
use globalsplat_capture::{Capture, write_transforms_json};
use std::path::Path;

/// Writes the views of `capture` as PNGs to `folder`: the first `train` of them to `train`, with `transforms_train.json`, and the others to
/// `test`, with `transforms_test.json`.
///
/// # Errors
/// Fails if a view can't be read, or if a file can't be written or exists with other contents.
pub(crate) fn write_nerf_capture(folder: &Path, capture: &Capture, train: usize) -> Result<()> {
    for (part, views) in [("train", 0..train), ("test", train..capture.len())] {
        let images = folder.join(part);
        std::fs::create_dir_all(&images).map_err(Error::write(&images))?;
        let names: Vec<String> = views.clone().map(|view| format!("{part}/r_{view}.png")).collect();
        for (name, view) in names.iter().zip(views.clone()) {
            write_unless_other(&folder.join(name), &capture.encoded(view)?, "an existing image")?;
        }
        let transforms = folder.join(format!("transforms_{part}.json"));
        write_transforms_json(&transforms, &names, &capture.cameras()[views])?;
    }
    Ok(())
}
