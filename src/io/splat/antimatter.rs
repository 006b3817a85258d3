//! antimatter15's `.splat` format: 32 bytes per Gaussian and nothing else (spec 10.14).

use super::invalid::InvalidGaussians;
use super::values::{Values, normalized};
use super::{Contents, Splat, recognize};
use crate::error::{Error, Result};
use crate::render::HarmonicLimits;
use crate::scene::SH_C0;
use globalsplat_files::write_atomically;
use std::path::Path;

/// Number of bytes of a Gaussian: position and scale, float32 each, then colour, opacity and rotation, a byte each.
const BYTES: usize = 32;

/// Reads a `.splat`, whose colours don't depend on the view direction.
///
/// # Errors
/// Returns an error if the file doesn't consist of whole Gaussians.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
    let (gaussians, rest) = bytes.as_chunks::<BYTES>();
    if gaussians.is_empty() || !rest.is_empty() {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the length", found, format!("{BYTES} bytes for each Gaussian")));
    }
    let three = |bytes: &[u8]| -> [f32; 3] {
        std::array::from_fn(|axis| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|byte| bytes[4 * axis + byte]);
            f32::from_le_bytes([a, b, c, d])
        })
    };
    let colour = |byte: u8| ((f64::from(byte) / 255. - 0.5) / SH_C0) as f32;
    let values = Values {
        means: gaussians.iter().map(|gaussian| three(&gaussian[..12])).collect(),
        scales: gaussians.iter().map(|gaussian| three(&gaussian[12..24])).collect(),
        bases: 1,
        sh: gaussians.iter().map(|gaussian| [24, 25, 26].map(|at| colour(gaussian[at]))).collect(),
        opacities: gaussians.iter().map(|gaussian| f32::from(gaussian[27]) / 255.).collect(),
        quaternions: gaussians
            .iter()
            .map(|gaussian| normalized([28, 29, 30, 31].map(|at| f32::from(gaussian[at]) - 128.)))
            .collect(),
    };
    Ok(values.into_contents(InvalidGaussians::default()))
}

/// Returns the limits of coefficients: colours that a screen shows, independent of the view direction.
pub(super) fn limits() -> HarmonicLimits {
    HarmonicLimits { degree: 0, constant: -0.5 / SH_C0..=0.5 / SH_C0, others: 0. ..=0. }
}

/// Writes a `.splat`. The Gaussians of the largest volume times opacity come first, for viewers that show a file while it loads.
///
/// # Errors
/// Returns an error if there is no Gaussian, a value isn't finite, or the file can't be written.
pub(super) fn write(path: &Path, splat: &Splat) -> Result<()> {
    let values = Values::of(path, splat)?;
    if values.count() == 0 {
        return Err(Error::failed(format!(
            "{}: a .splat holds one Gaussian at least, found 0",
            path.display()
        )));
    }
    let importance = |&index: &usize| {
        let volume: f64 = values.scales[index].iter().map(|&scale| f64::from(scale)).product();
        volume * f64::from(values.opacities[index])
    };
    let mut order: Vec<usize> = (0..values.count()).collect();
    order.sort_by(|a, b| importance(b).total_cmp(&importance(a)));
    write_atomically(path, |writer| {
        for (place, index) in order.into_iter().enumerate() {
            let mut gaussian = Vec::with_capacity(BYTES);
            for number in values.means[index].iter().chain(&values.scales[index]) {
                gaussian.extend(number.to_le_bytes());
            }
            let colour = values.sh_of(index)[0].map(|dc| f64::from(dc) * SH_C0 + 0.5);
            gaussian.extend(colour.map(|channel| (channel * 255.).round() as u8));
            gaussian.push((values.opacities[index] * 255.).round() as u8);
            gaussian.extend(values.quaternions[index].map(|part| (part * 128. + 128.).round() as u8));
            // If the first bytes are the magic number of another format, the lowest bit of the position is flipped, so that readers don't
            // take the file for that format.
            if place == 0 && recognize(&gaussian).is_some() {
                gaussian[0] ^= 1;
            }
            writer.write_all(&gaussian).map_err(Error::write(path))?;
        }
        Ok(())
    })
}
