//! Output of a splat, with coordinates relative to the world's origin or to a local one.

use crate::error::{Error, Result};
use crate::io::{
    ShLimits, Splat, WriteOptions, check_writable_file, fit_splat, origin_file, output_format,
    rounding_warning, splat_files, write_local_splat,
};
use crate::scene::Camera;
use glam::DVec3;
use std::path::Path;

/// Checks that the origin file of a splat at `path` can be written, if one is to be written (`is_local`).
///
/// # Errors
/// A request error that names the file.
pub fn check_origin(path: &Path, is_local: bool) -> Result<()> {
    if is_local { Ok(check_writable_file(&origin_file(path))?) } else { Ok(()) }
}

/// Returns the size of the splat at `path` with all its files, such as the images of a SOG's `meta.json`.
pub fn total_bytes(path: &Path) -> Result<u64> {
    let files = splat_files(path).into_iter().filter(|file| file.is_file());
    files.map(|file| Ok(std::fs::metadata(&file).map_err(Error::read(&file))?.len())).sum()
}

/// Calls [`write`] with spherical harmonics fitted to the range of the format, so that the splat looks the same from `cameras`.
pub fn write_for(path: &Path, splat: &Splat, cameras: &[Camera], local_origin: Option<DVec3>) -> Result<()> {
    let limits = ShLimits::up_to(splat.sh_degree);
    write(path, &fit_splat(path, splat, &limits, cameras)?, local_origin, &WriteOptions::default())
}

/// Writes `splat` to `path`, with coordinates relative to `local_origin` if there is one. Otherwise they are world coordinates,
/// and their loss of precision in float32 is reported on standard error.
pub fn write(path: &Path, splat: &Splat, local_origin: Option<DVec3>, options: &WriteOptions) -> Result<()> {
    if splat.antialiased && !output_format(path)?.marks_antialiased {
        let line = "the format can't say that the splat is antialiased, and viewers show it slightly wrong";
        eprintln!("{}: {line}", path.display());
    }
    if local_origin.is_none()
        && let Some(loss) = rounding_warning(splat)
    {
        eprintln!("{}: {loss}; --local-origin keeps them exact", path.display());
    }
    write_local_splat(path, &splat.with_origin(local_origin.unwrap_or(DVec3::ZERO)), options)
}
