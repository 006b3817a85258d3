//! Origin of a splat's coordinates, in a file beside it (spec 10.18): `room.ply.origin.json` for `room.ply`.

use crate::{Error, Result};
use glam::DVec3;
use globalsplat_files::write_temporary;
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

/// Suffix that is added to the splat's name.
const ENDING: &str = ".origin.json";

#[derive(Serialize, Deserialize)]
struct Contents {
    origin: [f64; 3],
}

/// Returns the path of the origin file of the splat at `path`.
pub fn origin_file(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(ENDING);
    name.into()
}

/// Returns the origin of the splat at `path`, or zero if it has no origin file.
pub(crate) fn read_origin(path: &Path) -> Result<DVec3> {
    let path = origin_file(path);
    if !path.is_file() {
        return Ok(DVec3::ZERO);
    }
    let bytes = fs::read(&path).map_err(Error::read(&path))?;
    let Contents { origin } = serde_json::from_slice(&bytes).map_err(|e| {
        Error::input(&path, "the JSON", e, "{\"origin\": [x, y, z]}, three numbers in the capture's unit")
    })?;
    Ok(DVec3::from_array(origin))
}

/// Writes the splat at `path` with `write`, and its `origin` in a file beside it. If the origin is zero, an older origin file is removed.
/// The new origin file is written before the splat and renamed after it, so that a full disk leaves both files unchanged.
pub(crate) fn write_with_origin(
    path: &Path,
    origin: DVec3,
    write: impl FnOnce() -> Result<()>,
) -> Result<()> {
    let file = origin_file(path);
    if origin == DVec3::ZERO {
        write()?;
        return if file.is_file() { fs::remove_file(&file).map_err(Error::write(&file)) } else { Ok(()) };
    }
    let json = serde_json::to_vec_pretty(&Contents { origin: origin.to_array() }).expect("numbers");
    let partial = write_temporary(&file, |writer| writer.write_all(&json).map_err(Error::write(&file)))?;
    write()?;
    partial.persist()
}
