//! Output of rendered images, one by one.

use super::super::report_downscaling;
use crate::error::{Error, Result};
use crate::io::{
    InputFiles, Mosaic, VideoWriter, check_regular, check_writable_dir, check_writable_file, is_png_name,
    tile_horizontally, write_png,
};
use crate::scene::ImageSize;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// Output that `--out` selects.
pub enum ImageOutput<'a> {
    /// Folder of PNGs.
    Folder {
        /// Files of each image, one per part.
        files: Vec<Vec<PathBuf>>,
        /// Number of images written so far.
        written: usize,
    },
    /// One PNG of all images side by side.
    Row(&'a Path, Mosaic),
    Film(&'a Path, VideoWriter),
}

impl<'a> ImageOutput<'a> {
    /// Returns an error, before the work, if the output couldn't be written. `frames_per_second` is the user's `--fps`.
    pub fn check(path: &Path, frames_per_second: Option<u32>) -> Result<()> {
        let kind = kind(path);
        if kind != Kind::Film && frames_per_second.is_some() {
            return Err(Error::request(format!(
                "--fps is for films: {} is none, expected a name that ends in .mp4 or .gif",
                path.display()
            )));
        }
        match kind {
            Kind::Folder => return check_writable_dir(path),
            Kind::Row => {}
            Kind::Film => VideoWriter::check(path, frames_per_second.unwrap_or(1))?,
        }
        check_writable_file(path)
    }

    /// Creates the output for images called `names`, unique with the `suffixes` of their parts, in frames of at most `size` with all parts
    /// side by side.
    ///
    /// # Errors
    /// An output that would replace one of `inputs`, or that can't be written.
    pub fn begin(
        path: &'a Path,
        (names, suffixes): (&[String], &[&str]),
        (size, frames_per_second): (ImageSize, u32),
        inputs: &InputFiles,
    ) -> Result<Self> {
        let kind = kind(path);
        if kind != Kind::Folder {
            inputs.check_file(path)?;
        }
        Ok(match kind {
            Kind::Folder => {
                let file = |name: &String, suffix: &&str| path.join(format!("{name}{suffix}.png"));
                let of_image = |name| suffixes.iter().map(|suffix| file(name, suffix)).collect();
                let files: Vec<Vec<PathBuf>> = names.iter().map(of_image).collect();
                for file in files.iter().flatten() {
                    inputs.check_file(file)?;
                    check_regular(file)?;
                }
                inputs.check_folder(path)?;
                ImageOutput::Folder { files, written: 0 }
            }
            Kind::Row => ImageOutput::Row(path, Mosaic::row(names.len())),
            Kind::Film => ImageOutput::Film(path, VideoWriter::begin(path, size, frames_per_second)?),
        })
    }

    /// Adds the next image, as its parts [3, H, W].
    pub fn add(&mut self, parts: &[Tensor]) -> Result<()> {
        match self {
            ImageOutput::Film(_, film) => film.add(&tile_horizontally(parts)),
            ImageOutput::Row(_, mosaic) => mosaic.add(parts),
            ImageOutput::Folder { files, written } => {
                let of_picture = &files[*written];
                *written += 1;
                of_picture.iter().zip(parts).try_for_each(|(file, picture)| {
                    let folder = file.parent().expect("it is in the output");
                    std::fs::create_dir_all(folder).map_err(Error::write(folder))?;
                    write_png(file, picture)
                })
            }
        }
    }

    /// Finishes the output and returns the files written.
    pub fn finish(self) -> Result<Vec<PathBuf>> {
        match self {
            ImageOutput::Folder { files, .. } => Ok(files.into_iter().flatten().collect()),
            ImageOutput::Row(path, mosaic) => {
                report_downscaling(path, mosaic.shrunk_by());
                mosaic.write(path)?;
                Ok(vec![path.to_owned()])
            }
            ImageOutput::Film(path, film) => {
                film.finish()?;
                Ok(vec![path.to_owned()])
            }
        }
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Folder,
    Row,
    Film,
}

/// Returns the kind of output that the file extension selects.
fn kind(path: &Path) -> Kind {
    if VideoWriter::has_video_extension(path) {
        Kind::Film
    } else if is_png_name(path) {
        Kind::Row
    } else {
        Kind::Folder
    }
}
