//! Splats as files: a file a format, and a line in [`FORMATS`], among which a file's ending chooses.

mod ply;

use crate::error::{Error, Result};
use crate::scene::Gaussians;
use std::path::Path;
use tch::{Device, Kind};

/// What a splat's file holds: the Gaussians of one scene.
#[derive(Debug)]
pub struct Splat {
    /// [1, N, ..], float32 on the host.
    pub gaussians: Gaussians,
}

impl Splat {
    /// `gaussians` of one scene, without their gradients.
    ///
    /// # Errors
    /// More scenes than one.
    pub fn of(gaussians: &Gaussians) -> Result<Self> {
        match gaussians.means.size()[0] {
            1 => {
                let on_host = gaussians.map(|t| t.detach().to_device(Device::Cpu).to_kind(Kind::Float));
                Ok(Splat { gaussians: on_host })
            }
            scenes => Err(Error::Request(format!("a splat holds one scene, found {scenes}"))),
        }
    }

    /// Degree of the spherical harmonics, 0 to 3.
    pub fn sh_degree(&self) -> i64 {
        self.bases().isqrt() - 1
    }

    /// Spherical harmonics of a colour channel.
    fn bases(&self) -> i64 {
        self.gaussians.sh.size()[2]
    }

    /// Bytes of its file in the format that everyone reads, a 3DGS PLY.
    pub fn ply_bytes(&self) -> u64 {
        ply::size(self)
    }
}

/// A format.
struct Format {
    /// Of file names.
    ending: &'static str,
    read: fn(&Path) -> Result<Splat>,
    write: fn(&Path, &Splat) -> Result<()>,
}

/// Files of other endings are taken for the first.
const FORMATS: [Format; 1] = [Format { ending: "ply", read: ply::read, write: ply::write }];

fn format_of(path: &Path) -> &'static Format {
    let ending = path.extension().unwrap_or_default();
    FORMATS.iter().find(|format| ending.eq_ignore_ascii_case(format.ending)).unwrap_or(&FORMATS[0])
}

/// Reads a splat of the format that the ending of `path` tells.
///
/// # Errors
/// A file that can't be read or breaks its format's rules.
pub fn read_splat(path: &Path) -> Result<Splat> {
    (format_of(path).read)(path)
}

/// Writes a splat in the format that the ending of `path` tells, whole or not at all.
///
/// # Errors
/// Gaussians with numbers that aren't finite, or the system's refusal to write.
pub fn write_splat(path: &Path, splat: &Splat) -> Result<()> {
    (format_of(path).write)(path, splat)
}
