//! Values of an SPZ's streams.

use super::container::{self, Description, Streams};
use crate::axes::Axes;
use crate::codec::{Codec, Contents, WriteOptions, Writer};
use crate::invalid::InvalidGaussians;
use crate::rotations::normalized;
use crate::splat::logit_of_opacity;
use crate::{Error, Result, ShLimits, Splat};
use half::f16;
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::RangeInclusive;
use std::path::Path;

/// Functions of the format.
pub(crate) const CODEC: Option<Codec> = Some(Codec { read, writer: Some(Writer::new(write, limits)) });

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
///
/// # Errors
/// Returns an error for another version or a higher SH degree, or if the file is damaged, truncated, or claims more than it can hold.
fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
    let (description, streams) = container::read(path, bytes)?;
    let Description { version, fractional_bits, axes, .. } = description;
    let fixed = |bytes: &[u8; 3]| {
        let shifted = i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]); // moves the sign to the highest bit
        (f64::from(shifted >> 8) / f64::from(1u32 << fractional_bits)) as f32
    };
    let coordinates: Vec<f32> = match version {
        1 => {
            streams.positions.as_chunks().0.iter().map(|&bytes| f16::from_le_bytes(bytes).to_f32()).collect()
        }
        _ => streams.positions.as_chunks().0.iter().map(fixed).collect(),
    };
    let threes = |bytes: &[u8], number: &dyn Fn(u8) -> f64| -> Vec<[f32; 3]> {
        bytes.as_chunks().0.iter().map(|of_one: &[u8; 3]| of_one.map(|byte| number(byte) as f32)).collect()
    };
    let colors = threes(&streams.colors, &|byte| (f64::from(byte) / 255. - 0.5) / COLOR_SCALE);
    let harmonics = threes(&streams.harmonics, &|byte| (f64::from(byte) - 128.) / 128.);
    let bases = (description.sh_degree + 1).pow(2);
    let mut sh = Vec::with_capacity(colors.len() * bases);
    for (index, color) in colors.into_iter().enumerate() {
        sh.push(color);
        let of_one = &harmonics[index * (bases - 1)..][..bases - 1];
        sh.extend(of_one);
    }
    let rotations = match version {
        1 | 2 => {
            streams.rotations.as_chunks().0.iter().map(|&bytes| unpack_first_three(bytes)).collect::<Vec<_>>()
        }
        _ => streams.rotations.as_chunks().0.iter().map(|&bytes| unpack_smallest_three(bytes)).collect(),
    };
    let mut splat = Splat {
        means: coordinates.as_chunks().0.to_vec(),
        log_scales: threes(&streams.scales, &|byte| f64::from(byte) / LOG_SCALE_STEPS + LOG_SCALE_BEGIN),
        quaternions: rotations,
        opacity_logits: streams
            .opacities
            .iter()
            .map(|&byte| logit_of_opacity(f64::from(byte) / 255.))
            .collect(),
        sh,
        sh_degree: description.sh_degree,
        antialiased: description.antialiased,
        ..Splat::default()
    };
    axes.convert(&mut splat);
    let mut invalid = InvalidGaussians::default();
    invalid.add_all(&splat);
    Ok(Contents { splat, invalid })
}

/// Returns the limits of coefficients that a byte can represent.
fn limits() -> ShLimits {
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
///
/// # Errors
/// Returns an error if a position is too far away for 24 bits, or the file can't be written.
fn write(path: &Path, splat: &Splat, options: &WriteOptions) -> Result<()> {
    let version = options.spz_version;
    if !WRITTEN_VERSIONS.contains(&version) {
        return Err(Error::setting("the version of SPZ", version, "2 to 4"));
    }
    let farthest = splat.means.as_flattened().iter().fold(0f32, |farthest, x| farthest.max(x.abs()));
    let fits = |bits: &u32| f64::from(farthest) * f64::from(1u32 << bits) <= MAX_FIXED;
    let Some(fractional_bits) = (0..=MAX_FRACTIONAL_BITS).rev().find(fits) else {
        let limit = format!("at most {MAX_FIXED} in an SPZ");
        return Err(Error::failed(format!(
            "{}: a coordinate is {farthest}, expected {limit}",
            path.display()
        )));
    };
    let axes = Axes::RUB;
    let byte = |number: f64| number.round() as u8; // values outside of the range become 0 or 255
    let (mut positions, mut harmonics) = (vec![], vec![]);
    for mean in &splat.means {
        for coordinate in axes.position(*mean) {
            let fixed = (f64::from(coordinate) * f64::from(1u32 << fractional_bits)).round() as i32;
            positions.extend(&fixed.to_le_bytes()[..3]);
        }
    }
    let signs = axes.harmonics();
    for index in 0..splat.len() {
        for (basis, (color, sign)) in splat.sh_of(index)[1..].iter().zip(signs).enumerate() {
            let bits = SH_BITS[usize::from(basis >= 3)];
            harmonics.extend(color.map(|channel| pack_sh(sign * channel, bits)));
        }
    }
    let colors = (0..splat.len()).flat_map(|index| splat.sh_of(index)[0]);
    let scales = splat.log_scales.as_flattened().iter();
    let rotations = || (0..splat.len()).map(|index| axes.rotation(splat.unit_quaternion(index)));
    let streams = Streams {
        positions,
        opacities: (0..splat.len()).map(|index| byte(f64::from(splat.opacity(index)) * 255.)).collect(),
        colors: colors.map(|dc| byte((f64::from(dc) * COLOR_SCALE + 0.5) * 255.)).collect(),
        scales: scales.map(|&log| byte((f64::from(log) - LOG_SCALE_BEGIN) * LOG_SCALE_STEPS)).collect(),
        rotations: match version {
            2 => rotations().flat_map(pack_first_three).collect(),
            _ => rotations().flat_map(pack_smallest_three).collect(),
        },
        harmonics,
    };
    container::write(path, &Description::written(version, splat, fractional_bits), streams)
}

/// Rounds to the nearest of 2^`bits` values, one of which is 0.
fn pack_sh(value: f32, bits: u32) -> u8 {
    let step = f64::from(1u32 << (8 - bits));
    ((f64::from(value) * 128. / step).round() * step + 128.) as u8
}
