//! PlayCanvas' compressed PLY (spec 10.12). Each Gaussian has four words of 32 bits, and a byte for each SH coefficient above degree 0.
//! Positions, scales and colors are quantized between the bounds of a chunk of 256 Gaussians.

use crate::morton::morton_order;
use crate::numbers::Scalar;
use crate::ply::degree_of_rest;
use crate::ply_table::Header;
use crate::rotations::{from_smallest_three, smallest_three};
use crate::splat::{bounds, color_to_sh0, logit_of_opacity, sh0_to_color};
use crate::{Error, Result, ShLimits, Splat, WriteOptions};
use globalsplat_files::write_atomically;
use std::path::Path;

/// Number of Gaussians in a chunk, which share their bounds.
const CHUNK: usize = 256;
/// Names of the values that are quantized between bounds: position, logarithm of the scale, color.
const BOUNDED: [[&str; 3]; 3] = [["x", "y", "z"], ["scale_x", "scale_y", "scale_z"], ["r", "g", "b"]];
/// Names of a Gaussian's four words.
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Numbers of bits of the three components of a position or scale.
const POSITION_BITS: [u32; 3] = [11, 10, 11];
/// Numbers of bits of the three smaller components of a quaternion, after two bits for the index of the largest one.
const ROTATION_BITS: [u32; 3] = [10, 10, 10];
/// Numbers of bits of red, green, blue and opacity.
const COLOR_BITS: [u32; 4] = [8, 8, 8, 8];
/// Largest magnitude of a log scale. Larger ones are clamped: they have no visible effect, but would widen the bounds of their chunk.
const MAX_LOG_SCALE: f32 = 20.;
/// Width of the range of SH coefficients, which is centered on 0.
const SH_RANGE: f64 = 8.;

/// Returns `true` if `bytes` are a compressed PLY.
pub(crate) fn recognizes(bytes: &[u8]) -> bool {
    let header = Header::begins(bytes).then(|| Header::parse(Path::new(""), bytes).ok()).flatten();
    header
        .is_some_and(|header| header.element("vertex").and_then(|vertex| vertex.property(WORDS[0])).is_some())
}

/// Reads a compressed PLY of any SH degree. In older files, which have no bounds of colors, the bounds are 0 and 1.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let header = Header::parse(path, bytes)?;
    let uint = Some(Scalar::U32);
    let words =
        header.columns(path, bytes, "vertex", &WORDS.map(String::from), uint, |number| number as u32)?;
    let (words, _) = words.as_chunks::<{ WORDS.len() }>();

    let has_color_bounds = header.element("chunk").is_some_and(|chunk| chunk.property("min_r").is_some());
    let bounded = if has_color_bounds { &BOUNDED[..] } else { &BOUNDED[..2] };
    let names = bounded.iter().flat_map(bound_names).collect::<Vec<_>>();
    let bounds = header.columns(path, bytes, "chunk", &names, None, |number| number as f32)?;
    let chunks: Vec<&[f32]> = bounds.chunks_exact(names.len()).collect();
    if chunks.len() < words.len().div_ceil(CHUNK) {
        let expected = format!("{} for {} Gaussians", words.len().div_ceil(CHUNK), words.len());
        return Err(Error::input(path, "the number of chunks", chunks.len(), expected));
    }

    let (rest, sh_degree) = read_rest(path, bytes, &header, words.len())?;
    let mut splat = Splat { sh_degree, antialiased: header.antialiased, ..Splat::default() };
    let bases = splat.bases();
    for (index, &[position, rotation, scale, color]) in words.iter().enumerate() {
        let bounds = chunks[index / CHUNK];
        let between = |bounds: &[f32], fractions: [f64; 3]| -> [f32; 3] {
            std::array::from_fn(|axis| {
                let (low, high) = (f64::from(bounds[axis]), f64::from(bounds[3 + axis]));
                (low * (1. - fractions[axis]) + high * fractions[axis]) as f32
            })
        };
        splat.means.push(between(&bounds[..6], unpack(position, POSITION_BITS)));
        splat.log_scales.push(between(&bounds[6..12], unpack(scale, POSITION_BITS)));
        splat
            .quaternions
            .push(from_smallest_three((rotation >> 30) as usize, unpack(rotation, ROTATION_BITS)));
        let [red, green, blue, opacity] = unpack(color, COLOR_BITS);
        let color = match bounds.get(12..) {
            Some(bounds @ [_, ..]) => between(bounds, [red, green, blue]),
            _ => [red, green, blue].map(|channel| channel as f32),
        };
        splat.opacity_logits.push(logit_of_opacity(opacity));
        splat.sh.push(color.map(|channel| color_to_sh0(channel.into())));
        let rest = &rest[index * 3 * (bases - 1)..];
        let of_channel = |channel: usize, basis: usize| unpack_sh(rest[channel * (bases - 1) + basis]);
        splat.sh.extend((0..bases - 1).map(|basis| [0, 1, 2].map(|channel| of_channel(channel, basis))));
    }
    Ok(splat)
}

/// Returns the bytes of the SH coefficients above degree 0, `[count, 3, bases - 1]`, and the degree.
fn read_rest(path: &Path, bytes: &[u8], header: &Header, count: usize) -> Result<(Vec<u8>, usize)> {
    let Some(element) = header.element("sh") else { return Ok((vec![], 0)) };
    let names: Vec<String> =
        (0..).map(|k| format!("f_rest_{k}")).take_while(|name| element.property(name).is_some()).collect();
    let degree = degree_of_rest(path, names.len())?;
    if element.count != count {
        let field = "the number of rows of the element sh";
        return Err(Error::input(path, field, element.count, format!("{count}, as many as Gaussians")));
    }
    Ok((header.columns(path, bytes, "sh", &names, Some(Scalar::U8), |number| number as u8)?, degree))
}

/// Returns the names of the lower bounds of three values, followed by those of the upper bounds.
fn bound_names(names: &[&str; 3]) -> Vec<String> {
    ["min", "max"].iter().flat_map(|end| names.map(|name| format!("{end}_{name}"))).collect()
}

/// Returns the range of SH coefficients that the format can store. Degree 0 is unlimited, because each chunk has its own bounds of colors.
pub(crate) fn limits() -> ShLimits {
    ShLimits { rest: -SH_RANGE / 2. ..=SH_RANGE / 2., ..ShLimits::up_to(3) }
}

/// Writes a compressed PLY. The Gaussians are in Morton order, so that those of a chunk are close together and the bounds are narrow.
pub(crate) fn write(path: &Path, splat: &Splat, _: &WriteOptions) -> Result<()> {
    let order = morton_order(&splat.means);
    let (mut limits, mut words) = (vec![], vec![]);
    for chunk in order.chunks(CHUNK) {
        // Returns the positions of the values of all Gaussians between the chunk's bounds: 0 at the lower bound, 1 at the upper bound.
        let mut quantize = |value_of: &dyn Fn(usize) -> [f32; 3]| -> Vec<[f64; 3]> {
            let values: Vec<[f32; 3]> = chunk.iter().map(|&index| value_of(index)).collect();
            let [low, high] = bounds(&values);
            limits.extend([low, high].as_flattened().iter().flat_map(|bound| bound.to_le_bytes()));
            let [low, width] =
                [low.map(f64::from), [0, 1, 2].map(|axis| f64::from(high[axis]) - f64::from(low[axis]))];
            let fraction = |value: f32, axis: usize| match width[axis] {
                0. => 0.,
                width => (f64::from(value) - low[axis]) / width,
            };
            values.iter().map(|value| [0, 1, 2].map(|axis| fraction(value[axis], axis))).collect()
        };
        let means = quantize(&|index| splat.means[index]);
        let log_scales =
            quantize(&|index| splat.log_scales[index].map(|log| log.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)));
        let colors = quantize(&|index| splat.sh_of(index)[0].map(|dc| sh0_to_color(dc) as f32));
        for (row, &index) in chunk.iter().enumerate() {
            let (largest, others) = smallest_three(splat.unit_quaternion(index));
            let [red, green, blue] = colors[row];
            let packed = [
                pack(means[row], POSITION_BITS),
                (largest as u32) << 30 | pack(others, ROTATION_BITS),
                pack(log_scales[row], POSITION_BITS),
                pack([red, green, blue, splat.opacity(index).into()], COLOR_BITS),
            ];
            words.extend(packed.iter().flat_map(|word| word.to_le_bytes()));
        }
    }
    let rest = order.iter().flat_map(|&index| {
        let rest = &splat.sh_of(index)[1..];
        (0..3).flat_map(move |channel| rest.iter().map(move |coefficients| pack_sh(coefficients[channel])))
    });
    let rest: Vec<u8> = rest.collect();
    let header = header(splat);
    write_atomically(path, |writer| {
        let parts = [header.as_bytes(), &limits, &words, &rest];
        parts.iter().try_for_each(|part| writer.write_all(part)).map_err(Error::write(path))
    })
}

fn header(splat: &Splat) -> String {
    let (count, bases) = (splat.len(), splat.bases());
    let mut lines =
        vec![format!("{}element chunk {}", Header::first_lines(splat.antialiased), count.div_ceil(CHUNK))];
    lines.extend(BOUNDED.iter().flat_map(bound_names).map(|name| format!("property float {name}")));
    lines.push(format!("element vertex {count}"));
    lines.extend(WORDS.iter().map(|name| format!("property uint {name}")));
    if bases > 1 {
        lines.push(format!("element sh {count}"));
        lines.extend((0..3 * (bases - 1)).map(|k| format!("property uchar f_rest_{k}")));
    }
    lines.push("end_header\n".into());
    lines.join("\n")
}

/// Packs values in [0, 1] into a word. The first value is in the highest bits, and each value has as many bits as `bits` says.
fn pack<const N: usize>(fractions: [f64; N], bits: [u32; N]) -> u32 {
    fractions.iter().zip(bits).fold(0, |word, (fraction, bits)| {
        let largest = (1u32 << bits) - 1;
        (word << bits) | ((fraction * f64::from(largest)).round() as u32).min(largest)
    })
}

/// Unpacks the values in [0, 1] that [`pack`] packed.
fn unpack<const N: usize>(mut word: u32, bits: [u32; N]) -> [f64; N] {
    let mut fractions = [0.; N];
    for (fraction, bits) in fractions.iter_mut().zip(bits).rev() {
        let largest = u32::MAX >> (32 - bits);
        *fraction = f64::from(word & largest) / f64::from(largest);
        word >>= bits;
    }
    fractions
}

/// Quantizes an SH coefficient to a byte. Values out of range are clamped.
fn pack_sh(value: f32) -> u8 {
    ((f64::from(value) / SH_RANGE + 0.5) * 256.) as u8
}

/// Returns the SH coefficient for `byte`: the middle of the values that [`pack_sh`] maps to it, or an end of the range for 0 and 255.
fn unpack_sh(byte: u8) -> f32 {
    let fraction = match byte {
        0 => 0.,
        255 => 1.,
        _ => (f64::from(byte) + 0.5) / 256.,
    };
    ((fraction - 0.5) * SH_RANGE) as f32
}
