//! Where pictures go, one by one as they are rendered.

use super::super::say_shrunk;
use globalsplat::data::Capture;
use globalsplat::error::{Error, Result};
use globalsplat::io::{Film, Mosaic, check_writable_dir, check_writable_file, tile_horizontally, write_png};
use globalsplat::scene::ImageSize;
use std::path::{Path, PathBuf};
use tch::Tensor;

/// What `--out` asks for.
pub enum Output<'a> {
    /// A folder of PNGs, and those that are in it.
    Folder(&'a Path, Vec<PathBuf>),
    /// One PNG of all side by side.
    Row(&'a Path, Mosaic),
    Film(&'a Path, Film),
}

impl<'a> Output<'a> {
    /// Refuses, before the work, what could not be written after it. `frames_per_second` is what was asked for.
    pub fn check(path: &Path, frames_per_second: Option<u32>) -> Result<()> {
        let kind = kind(path);
        if kind != Kind::Film && frames_per_second.is_some() {
            return Err(Error::Request(format!(
                "--fps is for films: {} is none, expected a name that ends in .mp4 or .gif",
                path.display()
            )));
        }
        match kind {
            Kind::Folder => return check_writable_dir(path),
            Kind::Row => {}
            Kind::Film => Film::check(path, frames_per_second.unwrap_or(1))?,
        }
        check_writable_file(path)
    }

    /// For `count` frames of `size` at most, of all parts side by side.
    pub fn begin(path: &'a Path, count: usize, size: ImageSize, frames_per_second: u32) -> Result<Self> {
        Ok(match kind(path) {
            Kind::Folder => Output::Folder(path, vec![]),
            Kind::Row => Output::Row(path, Mosaic::row(count)),
            Kind::Film => Output::Film(path, Film::begin(path, size, frames_per_second)?),
        })
    }

    /// Adds the picture `name`, of `parts` [3, H, W], each with its file's suffix.
    pub fn add(&mut self, name: &str, parts: Vec<(&str, Tensor)>, capture: Option<&Capture>) -> Result<()> {
        let pictures = |parts: Vec<(&str, Tensor)>| -> Vec<Tensor> {
            parts.into_iter().map(|(_, picture)| picture).collect()
        };
        match self {
            Output::Film(_, film) => film.add(&tile_horizontally(&pictures(parts))),
            Output::Row(_, mosaic) => mosaic.add(&pictures(parts)),
            Output::Folder(path, written) => parts.into_iter().try_for_each(|(suffix, picture)| {
                let file = path.join(format!("{name}{suffix}.png"));
                let folder = file.parent().expect("it is in the output");
                std::fs::create_dir_all(folder).map_err(Error::write(folder))?;
                if capture.is_some_and(|capture| capture.has_photo(&file)) {
                    let expected = "a folder without the capture's photos";
                    return Err(Error::input(&file, "the output", "a photo of the capture", expected));
                }
                write_png(&file, &picture)?;
                written.push(file);
                Ok(())
            }),
        }
    }

    /// The files that were written.
    pub fn finish(self) -> Result<Vec<PathBuf>> {
        match self {
            Output::Folder(_, written) => Ok(written),
            Output::Row(path, mosaic) => {
                say_shrunk(path, mosaic.shrunk_by());
                mosaic.write(path)?;
                Ok(vec![path.to_owned()])
            }
            Output::Film(path, film) => {
                film.finish()?;
                Ok(vec![path.to_owned()])
            }
        }
    }
}

#[derive(PartialEq)]
enum Kind {
    Folder,
    Row,
    Film,
}

/// Told by the ending.
fn kind(path: &Path) -> Kind {
    match path.extension().and_then(|ending| ending.to_str()) {
        Some("gif" | "mp4") => Kind::Film,
        Some("png") => Kind::Row,
        _ => Kind::Folder,
    }
}
