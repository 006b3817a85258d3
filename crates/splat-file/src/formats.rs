//! File formats of splats: a module for each format, and an entry in [`FORMATS`]. The extension determines the format that is written; a
//! file that is read is recognized by its contents, where that is possible.

use crate::invalid::InvalidGaussians;
use crate::origin::{origin_file, read_origin, write_with_origin};
use crate::ply_table::Header;
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

/// Function that writes a splat to a file.
type Write = fn(&Path, &Splat, &WriteOptions) -> Result<()>;

/// A splat file format: what it can represent, and the functions that read and write it.
pub struct SplatFormat {
    /// Suffix of file names, in lower case, or a whole file name if it doesn't begin with a dot.
    ending: &'static str,
    /// Function that returns `true` if bytes are certainly in this format.
    recognizes: fn(&[u8]) -> bool,
    /// `true` if a file can say that the splat is antialiased.
    pub marks_antialiased: bool,
    read: fn(&Path, &[u8]) -> Result<Splat>,
    find_invalid: fn(&Splat) -> InvalidGaussians,
    /// Function that writes a splat, or `None` for a format that is only read.
    write: Option<Write>,
    /// Function that returns the limits of the spherical harmonics.
    pub limits: fn() -> ShLimits,
    /// Function that returns a splat with SH coefficients above degree 0 rounded as in a file, if the format has a palette of them, which
    /// depends on all Gaussians. Writing the rounded splat doesn't change them.
    pub round_sh: Option<fn(&Splat) -> Splat>,
}

/// mkkellogg's format, which is only read. The other formats state what differs from it.
const KSPLAT: SplatFormat = SplatFormat {
    ending: ".ksplat",
    recognizes: |_| false,
    marks_antialiased: false,
    read: ksplat::read,
    find_invalid: InvalidGaussians::find,
    write: None,
    limits: || ShLimits::up_to(3),
    round_sh: None,
};

/// PlayCanvas' format, in one file.
const SOG: SplatFormat = SplatFormat {
    ending: ".sog",
    recognizes: sog::recognizes,
    marks_antialiased: true,
    read: sog::read_bundle,
    write: Some(sog::write_bundle),
    round_sh: Some(sog::round_sh),
    ..KSPLAT
};

/// All formats. The first one whose suffix matches, or that recognizes a file, is used.
static FORMATS: [SplatFormat; 10] = [
    SplatFormat {
        ending: ".compressed.ply",
        recognizes: compressed_ply::recognizes,
        marks_antialiased: true,
        read: compressed_ply::read,
        write: Some(compressed_ply::write),
        limits: compressed_ply::limits,
        ..KSPLAT
    },
    SplatFormat {
        ending: ".ply",
        recognizes: Header::begins,
        marks_antialiased: true,
        read: ply::read,
        find_invalid: ply::find_invalid,
        write: Some(ply::write),
        ..KSPLAT
    },
    SOG,
    SplatFormat {
        ending: sog::META,
        recognizes: |_| false,
        read: sog::read_folder,
        write: Some(sog::write_folder),
        ..SOG
    },
    SplatFormat {
        ending: ".spz",
        recognizes: spz::recognizes,
        marks_antialiased: true,
        read: spz::read,
        write: Some(spz::write),
        limits: spz::limits,
        ..KSPLAT
    },
    SplatFormat {
        ending: ".splat",
        read: dot_splat::read,
        write: Some(dot_splat::write),
        limits: dot_splat::limits,
        ..KSPLAT
    },
    SplatFormat {
        ending: ".glb",
        recognizes: gltf::recognizes_glb,
        read: gltf::read,
        write: Some(gltf::write_glb),
        ..KSPLAT
    },
    SplatFormat { ending: ".gltf", read: gltf::read, write: Some(gltf::write_gltf), ..KSPLAT },
    KSPLAT,
    SplatFormat { ending: ".zip", write: None, ..SOG },
];

/// Extensions of the formats that are written, for messages.
const WRITTEN_ENDINGS: &str = ".ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf or meta.json";
/// Extensions of all formats, for messages.
const ENDINGS: &str = ".ply, .compressed.ply, .sog, .spz, .splat, .glb, .gltf, .ksplat, meta.json or .zip";

impl SplatFormat {
    /// Returns the function that writes a splat at `path`, or an error for a format that is only read.
    fn writer(&self, path: &Path) -> Result<Write> {
        let found = || format!("{}, which is only read", self.ending);
        self.write.ok_or_else(|| Error::input(path, "the format", found(), WRITTEN_ENDINGS))
    }

    /// Returns the paths of the other files that the splat at `path` is written to.
    fn other_files(&self, path: &Path) -> Vec<PathBuf> {
        match self.ending {
            ".gltf" => vec![gltf::buffer_file(path)],
            sog::META => sog::IMAGES.map(|name| path.with_file_name(name)).to_vec(),
            _ => vec![],
        }
    }
}

/// Returns the format that belongs to the extension of `path`.
fn format_of(path: &Path) -> Result<&'static SplatFormat> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let is_named =
        |ending: &str| if ending.starts_with('.') { name.ends_with(ending) } else { name == ending };
    FORMATS.iter().find(|format| is_named(format.ending)).ok_or_else(|| {
        let found = path.extension().map_or("missing".into(), |ending| format!(".{}", ending.display()));
        Error::input(path, "the ending", found, ENDINGS)
    })
}

/// Returns the format in which a splat is written at `path`, which the extension selects.
///
/// # Errors
/// Returns an error for an unknown extension, or a format that is only read.
pub fn output_format(path: &Path) -> Result<&'static SplatFormat> {
    let format = format_of(path)?;
    format.writer(path).map(|_| format)
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
    for file in output_format(path)?.other_files(path) {
        check_writable_file(&file)?;
        if file.exists() && !path.exists() {
            let found = format!("{}, which would be replaced", file.display());
            return Err(Error::input(path, "a file beside it", found, "another name for the output"));
        }
    }
    check_writable_file(path)
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

fn read_contents(path: &Path) -> Result<(Splat, InvalidGaussians)> {
    let named = format_of(path)?;
    let bytes = std::fs::read(path).map_err(Error::read(path))?;
    let recognized = FORMATS.iter().find(|format| (format.recognizes)(&bytes));
    let format = recognized.unwrap_or(named);
    let splat = (format.read)(path, &bytes)?;
    let invalid = (format.find_invalid)(&splat);
    Ok((splat, invalid))
}

/// Creates the splat from the valid Gaussians of a file that has `all` in total, without those that have no rotation.
fn drawable(path: &Path, all: usize, valid: Splat) -> Result<Splat> {
    let splat = valid.without_missing_rotations(path.display());
    if splat.is_empty() {
        let (found, expected) = match all {
            0 => ("0".into(), "1 or more"),
            _ => (
                format!("{all}, none of which can be drawn"),
                "finite numbers, and rotations whose length isn't 0",
            ),
        };
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
    write_local_splat(path, &splat.with_origin(DVec3::ZERO), &WriteOptions::default())
}

/// Writes a splat like [`write_splat`], but with coordinates relative to its origin, which is written to
/// [`origin_file`](crate::origin_file) unless it is zero.
///
/// # Errors
/// Returns the errors of [`write_splat`], or an error if the format doesn't allow the options.
pub fn write_local_splat(path: &Path, splat: &Splat, options: &WriteOptions) -> Result<()> {
    let write = format_of(path)?.writer(path)?;
    splat.check_lengths()?;
    let (rotated, _) = drop_missing_rotations(splat);
    write_with_origin(path, splat.origin, || {
        if !InvalidGaussians::find(&rotated).rows.is_empty() {
            return Err(Error::failed(format!(
                "{}: the splat has numbers that aren't finite",
                path.display()
            )));
        }
        write(path, &rotated, options)
    })
}
