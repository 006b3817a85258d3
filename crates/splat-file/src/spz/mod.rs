//! Niantic's SPZ (spec 10.13): a byte for most values, grouped by kind over all Gaussians, compressed. Versions 1 to 4 are read, versions
//! 2 to 4 are written. Rotations of version 2 have 8 bits per component, those of later versions 10.

mod container;

pub(crate) use container::recognizes;

use crate::axes::Axes;
use crate::rotations::normalized;
use crate::splat::logit_of_opacity;
use crate::{Error, Result, ShLimits, Splat, WriteOptions};
use container::Header;
use half::f16;
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::RangeInclusive;
use std::path::Path;

/// Versions that are written. Version 1 has positions in float16.
const WRITTEN_VERSIONS: RangeInclusive<u32> = 2..=4;
/// Factor of an SH coefficient of degree 0, to which ½ is added.
const COLOR_SCALE: f64 = 0.15;
/// Steps per unit of a scale's logarithm, counted from `LOG_SCALE_BEGIN`.
const LOG_SCALE_STEPS: f64 = 16.;
const LOG_SCALE_BEGIN: f64 = -10.;
/// Largest signed number of 24 bits.
const MAX_FIXED: f64 = ((1 << 23) - 1) as f64;
/// Maximum number of fractional bits of a position.
const MAX_FRACTIONAL_BITS: u32 = 24;
/// Largest value in nine bits, which hold the magnitude of a rotation's component other than the largest one.
const MAX_PART: u32 = (1 << 9) - 1;
/// Number of bits that are kept of the eight of an SH coefficient, for degree 1 and for higher degrees. Niantic's library keeps 5 and 4,
/// which costs splats with strongly view-dependent colors 10 dB and more between renders, and saves a third of the file (docs/splats.md).
const SH_BITS: [u32; 2] = [8, 7];

/// Reads an SPZ.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let (header, axes, streams) = container::read(path, bytes)?;
    let Header { version, sh_degree, fractional_bits, antialiased, has_levels, .. } = header;
    let [positions, opacities, colors, scales, rotations, harmonics, children] = streams;
    let opacity = |byte: u8| (f64::from(byte) / if has_levels { 127.5 } else { 255. }).min(1.);
    let fixed = |bytes: [u8; 3]| {
        let shifted = i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]); // moves the sign to the highest bit
        (f64::from(shifted >> 8) / f64::from(1u32 << fractional_bits)) as f32
    };
    let coordinates: Vec<f32> = match version {
        1 => positions.as_chunks().0.iter().map(|&bytes| f16::from_le_bytes(bytes).to_f32()).collect(),
        _ => positions.as_chunks().0.iter().map(|&bytes| fixed(bytes)).collect(),
    };
    let threes = |bytes: &[u8], number: &dyn Fn(u8) -> f64| -> Vec<[f32; 3]> {
        bytes.as_chunks().0.iter().map(|of_one: &[u8; 3]| of_one.map(|byte| number(byte) as f32)).collect()
    };
    let colors = threes(&colors, &|byte| (f64::from(byte) / 255. - 0.5) / COLOR_SCALE);
    let mut harmonics = threes(&harmonics, &|byte| (f64::from(byte) - 128.) / 128.).into_iter();
    let mut sh = vec![];
    for color in colors {
        sh.push(color);
        sh.extend(harmonics.by_ref().take((sh_degree + 1).pow(2) - 1));
    }
    let mut splat = Splat {
        means: coordinates.as_chunks().0.to_vec(),
        log_scales: threes(&scales, &|byte| f64::from(byte) / LOG_SCALE_STEPS + LOG_SCALE_BEGIN),
        quaternions: match version {
            1 | 2 => rotations.as_chunks().0.iter().map(|&bytes| unpack_first_three(bytes)).collect(),
            _ => rotations.as_chunks().0.iter().map(|&bytes| unpack_smallest_three(bytes)).collect(),
        },
        opacity_logits: opacities.iter().map(|&byte| logit_of_opacity(opacity(byte))).collect(),
        sh,
        sh_degree,
        antialiased,
        ..Splat::default()
    };
    axes.convert(&mut splat);
    if has_levels {
        let child_counts = children.as_chunks::<2>().0;
        let finest: Vec<usize> = (0..splat.len()).filter(|&index| child_counts[index] == [0; 2]).collect();
        let left_out = format!("{} of {} Gaussians are left out", splat.len() - finest.len(), splat.len());
        splat = splat.select(&finest);
        let which = "which are Spark's coarser levels of detail";
        splat.warnings.push(format!("{}: {left_out}, {which}", path.display()));
    }
    Ok(splat)
}

/// Returns the limits of coefficients that a byte can represent.
pub(crate) fn limits() -> ShLimits {
    let largest = f64::from(pack_sh(f32::MAX, SH_BITS[1]));
    let (dc, rest) = (0.5 / COLOR_SCALE, (largest - 128.) / 128.);
    ShLimits { degree: 3, dc: -dc..=dc, rest: -1. ..=rest }
}

/// Unpacks a rotation from x, y and z; w isn't negative.
fn unpack_first_three(bytes: [u8; 3]) -> [f32; 4] {
    let [x, y, z] = bytes.map(|byte| f64::from(byte) / 127.5 - 1.);
    let w = (1. - x * x - y * y - z * z).max(0.).sqrt();
    normalized([w, x, y, z].map(|part| part as f32))
}

fn pack_first_three([w, x, y, z]: [f32; 4]) -> [u8; 3] {
    [x, y, z].map(|part| ((f64::from(part * w.signum()) + 1.) * 127.5).round() as u8)
}

/// Unpacks a rotation from all but the largest of x, y, z and w, whose index is in the upper two bits.
fn unpack_smallest_three(bytes: [u8; 4]) -> [f32; 4] {
    let mut word = u32::from_le_bytes(bytes);
    let largest = (word >> 30) as usize;
    let mut parts = [0.; 4];
    for place in (0..4).rev().filter(|&place| place != largest) {
        let size = f64::from(word & MAX_PART) / f64::from(MAX_PART) * FRAC_1_SQRT_2;
        parts[place] = if word & (MAX_PART + 1) == 0 { size } else { -size };
        word >>= 10;
    }
    parts[largest] = (1. - parts.iter().map(|part| part * part).sum::<f64>()).max(0.).sqrt();
    let [x, y, z, w] = parts;
    normalized([w, x, y, z].map(|part| part as f32))
}

fn pack_smallest_three([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let parts = [x, y, z, w];
    let larger = |a: &usize, b: &usize| parts[*a].abs().total_cmp(&parts[*b].abs());
    let largest = (0..4).max_by(larger).expect("four parts");
    let others = (0..4).filter(|&place| place != largest).map(|place| parts[place]);
    let word = others.fold(largest as u32, |word, part| {
        let size = (f64::from(part.abs()) / FRAC_1_SQRT_2 * f64::from(MAX_PART)).round() as u32;
        let negative = part.is_sign_negative() != parts[largest].is_sign_negative();
        word << 10 | u32::from(negative) << 9 | size.min(MAX_PART)
    });
    word.to_le_bytes()
}

/// Writes an SPZ. Scales, colors and spherical harmonics outside of the range of a byte are clamped to it.
pub(crate) fn write(path: &Path, splat: &Splat, options: &WriteOptions) -> Result<()> {
    let version = options.spz_version;
    if !WRITTEN_VERSIONS.contains(&version) {
        return Err(Error::setting("the version of SPZ", version, "2 to 4"));
    }
    let farthest = splat.means.as_flattened().iter().fold(0f32, |farthest, x| farthest.max(x.abs()));
    let fits = |bits: &u32| f64::from(farthest) * f64::from(1u32 << bits) <= MAX_FIXED;
    let Some(fractional_bits) = (0..=MAX_FRACTIONAL_BITS).rev().find(fits) else {
        let (path, limit) = (path.display(), format!("at most {MAX_FIXED} in an SPZ"));
        return Err(Error::failed(format!("{path}: a coordinate is {farthest}, expected {limit}")));
    };
    let mut turned = splat.clone();
    Axes::RUB.convert(&mut turned);
    let all = 0..splat.len();
    let byte = |number: f64| number.round() as u8; // values outside of the range become 0 or 255
    let fixed = |&coordinate: &f32| {
        let fixed = (f64::from(coordinate) * f64::from(1u32 << fractional_bits)).round() as i32;
        fixed.to_le_bytes().into_iter().take(3)
    };
    let log_scales = splat.log_scales.as_flattened().iter();
    let rotations = all.clone().map(|index| turned.unit_quaternion(index));
    let harmonics = all.clone().flat_map(|index| {
        let rest = turned.sh_of(index)[1..].iter().enumerate();
        // The first three are of degree 1.
        rest.flat_map(|(basis, color)| {
            color.map(|channel| pack_sh(channel, SH_BITS[usize::from(basis >= 3)]))
        })
    });
    let streams = [
        turned.means.as_flattened().iter().flat_map(fixed).collect(),
        all.clone().map(|index| byte(f64::from(splat.opacity(index)) * 255.)).collect(),
        all.flat_map(|index| splat.sh_of(index)[0])
            .map(|dc| byte((f64::from(dc) * COLOR_SCALE + 0.5) * 255.))
            .collect(),
        log_scales.map(|&log| byte((f64::from(log) - LOG_SCALE_BEGIN) * LOG_SCALE_STEPS)).collect(),
        match version {
            2 => rotations.flat_map(pack_first_three).collect(),
            _ => rotations.flat_map(pack_smallest_three).collect(),
        },
        harmonics.collect(),
        vec![],
    ];
    let Splat { sh_degree, antialiased, .. } = *splat;
    let count = splat.len();
    let (has_extensions, has_levels) = (false, false);
    let header =
        Header { version, count, sh_degree, fractional_bits, antialiased, has_extensions, has_levels };
    container::write(path, &header, streams)
}

/// Rounds to the nearest of 2^`bits` values, one of which is 0.
fn pack_sh(value: f32, bits: u32) -> u8 {
    let step = f64::from(1u32 << (8 - bits));
    ((f64::from(value) * 128. / step).round() * step + 128.) as u8
}
