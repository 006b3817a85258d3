//! Output of a splat, with coordinates relative to the world's origin or to a local one.

use crate::error::{Error, Result};
use crate::io::{
    ShLimits, Splat, WriteOptions, check_writable_file, fit_splat, origin_file, output_format,
    rounding_warning, splat_files, write_local_splat,
};
use crate::scene::Camera;
use clap::Args;
use clap::builder::BoolishValueParser;
use glam::DVec3;
use std::path::Path;

/// The option `--local-origin`.
#[derive(Clone, Copy, Args)]
pub struct LocalOrigin {
    /// Write coordinates relative to the center of the cameras, or of a splat without cameras, which is stored in a file beside the splat:
    /// far from the world's origin, as in UTM coordinates, float32 and the formats' own number types lose detail. off: world coordinates;
    /// by default relative to the origin of the splat that is read, if it has one
    #[arg(long, value_name = "on|off", num_args = 0..=1, require_equals = true, default_missing_value = "on",
        value_parser = BoolishValueParser::new(), hide_possible_values = true)]
    local_origin: Option<bool>,
}

impl LocalOrigin {
    /// Checks that the origin file of a splat at `path` can be written, if there will be one. The splat `read` is the one that is changed.
    ///
    /// # Errors
    /// A request error that names the file.
    pub fn check(self, path: &Path, read: Option<&Path>) -> Result<()> {
        let keeps_origin = || read.is_some_and(|read| origin_file(read).is_file());
        let is_local = self.local_origin.unwrap_or_else(keeps_origin);
        if is_local { Ok(check_writable_file(&origin_file(path))?) } else { Ok(()) }
    }

    /// Returns the origin of a splat to write: `center` on request, else that of the splat that was `read`, zero if it has none.
    pub fn choose(self, read: DVec3, center: impl FnOnce() -> DVec3) -> DVec3 {
        match self.local_origin {
            Some(true) => center(),
            Some(false) => DVec3::ZERO,
            None => read,
        }
    }
}

/// Returns the size of the splat at `path` with all its files, such as the images of a SOG's `meta.json`.
pub fn total_bytes(path: &Path) -> Result<u64> {
    let files = splat_files(path).into_iter().filter(|file| file.is_file());
    files.map(|file| Ok(std::fs::metadata(&file).map_err(Error::read(&file))?.len())).sum()
}

/// Calls [`write`] with spherical harmonics fitted to the range of the format, so that the splat looks the same from `cameras`.
pub fn write_for(path: &Path, splat: &Splat, cameras: &[Camera], origin: DVec3) -> Result<()> {
    let limits = ShLimits::up_to(splat.sh_degree);
    write(path, &fit_splat(path, splat, &limits, cameras)?, origin, &WriteOptions::default())
}

/// Writes `splat` to `path`, with coordinates relative to `origin`. If it is zero, their loss of precision in float32 is reported on standard
/// error.
pub fn write(path: &Path, splat: &Splat, origin: DVec3, options: &WriteOptions) -> Result<()> {
    if splat.antialiased && !output_format(path)?.marks_antialiased {
        let line = "the format can't say that the splat is antialiased, and viewers show it slightly wrong";
        eprintln!("{}: {line}", path.display());
    }
    if origin == DVec3::ZERO
        && let Some(loss) = rounding_warning(splat)
    {
        eprintln!("{}: {loss}; --local-origin keeps them exact", path.display());
    }
    write_local_splat(path, &splat.with_origin(origin), options)
}
