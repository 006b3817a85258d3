//! File formats of splats: a module for each format, and an entry in [`FORMATS`]. The extension determines the format that is written; a
//! file that is read is recognized by its contents, where that is possible.

mod antimatter;
mod compressed_ply;
mod invalid;
mod morton;
mod origin;
mod ply;
mod ply_body;
mod ply_header;
mod rotations;
mod spz;
mod values;

pub use origin::{check_writable_origin, origin_file, splat_files};

use crate::error::{Error, Result};
use crate::render::{HarmonicLimits, SplatRenderer, fit_harmonics};
use crate::scene::{Camera, Gaussians, LocalFrame};
use glam::DVec3;
use globalsplat_files::check_writable_file;
use invalid::InvalidGaussians;
use origin::{read_origin, write_with_origin};
use rotations::with_rotation;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor};

/// Contents of a splat file: the Gaussians of one scene.
#[derive(Debug)]
pub struct Splat {
    /// Gaussians [1, N, ..], float32 on the host, with means relative to `origin`.
    pub gaussians: Gaussians,
    /// Origin of the means in world coordinates: world = origin + mean.
    pub origin: DVec3,
    /// Messages about what was left out or changed when the splat was read or created, a sentence each. Splats derived from it have none.
    pub warnings: Vec<String>,
}

/// Contents of a file as a format's reader returns them, before its Gaussians are checked.
struct Contents {
    gaussians: Gaussians,
    invalid: InvalidGaussians,
    warnings: Vec<String>,
}

impl Splat {
    /// Ratio of the spacing of float32 positions to the scene's typical distance above which rounding is visible in rendered images.
    const COARSE: f64 = 1e-4;

    /// Creates a splat from `gaussians` of one scene in world coordinates, without their gradients. Gaussians whose quaternion has length 0
    /// are left out, and counted in [`Splat::warnings`].
    ///
    /// # Errors
    /// Returns an error if there isn't exactly one scene.
    pub fn of(gaussians: &Gaussians) -> Result<Self> {
        match gaussians.means.size()[0] {
            1 => {
                let on_host = gaussians.map(|t| t.detach().to_device(Device::Cpu).to_kind(Kind::Float));
                Ok(Splat::of_rotated(on_host, "the splat", vec![]))
            }
            scenes => Err(Error::request(format!("a splat holds one scene, found {scenes}"))),
        }
    }

    /// Creates a splat without the Gaussians that have no rotation, and counts them in a warning that calls the splat `name`.
    fn of_rotated(gaussians: Gaussians, name: impl Display, mut warnings: Vec<String>) -> Self {
        let all = gaussians.count();
        let (gaussians, left_out) = with_rotation(&gaussians);
        if left_out > 0 {
            warnings.push(format!(
                "{name}: {left_out} of {all} Gaussians are left out, whose rotations have length 0"
            ));
        }
        Splat { gaussians, origin: DVec3::ZERO, warnings }
    }

    /// Returns the degree of the spherical harmonics, 0 to 3.
    pub fn sh_degree(&self) -> i64 {
        self.bases().isqrt() - 1
    }

    /// Returns the splat with spherical harmonics up to `degree`: higher coefficients are dropped, missing ones are 0.
    pub fn with_sh_degree(&self, degree: i64) -> Self {
        let bases = (degree + 1) * (degree + 1);
        let more = (bases - self.bases()).max(0);
        let sh = self.gaussians.sh.constant_pad_nd([0, 0, 0, more]).narrow(2, 0, bases).contiguous();
        let gaussians = self.gaussians.map(Tensor::shallow_clone);
        Splat { gaussians: Gaussians { sh, ..gaussians }, origin: self.origin, warnings: vec![] }
    }

    /// Returns the splat with means relative to `origin`, rounded to float32.
    pub fn with_origin(&self, origin: DVec3) -> Self {
        let mut gaussians = self.gaussians.map(Tensor::shallow_clone);
        if origin != self.origin {
            let by = Tensor::from_slice(&(self.origin - origin).to_array());
            gaussians.means = (gaussians.means.to_kind(Kind::Double) + by).to_kind(Kind::Float);
        }
        Splat { gaussians, origin, warnings: vec![] }
    }

    /// Returns the local frame in which the splat is rendered (spec 2.5).
    pub fn frame(&self) -> LocalFrame {
        self.gaussians.local_frame(self.origin)
    }

    /// Returns a renderer of the splat for cameras in world coordinates.
    pub fn renderer(&self) -> SplatRenderer {
        SplatRenderer::new(&self.gaussians, self.origin, self.frame())
    }

    /// Returns a message about the rounding of positions to float32 in world coordinates, if it is visible in rendered images.
    pub fn world_loss(&self) -> Option<String> {
        let frame = self.frame();
        let farthest = frame.origin.abs().max_element();
        let spacing = f64::from((farthest as f32).next_up()) - f64::from(farthest as f32);
        let share = spacing / frame.typical_distance();
        (self.origin != DVec3::ZERO && share > Self::COARSE).then(|| {
            format!(
                "positions are rounded: {farthest:.3e} units from the origin, float32 has one every {spacing} units, {:.2} % of the \
                 scene's typical distance",
                100. * share
            )
        })
    }

    /// Returns the number of spherical harmonics per colour channel.
    fn bases(&self) -> i64 {
        self.gaussians.sh.size()[2]
    }

    /// Returns the size in bytes of the splat as a 3DGS PLY, the format that every program reads.
    pub fn ply_bytes(&self) -> u64 {
        ply::size(self)
    }
}

/// A splat file format.
struct Format {
    /// Suffix of file names, in lower case.
    ending: &'static str,
    /// Function that returns `true` if bytes are certainly in this format.
    recognizes: fn(&[u8]) -> bool,
    read: fn(&Path, &[u8]) -> Result<Contents>,
    write: fn(&Path, &Splat) -> Result<()>,
    limits: fn() -> HarmonicLimits,
}

/// All formats. The first one whose suffix matches, or that recognizes a file, is used.
const FORMATS: [Format; 4] = [
    Format {
        ending: ".compressed.ply",
        recognizes: compressed_ply::recognizes,
        read: compressed_ply::read,
        write: compressed_ply::write,
        limits: compressed_ply::limits,
    },
    Format {
        ending: ".ply",
        recognizes: ply::recognizes,
        read: ply::read,
        write: ply::write,
        limits: ply::limits,
    },
    Format {
        ending: ".spz",
        recognizes: spz::recognizes,
        read: spz::read,
        write: spz::write,
        limits: spz::limits,
    },
    Format {
        ending: ".splat",
        recognizes: |_| false,
        read: antimatter::read,
        write: antimatter::write,
        limits: antimatter::limits,
    },
];

/// Returns the format that belongs to the extension of `path`.
fn format_of(path: &Path) -> Result<&'static Format> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    FORMATS.iter().find(|format| name.ends_with(format.ending)).ok_or_else(|| {
        let found = path.extension().map_or("absent".into(), |ending| format!(".{}", ending.display()));
        Error::input(path, "the ending", found, ".ply, .compressed.ply, .spz or .splat")
    })
}

/// Returns `true` if `path` has the extension of a splat format.
pub fn is_splat_name(path: &Path) -> bool {
    format_of(path).is_ok()
}

/// Returns the path of the splat `name` in `folder`, in any format, or if there is none, the path of the missing PLY.
pub fn find_splat(folder: &Path, name: &str) -> PathBuf {
    let candidates = FORMATS.map(|format| folder.join(format!("{name}{}", format.ending)));
    candidates.into_iter().find(|path| path.is_file()).unwrap_or_else(|| folder.join(format!("{name}.ply")))
}

/// Checks that a splat could be written at `path`. Call it before the work starts.
///
/// # Errors
/// Returns an error for an unknown extension, or a request error that names the path.
pub fn check_writable_splat(path: &Path) -> Result<()> {
    format_of(path)?;
    Ok(check_writable_file(path)?)
}

/// Reads a splat in the format that is recognized by its contents, or else in the format of its extension. Gaussians whose quaternion has
/// length 0 are left out, and counted in [`Splat::warnings`].
///
/// # Errors
/// Returns an error for an unknown extension, or if the file can't be read or violates its format, a Gaussian has a value that isn't finite
/// or is out of range, or no Gaussian can be drawn.
pub fn read_splat(path: &Path) -> Result<Splat> {
    let Contents { gaussians, invalid, warnings } = read_contents(path)?;
    invalid.refuse(path)?;
    drawable(path, gaussians.count(), gaussians, warnings)
}

/// Reads a splat like [`read_splat`], but also leaves out the Gaussians with invalid values.
///
/// # Errors
/// Returns the errors of [`read_splat`], except for invalid values.
pub fn read_splat_without_invalid(path: &Path) -> Result<Splat> {
    let Contents { gaussians, invalid, mut warnings } = read_contents(path)?;
    let valid = invalid.leave_out(path, &gaussians, &mut warnings);
    drawable(path, gaussians.count(), valid, warnings)
}

fn read_contents(path: &Path) -> Result<Contents> {
    let named = format_of(path)?;
    let bytes = std::fs::read(path).map_err(Error::read(path))?;
    (recognize(&bytes).unwrap_or(named).read)(path, &bytes)
}

/// Returns the format whose magic number `bytes` begin with.
fn recognize(bytes: &[u8]) -> Option<&'static Format> {
    FORMATS.iter().find(|format| (format.recognizes)(bytes))
}

/// Creates the splat from the valid Gaussians of a file that has `all` in total, without those that have no rotation.
fn drawable(path: &Path, all: i64, valid: Gaussians, warnings: Vec<String>) -> Result<Splat> {
    let splat = Splat::of_rotated(valid, path.display(), warnings);
    if splat.gaussians.count() == 0 && all > 0 {
        let found = format!("{all}, none of which can be drawn");
        let expected = "finite numbers, and rotations whose length isn't 0";
        return Err(Error::input(path, "the number of Gaussians", found, expected));
    }
    Ok(Splat { origin: read_origin(path)?, ..splat })
}

/// Writes a splat atomically in world coordinates, in the format of the extension of `path`. The origin file of an older splat there is
/// removed. Gaussians whose quaternion has length 0 are left out; [`Splat::of`] counts them.
///
/// # Errors
/// Returns an error for an unknown extension, or if the format can't hold the Gaussians, for example because a value isn't finite, or the
/// file can't be written.
pub fn write_splat(path: &Path, splat: &Splat) -> Result<()> {
    write_local_splat(path, &splat.with_origin(DVec3::ZERO))
}

/// Writes a splat like [`write_splat`], but with coordinates relative to its origin, which is written to [`origin_file`] unless it is zero.
///
/// # Errors
/// Returns the errors of [`write_splat`].
pub fn write_local_splat(path: &Path, splat: &Splat) -> Result<()> {
    let format = format_of(path)?;
    let (gaussians, _) = with_rotation(&splat.gaussians);
    let rotated = Splat { gaussians, origin: splat.origin, warnings: vec![] };
    write_with_origin(path, splat.origin, || (format.write)(path, &rotated))
}

/// Returns `splat` with spherical harmonics within `limits` and those of the format of `path`, which look the same from `cameras`.
///
/// # Errors
/// Returns an error for an unknown extension.
pub fn fit_splat(path: &Path, splat: &Splat, limits: &HarmonicLimits, cameras: &[Camera]) -> Result<Splat> {
    let limits = limits.and(&(format_of(path)?.limits)());
    let frame = splat.frame();
    let local = splat.gaussians.to_local(&frame, splat.origin);
    let Gaussians { opacities, sh, .. } = fit_harmonics(&local, &frame.cameras_to_local(cameras), &limits);
    let gaussians = splat.gaussians.map(Tensor::shallow_clone);
    Ok(Splat { gaussians: Gaussians { opacities, sh, ..gaussians }, origin: splat.origin, warnings: vec![] })
}

/// Checks that all of `numbers`, which are to be written at `path`, are finite.
fn all_finite(path: &Path, numbers: &Tensor) -> Result<()> {
    match numbers.isfinite().all().int64_value(&[]) {
        0 => Err(Error::failed(format!("{}: the splat has numbers that aren't finite", path.display()))),
        _ => Ok(()),
    }
}
