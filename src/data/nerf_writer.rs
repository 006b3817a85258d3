//! Writes a capture in the layout of NeRF's synthetic scenes, which most other programs read.

use super::write_unless_other;
use crate::error::{Error, Result};
use crate::scene::Camera;
use globalsplat_capture::write_transforms_json;
use image::{DynamicImage, ImageFormat};
use rayon::prelude::*;
use std::io::Cursor;
use std::path::Path;

/// Writes the views of `cameras` as PNGs to `folder`: the first `train` of them to `train`, with `transforms_train.json`, and the others to
/// `test`, with `transforms_test.json`. `image_of` returns the image of a view.
///
/// # Errors
/// Fails if a file can't be written or exists with other contents.
pub(crate) fn write_nerf_capture(
    folder: &Path,
    cameras: &[Camera],
    train: usize,
    image_of: impl Fn(usize) -> DynamicImage + Sync,
) -> Result<()> {
    for (part, views) in [("train", 0..train), ("test", train..cameras.len())] {
        let images = folder.join(part);
        std::fs::create_dir_all(&images).map_err(Error::write(&images))?;
        let names: Vec<String> = views.clone().map(|view| format!("{part}/r_{view}.png")).collect();
        names.par_iter().zip(views.clone()).try_for_each(|(name, view)| {
            let mut bytes = Cursor::new(vec![]);
            image_of(view).write_to(&mut bytes, ImageFormat::Png).map_err(Error::external)?;
            write_unless_other(&folder.join(name), bytes.get_ref(), "an existing image")
        })?;
        let transforms = folder.join(format!("transforms_{part}.json"));
        write_transforms_json(&transforms, &names, &cameras[views])?;
    }
    Ok(())
}
