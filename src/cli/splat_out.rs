//! A splat that is written, about the world's origin or a local one.

use glam::DVec3;
use globalsplat::error::Result;
use globalsplat::io::{Splat, check_writable_origin, fit_splat, write_local_splat, write_splat};
use globalsplat::render::HarmonicLimits;
use globalsplat::scene::Camera;
use std::path::Path;

/// Checks that the origin of a splat at `path` could be written, if it is to be (`is_local`).
///
/// # Errors
/// A request error that names the file.
pub fn check_origin(path: &Path, is_local: bool) -> Result<()> {
    if is_local { check_writable_origin(path) } else { Ok(()) }
}

/// Writes as [`write`] does, in spherical harmonics that the format holds and that show `cameras` the same.
pub fn write_for(path: &Path, splat: &Splat, cameras: &[Camera], local_origin: Option<DVec3>) -> Result<()> {
    let limits = HarmonicLimits::up_to(splat.sh_degree());
    write(path, &fit_splat(path, splat, &limits, cameras)?, local_origin)
}

/// Writes `splat` at `path`, with coordinates relative to `local_origin` if there is one. Otherwise they are the world's, and what
/// float32 loses of them is said on standard error.
pub fn write(path: &Path, splat: &Splat, local_origin: Option<DVec3>) -> Result<()> {
    if let Some(origin) = local_origin {
        return write_local_splat(path, &splat.with_origin(origin));
    }
    if let Some(loss) = splat.world_loss() {
        eprintln!("{}: {loss}; --local-origin keeps them exact", path.display());
    }
    write_splat(path, splat)
}
