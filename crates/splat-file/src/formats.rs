//! File formats of splats: a module for each format, and an entry in [`FORMATS`]. The extension determines the format that is written; a
//! file that is read is recognized by its contents, where that is possible.

use crate::invalid::Contents;
use crate::origin::{origin_file, read_origin, write_with_origin};
use crate::rotations::drop_missing_rotations;
use crate::{Error, Result, ShLimits, Splat, compressed_ply, dot_splat, gltf, ksplat, ply, sog, spz};
use glam::DVec3;
use globalsplat_files::check_writable_file;
use std::path::{Path, PathBuf};

/// Choices within a format.
#[derive(Debug, Clone)]
pub struct WriteOptions {
    /// Version of SPZ, 2 to 4. Programs from before 2026 read versions up to 3.
    pub spz_version: u32,
}

impl Default for WriteOptions {
    fn default() -> Self {
        WriteOptions { spz_version: 4 }
    }
}

/// A splat file format.
struct Format {
    /// Suffix of file names, in lower case, or a whole file name if it doesn't begin with a dot.
    ending: &'static str,
    /// Function that returns `true` if bytes are certainly in this format.
    recognizes: fn(&[u8]) -> bool,
    /// `true` if a file can say that the splat is antialiased.
    marks_antialiased: bool,
    read: fn(&Path, &[u8]) -> Result<Contents>,
    /// Functions that write the format, or `None` if it is only read.
    writer: Option<Writer>,
}

/// Functions that write a format.
struct Writer {
    write: fn(&Path, &Splat, &WriteOptions) -> Result<()>,
    limits: fn() -> ShLimits,
    /// Function that rounds SH coefficients above degree 0 as the format does, if it has a palette of them.
    round_sh: Option<RoundSh>,
}

/// Function that returns a splat with rounded SH coefficients.
pub type RoundSh = fn(&Splat) -> Splat;

impl Writer {
    /// Creates the functions of a format without a palette.
    const fn new(write: fn(&Path, &Splat, &WriteOptions) -> Result<()>, limits: fn() -> ShLimits) -> Self {
        Writer { write, limits, round_sh: None }
    }
}

/// Name of the file that describes an unbundled SOG.
const SOG_META: &str = "meta.json";

/// Returns the limits of a format that holds any number.
fn unlimited() -> ShLimits {
    ShLimits::up_to(3)
}

/// All formats. The first one whose suffix matches, or that recognizes a file, is used.
const FORMATS: [Format; 9] = [
    Format {
        ending: ".compressed.ply",
        recognizes: compressed_ply::recognizes,
        marks_antialiased: true,
        read: compressed_ply::read,
        writer: Some(Writer::new(compressed_ply::write, compressed_ply::limits)),
    },
    Format {
        ending: ".ply",
        recognizes: ply::recognizes,
        marks_antialiased: true,
        read: ply::read,
        writer: Some(Writer::new(ply::write, unlimited)),
    },
    Format {
        ending: ".sog",
        recognizes: sog::recognizes,
        marks_antialiased: true,
        read: sog::read_bundle,
        writer: Some(Writer { round_sh: Some(sog::round_sh), ..Writer::new(sog::write_bundle, unlimited) }),
    },
    Format {
        ending: SOG_META,
        recognizes: |_| false,
        marks_antialiased: true,
        read: sog::read_folder,
        writer: Some(Writer { round_sh: Some(sog::round_sh), ..Writer::new(sog::write_folder, unlimited) }),
    },
    Format {
        ending: ".spz",
        recognizes: spz::recognizes,
        marks_antialiased: true,
        read: spz::read,
        writer: Some(Writer::new(spz::write, spz::limits)),
    },
    Format {
        ending: ".splat",
        recognizes: |_| false,
        marks_antialiased: false,
        read: dot_splat::read,
        writer: Some(Writer::new(dot_splat::write, dot_splat::limits)),
    },
    Format {
        ending: ".glb",
        recognizes: gltf::recognizes_glb,
        marks_antialiased: false,
        read: gltf::read,
        writer: Some(Writer::new(gltf::write_glb, unlimited)),
    },
    Format {
        ending: ".gltf",
        recognizes: |_| false,
        marks_antialiased: false,
        read: gltf::read,
        writer: Some(Writer::new(gltf::write_gltf, unlimited)),
    },
    Format {
        ending: ".ksplat",
        recognizes: |_| false,
        marks_antialiased: false,
        read: ksplat::read,
        writer: None,
    },
];

/// Extensions of the formats that are written, for messages.
const WRITTEN_ENDINGS: &str = ".ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf or meta.json";
/// Extensions of all formats, for messages.
const ENDINGS: &str = ".ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf, .ksplat or meta.json";

impl Format {
    /// Returns `true` if a file with this name, in lower case, is in this format.
    fn is_named(&self, name: &str) -> bool {
        if self.ending.starts_with('.') { name.ends_with(self.ending) } else { name == self.ending }
    }

    /// Returns the paths of the other files that the splat at `path` is written to.
    fn other_files(&self, path: &Path) -> Vec<PathBuf> {
        match self.ending {
            ".gltf" => vec![gltf::buffer_file(path)],
            SOG_META => sog::IMAGES.map(|name| path.with_file_name(name)).to_vec(),
            _ => vec![],
        }
    }
}

/// Returns the format that belongs to the extension of `path`.
fn format_of(path: &Path) -> Result<&'static Format> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    FORMATS.iter().find(|format| format.is_named(&name)).ok_or_else(|| {
        let found = path.extension().map_or("missing".into(), |ending| format!(".{}", ending.display()));
        Error::input(path, "the ending", found, ENDINGS)
    })
}

/// Returns the functions that write the format that belongs to the extension of `path`.
fn writer_of(path: &Path) -> Result<&'static Writer> {
    let Format { ending, writer, .. } = format_of(path)?;
    writer.as_ref().ok_or_else(|| {
        Error::input(path, "the format", format!("{ending}, which is only read"), WRITTEN_ENDINGS)
    })
}

/// Returns `true` if `path` has the extension of a splat format.
pub fn is_splat_name(path: &Path) -> bool {
    format_of(path).is_ok()
}

/// Returns the files that a splat at `path` may consist of: the splat itself, its origin file, and the buffer of a `.gltf` or the
/// images of a SOG's `meta.json`.
pub fn splat_files(path: &Path) -> Vec<PathBuf> {
    let others = format_of(path).ok().map_or(vec![], |format| format.other_files(path));
    [path.to_owned(), origin_file(path)].into_iter().chain(others).collect()
}

/// Returns the path of the splat `name` in `folder`, in any format, or if there is none, the path of the missing PLY.
pub fn find_splat(folder: &Path, name: &str) -> PathBuf {
    let endings = FORMATS.iter().map(|format| format.ending).filter(|ending| ending.starts_with('.'));
    let mut candidates = endings.map(|ending| folder.join(format!("{name}{ending}")));
    candidates.find(|path| path.is_file()).unwrap_or_else(|| folder.join(format!("{name}.ply")))
}

/// Checks that a splat could be written at `path`. Call it before the work starts.
///
/// # Errors
/// Returns an error for an unknown extension or a format that is only read, a request error that names the path, or an error if a
/// new splat would replace a file that belongs to something else, such as the buffer of a `.gltf`.
pub fn check_writable_splat(path: &Path) -> Result<()> {
    writer_of(path)?;
    for file in format_of(path)?.other_files(path) {
        check_writable_file(&file)?;
        if file.exists() && !path.exists() {
            let found = format!("{}, which would be replaced", file.display());
            return Err(Error::input(path, "a file beside it", found, "another name for the output"));
        }
    }
    check_writable_file(path)
}

/// Returns `true` if the format that the extension of `path` selects can say that a splat is antialiased.
///
/// # Errors
/// Returns an error for an unknown extension.
pub fn can_mark_antialiased(path: &Path) -> Result<bool> {
    Ok(format_of(path)?.marks_antialiased)
}

/// Returns the limits of the spherical harmonics in the format that the extension of `path` selects.
///
/// # Errors
/// Returns an error for an unknown extension, or a format that is only read.
pub fn limits_of(path: &Path) -> Result<ShLimits> {
    Ok((writer_of(path)?.limits)())
}

/// Returns the function that rounds SH coefficients above degree 0 as a file at `path` would, if its format has a palette of them, which
/// depends on all Gaussians. Writing the rounded splat doesn't change them.
///
/// # Errors
/// Returns an error for an unknown extension, or a format that is only read.
pub fn sh_rounding_of(path: &Path) -> Result<Option<RoundSh>> {
    Ok(writer_of(path)?.round_sh)
}

/// Reads a splat in the format that is recognized by its contents, or else in the format of its extension. Gaussians whose quaternion has
/// length 0 are left out, and counted in [`Splat::warnings`].
///
/// ```no_run
/// use globalsplat_splat_file::{read_splat, write_splat};
/// use std::path::Path;
///
/// # fn main() -> globalsplat_splat_file::Result<()> {
/// let splat = read_splat(Path::new("room.ply"))?;
/// println!("{} Gaussians of SH degree {}", splat.len(), splat.sh_degree);
/// write_splat(Path::new("room.spz"), &splat)?;
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Returns an error for an unknown extension, or if the file can't be read or violates its format, a Gaussian has a value that isn't finite
/// or is out of range, or no Gaussian can be drawn.
pub fn read_splat(path: &Path) -> Result<Splat> {
    let (splat, invalid) = read_contents(path)?;
    invalid.refuse(path)?;
    drawable(path, splat.len(), splat)
}

/// Reads a splat like [`read_splat`], but also leaves out the Gaussians with invalid values.
///
/// # Errors
/// Returns the errors of [`read_splat`], except for invalid values.
pub fn read_splat_without_invalid(path: &Path) -> Result<Splat> {
    let (splat, invalid) = read_contents(path)?;
    drawable(path, splat.len(), invalid.leave_out(path, splat))
}

fn read_contents(path: &Path) -> Result<Contents> {
    let named = format_of(path)?;
    let bytes = std::fs::read(path).map_err(Error::read(path))?;
    let format = FORMATS.iter().find(|format| (format.recognizes)(&bytes)).unwrap_or(named);
    let (splat, mut invalid) = (format.read)(path, &bytes)?;
    invalid.add_all(&splat);
    Ok((splat, invalid))
}

/// Creates the splat from the valid Gaussians of a file that has `all` in total, without those that have no rotation.
fn drawable(path: &Path, all: usize, valid: Splat) -> Result<Splat> {
    let splat = valid.without_missing_rotations(path.display());
    if splat.is_empty() && all > 0 {
        let found = format!("{all}, none of which can be drawn");
        let expected = "finite numbers, and rotations whose length isn't 0";
        return Err(Error::input(path, "the number of Gaussians", found, expected));
    }
    Ok(Splat { origin: read_origin(path)?, ..splat })
}

/// Writes a splat atomically in world coordinates, in the format of the extension of `path`. The origin file of an older splat there is
/// removed. Gaussians whose quaternion has length 0 are left out; [`Splat::without_missing_rotations`] counts them.
///
/// # Errors
/// Returns an error for an unknown extension, or if a list of the splat has the wrong length, or the format can't hold the Gaussians, for
/// example because a value isn't finite, or the file can't be written.
pub fn write_splat(path: &Path, splat: &Splat) -> Result<()> {
    match splat.origin == DVec3::ZERO {
        true => write_local_splat(path, splat),
        false => write_local_splat(path, &splat.with_origin(DVec3::ZERO)),
    }
}

/// Writes a splat like [`write_splat`], but with coordinates relative to its origin, which is written to
/// [`origin_file`](crate::origin_file) unless it is zero.
///
/// # Errors
/// Returns the errors of [`write_splat`].
pub fn write_local_splat(path: &Path, splat: &Splat) -> Result<()> {
    write_local_splat_with(path, splat, &WriteOptions::default())
}

/// Writes a splat like [`write_local_splat`], with `options`.
///
/// # Errors
/// Returns the errors of [`write_splat`], or an error if the format doesn't allow the options.
pub fn write_local_splat_with(path: &Path, splat: &Splat, options: &WriteOptions) -> Result<()> {
    let writer = writer_of(path)?;
    splat.check_lengths()?;
    let (rotated, _) = drop_missing_rotations(splat);
    write_with_origin(path, splat.origin, || {
        rotated.check_finite(path)?;
        (writer.write)(path, &rotated, options)
    })
}
