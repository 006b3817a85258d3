//! antimatter15's `.splat` format: 32 bytes per Gaussian and nothing else (spec 10.14).

use crate::numbers::f32_at;
use crate::ply_table::Header;
use crate::rotations::normalized;
use crate::splat::{color_to_sh0, logit_of_opacity, sh0_to_color};
use crate::{Error, Result, SH_C0, ShLimits, Splat, WriteOptions, gltf, sog, spz};
use globalsplat_files::write_atomically;
use std::path::Path;

/// Number of bytes of a Gaussian: position and scale, float32 each, then color, opacity and rotation, a byte each.
const BYTES: usize = 32;

/// Reads a `.splat`, whose colors don't depend on the view direction.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let (gaussians, rest) = bytes.as_chunks::<BYTES>();
    if gaussians.is_empty() || !rest.is_empty() {
        let found = format!("{} bytes", bytes.len());
        return Err(Error::input(path, "the length", found, format!("{BYTES} bytes for each Gaussian")));
    }
    let mut splat = Splat { linear_scales: Some(vec![]), ..Splat::default() };
    for gaussian in gaussians {
        let fraction = |at: usize| f64::from(gaussian[at]) / 255.;
        splat.means.push([0, 4, 8].map(|at| f32_at(gaussian, at)));
        splat.push_linear_scale([12, 16, 20].map(|at| f32_at(gaussian, at)));
        splat.sh.push([24, 25, 26].map(|at| color_to_sh0(fraction(at))));
        splat.opacity_logits.push(logit_of_opacity(fraction(27)));
        splat.quaternions.push(normalized([28, 29, 30, 31].map(|at| f32::from(gaussian[at]) - 128.)));
    }
    Ok(splat)
}

/// Returns the limits of coefficients: colors that a screen shows, independent of the view direction.
pub(crate) fn limits() -> ShLimits {
    ShLimits { degree: 0, dc: -0.5 / SH_C0..=0.5 / SH_C0, rest: 0. ..=0. }
}

/// Functions that recognize the magic numbers of other formats.
const MAGIC_NUMBERS: [fn(&[u8]) -> bool; 4] =
    [Header::begins, sog::recognizes, spz::recognizes, gltf::recognizes_glb];

/// Writes a `.splat`. The Gaussians of the largest volume times opacity come first, for viewers that show a file while it loads.
pub(crate) fn write(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    if splat.is_empty() {
        return Err(Error::failed(format!(
            "{}: a .splat holds one Gaussian at least, found 0",
            path.display()
        )));
    }
    let importance = |index: usize| {
        let volume: f64 = splat.scale(index).iter().map(|&scale| f64::from(scale)).product();
        volume * f64::from(splat.opacity(index))
    };
    let importance: Vec<f64> = (0..splat.len()).map(importance).collect();
    let mut order: Vec<usize> = (0..splat.len()).collect();
    order.sort_by(|&a, &b| importance[b].total_cmp(&importance[a]));
    write_atomically(path, |writer| {
        for (place, index) in order.into_iter().enumerate() {
            let mut gaussian = Vec::with_capacity(BYTES);
            for number in splat.means[index].iter().chain(&splat.scale(index)) {
                gaussian.extend(number.to_le_bytes());
            }
            let color = splat.sh_of(index)[0].map(sh0_to_color);
            gaussian.extend(color.map(|channel| (channel * 255.).round() as u8));
            gaussian.push((splat.opacity(index) * 255.).round() as u8);
            gaussian.extend(splat.unit_quaternion(index).map(|part| (part * 128. + 128.).round() as u8));
            // If the first bytes are the magic number of another format, the lowest bit of the position is flipped, so that readers don't
            // take the file for that format.
            if place == 0 && MAGIC_NUMBERS.iter().any(|begins| begins(&gaussian)) {
                gaussian[0] ^= 1;
            }
            writer.write_all(&gaussian).map_err(Error::write(path))?;
        }
        Ok(())
    })
}
