//! Procedural reflectance textures of synthetic surfaces.
//!
//! A texture is drawn from a random family (bricks, planks, wallpaper), with probabilities that depend on its purpose, and then
//! weathered.

mod canvas;
mod figures;
mod layout;
mod noise;
mod palette;
mod pictures;
mod pieces;
mod surfaces;

use glam::{Vec2, Vec3};

use crate::random::Random;
use canvas::Canvas;

/// Width in pixels of all textures, a power of two.
const SIZE: usize = 256;

/// Minimum and maximum reflectance: no surface is perfectly black or white.
const REFLECTANCE: (f32, f32) = (0.02, 0.95);

/// Number of fractional bits of a position in repeats: as many as a float in [½, 1) has.
const PLACE_BITS: u32 = 24;

/// Reflectance that repeats in both directions: a mipmap of linear RGB squares whose widths are powers of two.
///
/// The coordinate u points right and v down, as in an image; (0, 0) is the upper left corner.
#[derive(Debug)]
pub(super) struct Texture {
    /// Mipmap levels, each half as wide as the previous one, down to a single texel. A texel holds the square roots of red, green
    /// and blue in bytes, and a fourth byte that is 0.
    levels: Vec<Vec<[u8; 4]>>,
    /// Typical width of one repeat in metres.
    pub repeat_metres: f32,
}

/// Kind of surface that a texture covers. The probabilities of the families depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    /// Indoor floor.
    Floor,
    /// Indoor wall.
    Wall,
    /// Indoor ceiling.
    Ceiling,
    /// Outdoor ground: grass, gravel, earth, asphalt, paving.
    Ground,
    /// Outdoor upright surface: walls of houses, fences, roofs.
    Facade,
    /// Furniture and other objects.
    Thing,
    /// Leaves of trees and hedges.
    Foliage,
    /// Pictures, signs and screens, where one repeat is the whole image.
    Poster,
}

/// Output of a family: the painted canvas and its width in metres.
struct Surface {
    canvas: Canvas,
    repeat_metres: f32,
}

/// A family of textures: a function that paints a surface.
type Family = fn(&Random, Purpose) -> Surface;

/// All families and their weights by purpose, in the order of [`Purpose`] without pictures.
#[rustfmt::skip]
const FAMILIES: [(Family, [f32; 7]); 20] = [
    //                     floor wall ceil grnd faca thing leaf
    (surfaces::paint,     [1.0, 9.0, 9.0, 0.5, 3.0, 8.0, 0.3]),
    (surfaces::gradient,  [0.2, 0.7, 0.5, 0.1, 0.3, 2.0, 0.2]),
    (surfaces::clouds,    [2.0, 1.5, 0.5, 4.0, 0.8, 2.5, 1.5]),
    (surfaces::relief,    [3.0, 4.0, 4.0, 1.0, 3.0, 3.0, 0.2]),
    (surfaces::marble,    [1.2, 0.5, 0.1, 0.2, 0.4, 1.5, 0.0]),
    (surfaces::speckle,   [3.0, 1.0, 1.0, 4.5, 2.0, 2.0, 0.0]),
    (pieces::bricks,      [0.6, 1.5, 0.1, 1.2, 5.0, 0.4, 0.0]),
    (pieces::tiles,       [5.0, 2.5, 1.0, 1.8, 1.0, 1.5, 0.0]),
    (pieces::stones,      [0.8, 0.6, 0.0, 2.5, 2.0, 0.3, 0.0]),
    (pieces::boards,      [7.0, 2.0, 2.0, 0.8, 3.0, 7.0, 0.0]),
    (pieces::checks,      [1.5, 1.0, 0.2, 0.4, 0.3, 1.5, 0.0]),
    (pieces::windows,     [0.0, 1.0, 1.0, 0.0, 5.0, 2.5, 0.0]),
    (figures::stripes,    [1.0, 2.4, 0.6, 0.1, 1.5, 3.5, 0.0]),
    (figures::weave,      [2.0, 0.6, 0.0, 0.0, 0.0, 4.0, 0.0]),
    (figures::motifs,     [1.5, 3.0, 0.4, 0.0, 0.3, 2.5, 0.0]),
    (figures::leaves,     [0.1, 0.1, 0.0, 2.0, 0.4, 0.3, 8.0]),
    (figures::grass,      [0.0, 0.0, 0.0, 5.0, 0.1, 0.1, 2.0]),
    (figures::gravel,     [0.3, 0.1, 0.0, 3.0, 0.4, 0.5, 0.1]),
    (figures::confetti,   [1.5, 0.9, 0.0, 0.6, 0.3, 1.7, 0.3]),
    (figures::writing,    [0.1, 0.6, 0.0, 0.2, 0.6, 1.8, 0.0]),
];

/// Draws one surface of one family.
fn surface(random: &Random, purpose: Purpose) -> Surface {
    let family = match purpose {
        Purpose::Poster => pictures::picture,
        _ => random.weighted(&FAMILIES.map(|(family, weights)| (family, weights[purpose as usize]))),
    };
    family(random, purpose)
}

/// Draws two surfaces, where one shows through worn parts of the other, or tints it.
fn combined(random: &Random, purpose: Purpose) -> Surface {
    let Surface { mut canvas, repeat_metres } = surface(random, purpose);
    let other = surface(random, purpose).canvas;
    let mask = noise::fractal(random, [random.within(1..=4); 2], 6, random.within(0.3..0.8));
    let (level, soft) = (random.within(-0.6..0.8), random.sqrt_uniform(0.03, 1.));
    let tints = random.chance(0.35);
    let mean = other.mean();
    canvas.update(|uv, pixel| {
        let other = other.value(uv);
        if tints {
            pixel * (0.5 + 0.5 * (other / mean.max(Vec3::splat(0.02))).min(Vec3::splat(2.)))
        } else {
            pixel.lerp(other, canvas::smoothstep(level, level + soft, mask.value(uv)))
        }
    });
    Surface { canvas, repeat_metres }
}

impl Texture {
    /// Draws a texture of a random family. The result depends only on `purpose` and the state of `random`.
    pub fn draw(random: &Random, purpose: Purpose) -> Texture {
        let mut surface =
            if random.chance(0.12) { combined(random, purpose) } else { surface(random, purpose) };
        surfaces::weather(random, &mut surface.canvas);
        Texture::from_surface(surface)
    }

    /// Creates a texture of one color.
    #[cfg(test)]
    pub fn uniform(color: Vec3) -> Texture {
        Texture::from_surface(Surface { canvas: Canvas::filled(color), repeat_metres: 1. })
    }

    /// Samples trilinearly at `uv` in repeats, for a footprint of width `footprint` in repeats.
    pub fn sample(&self, uv: Vec2, footprint: f32) -> Vec3 {
        let last = self.levels.len() - 1;
        let texels = (footprint * (1u32 << last) as f32).clamp(1., (1u32 << last) as f32);
        // Logarithm, linear between powers of two: the exponent, with the mantissa as the fractional part.
        let level = (texels.to_bits() - 1f32.to_bits()) as f32 * (1. / (1 << 23) as f32);
        let finer = (level as usize).min(last);
        let part = level - finer as f32;
        let place = |repeats: f32| (repeats * (1 << PLACE_BITS) as f32) as i64 as u32;
        let (x, y) = (place(uv.x), place(uv.y));
        let fine = self.bilinear(finer, x, y);
        if part == 0. { fine } else { fine.lerp(self.bilinear(finer + 1, x, y), part) }
    }

    /// Interpolates four texels of a level bilinearly, at a position in units of 2⁻²⁴ repeats.
    #[inline]
    fn bilinear(&self, level: usize, x: u32, y: u32) -> Vec3 {
        let shift = (self.levels.len() - 1 - level) as u32;
        let texels = self.levels[level].as_slice();
        let mask = (1usize << shift) - 1;
        let texel_bits = PLACE_BITS - shift;
        // Shift from texel corners to texel centers.
        let half = 1 << (texel_bits - 1);
        let (x, y) = (x.wrapping_sub(half), y.wrapping_sub(half));
        // 2^-texel_bits is built from its exponent, because a division would take as long as everything else.
        let texels_per_place = f32::from_bits((127 - texel_bits) << 23);
        let within = (1 << texel_bits) - 1;
        let right = (x & within) as i32 as f32 * texels_per_place;
        let down = (y & within) as i32 as f32 * texels_per_place;
        let (column, row) = ((x >> texel_bits) as usize, (y >> texel_bits) as usize);
        let (next_column, column) = ((column + 1) & mask, column & mask);
        let (next_row, row) = (((row + 1) & mask) << shift, (row & mask) << shift);
        let between = |row: usize| {
            let left = linear_of_texel(texels[row | column]);
            left + (linear_of_texel(texels[row | next_column]) - left) * right
        };
        let above = between(row);
        (above + (between(next_row) - above) * down).truncate()
    }

    fn from_surface(Surface { canvas, repeat_metres }: Surface) -> Texture {
        let (low, high) = REFLECTANCE;
        let mut size = SIZE;
        let mut texels: Vec<Vec3> =
            canvas.0.iter().map(|pixel| pixel.clamp(Vec3::splat(low), Vec3::splat(high))).collect();
        let mut levels = Vec::new();
        loop {
            levels.push(texels.iter().map(|&color| texel_of(color)).collect());
            if size == 1 {
                return Texture { levels, repeat_metres };
            }
            let halved = texels.chunks_exact(2 * size).flat_map(|rows| {
                let (above, below) = rows.split_at(size);
                let pairs = above.chunks_exact(2).zip(below.chunks_exact(2));
                pairs.map(|(above, below)| 0.25 * (above[0] + above[1] + below[0] + below[1]))
            });
            texels = halved.collect();
            size /= 2;
        }
    }
}

/// Encodes a color as square roots, because eyes and cameras resolve dark colors more finely.
fn texel_of(color: Vec3) -> [u8; 4] {
    let root = (color.map(f32::sqrt) * 255. + 0.5).as_u8vec3();
    [root.x, root.y, root.z, 0]
}

fn linear_of_texel(texel: [u8; 4]) -> glam::Vec4 {
    let root = glam::Vec4::from(texel.map(f32::from));
    root * root * (1. / (255. * 255.))
}

#[cfg(test)]
mod tests;
