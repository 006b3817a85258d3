//! Realistic colors, and palettes of a few that go together.

use glam::Vec3;

use super::Purpose;
use crate::random::Random;

/// Colors of one kind in sRGB, as 0xrrggbb.
pub(super) type Theme = &'static [u32];

/// Colors of painted walls, ceilings and paper.
pub(super) const WHITES: Theme =
    &[0xe6e3dc, 0xdcd8ce, 0xebe9e4, 0xd3d1cc, 0xe0d9cb, 0xd2d6d7, 0xf0eee8, 0xd9d3c4];
/// Colors between white and brown.
pub(super) const BEIGES: Theme = &[0xd9c8ac, 0xcbb994, 0xe2d3b7, 0xc4ae8b, 0xb9a58a, 0xd8cbb8, 0xc9b7a0];
/// Colors from nearly white to nearly black.
pub(super) const GRAYS: Theme =
    &[0xb8b6b2, 0x9a9a98, 0x7d7d7b, 0x5f6062, 0xcac9c5, 0x434547, 0x8d9296, 0x2b2c2e, 0xa8a49c];
/// Colors of leather, dark wood and old fabric.
pub(super) const BROWNS: Theme = &[0x6b4a32, 0x86613f, 0x4d3524, 0x9c7a55, 0x3b2a1f, 0x7a5a48, 0xa98763];
/// Colors of wood from birch to wenge, varnished or weathered.
pub(super) const WOODS: Theme = &[
    0xb98a56, 0xa06d3c, 0xd3ac77, 0x7b4e2b, 0x5a3a22, 0xc79d6b, 0xe0c295, 0x8c5a34, 0x9b8a75, 0x3a281c,
    0xb0794a, 0xcfb48c, 0x84807a,
];
/// Colors of grass and leaves.
pub(super) const GREENS: Theme =
    &[0x5d7a35, 0x47632b, 0x7f9447, 0x3a5127, 0x8a9a5b, 0x647f4d, 0xa3a860, 0x2f3f22, 0x4f7040, 0x6e8b3d];
/// Colors of dry grass and fallen leaves.
pub(super) const AUTUMN: Theme =
    &[0xb0803a, 0x8f5a2b, 0xc7a24f, 0x7a4526, 0xa8432a, 0xbfa56c, 0x6b5a33, 0xd4b878];
/// Colors of soil and sand.
pub(super) const EARTHS: Theme =
    &[0x8a6f4e, 0x6e573d, 0xa58a64, 0x55442f, 0xb99f78, 0x9a6b48, 0xc2a67c, 0x7b6a58];
/// Colors of stone, concrete and gravel.
pub(super) const STONES: Theme =
    &[0xa7a29a, 0x8b867d, 0xc1bab0, 0x6d6a66, 0xb3a58f, 0x94897b, 0xd2ccc2, 0x7c8083, 0x55534f];
/// Colors of fired clay and other bricks.
pub(super) const BRICKS: Theme =
    &[0x9a4b35, 0xa85c42, 0x7f3d2e, 0xb5714f, 0xc08a66, 0x6b4038, 0xb8a48c, 0x8c8680, 0xd8cfc2, 0xa3705a];
/// Moderately saturated colors of fabric and paint.
pub(super) const ACCENTS: Theme = &[
    0x2f4560, 0x5c7a8c, 0x8aa0a3, 0x7d8f6e, 0xa4b494, 0xc59a3f, 0xa8523c, 0x7a2e3a, 0xc7a0a0, 0x6a5a78,
    0x35605a, 0xd7b98e, 0x94b0c2, 0x3f5d45, 0xb57f6a, 0xdcc7c0, 0x4b6a8f,
];
/// Saturated colors of print, plastic and toys.
pub(super) const VIVID: Theme = &[
    0xd22f27, 0x1f5fbf, 0xf2b90c, 0x1f9d55, 0xe8671b, 0x8e2fa8, 0x12a3b8, 0xe84a8a, 0x161616, 0xfafafa,
    0x7ac143, 0x0b3c7d,
];

/// Themes and their weights by purpose, in the order of [`Purpose`].
#[rustfmt::skip]
const THEMES: [&[(Theme, f32)]; 8] = [
    &[(BEIGES, 3.), (GRAYS, 3.), (BROWNS, 3.), (WOODS, 3.), (STONES, 2.), (ACCENTS, 2.), (WHITES, 1.)],
    &[(WHITES, 5.), (BEIGES, 3.), (GRAYS, 2.), (ACCENTS, 3.), (STONES, 1.), (VIVID, 0.3)],
    &[(WHITES, 8.), (BEIGES, 1.5), (GRAYS, 1.), (WOODS, 0.7), (ACCENTS, 0.3)],
    &[(EARTHS, 3.), (STONES, 3.), (GRAYS, 2.), (GREENS, 3.), (AUTUMN, 1.), (BRICKS, 1.)],
    &[(WHITES, 3.), (BEIGES, 2.), (STONES, 2.), (BRICKS, 3.), (GRAYS, 2.), (ACCENTS, 1.5), (WOODS, 1.)],
    &[(WHITES, 2.), (BEIGES, 2.), (GRAYS, 3.), (BROWNS, 2.), (WOODS, 3.), (ACCENTS, 4.), (VIVID, 2.)],
    &[(GREENS, 8.), (AUTUMN, 2.), (EARTHS, 0.5), (ACCENTS, 0.5)],
    &[(ACCENTS, 4.), (VIVID, 3.), (WHITES, 1.), (BROWNS, 1.), (GRAYS, 2.), (GREENS, 1.)],
];

/// A few colors in linear RGB.
pub(super) struct Palette {
    colors: Vec<Vec3>,
}

impl Palette {
    /// Draws `count` colors that are likely for `purpose`.
    pub fn draw(random: &Random, purpose: Purpose, count: usize) -> Palette {
        Palette::among(random, THEMES[purpose as usize], count)
    }

    /// Draws `count` colors of one of the themes with the given weights.
    pub fn among(random: &Random, themes: &[(Theme, f32)], count: usize) -> Palette {
        Palette::from_theme(random, random.weighted(themes), count)
    }

    /// Draws `count` colors of one theme: shades of one color, several colors, one with accents, or rarely arbitrary colors.
    pub fn from_theme(random: &Random, theme: Theme, count: usize) -> Palette {
        let base = random_theme_color(random, theme);
        let kind = random.within(0. ..1.);
        let mut colors = vec![base];
        while colors.len() < count {
            colors.push(if kind < 0.4 {
                shade(random, base, 0.35)
            } else if kind < 0.68 {
                random_theme_color(random, theme)
            } else if kind < 0.94 {
                let themes = [(theme, 3.), (ACCENTS, 2.), (GRAYS, 1.), (WHITES, 1.), (VIVID, 0.5)];
                random_color_of_themes(random, &themes)
            } else {
                random_color(random)
            });
        }
        if kind > 0.97 {
            colors[0] = random_color(random);
        }
        Palette { colors }
    }

    /// Returns a random color of the palette.
    pub fn any(&self, random: &Random) -> Vec3 {
        random.one_of(&self.colors)
    }

    /// Returns the color at `index`, wrapping around after the last one.
    pub fn color(&self, index: usize) -> Vec3 {
        self.colors[index % self.colors.len()]
    }

    /// Returns the color at `t` in [0, 1], from the first to the last. Interpolates square roots, so that midpoints look halfway
    /// between in brightness.
    pub fn ramp(&self, t: f32) -> Vec3 {
        let last = self.colors.len() - 1;
        if last == 0 {
            return self.colors[0];
        }
        let at = t.clamp(0., 1.) * last as f32;
        let first = (at as usize).min(last - 1);
        let root = |index: usize| self.colors[index].map(f32::sqrt);
        let mixed = root(first).lerp(root(first + 1), at - first as f32);
        mixed * mixed
    }
}

/// Returns a random color of a theme, slightly varied.
pub(super) fn random_theme_color(random: &Random, theme: Theme) -> Vec3 {
    shade(random, srgb_to_linear(random.one_of(theme)), 0.12)
}

/// Returns a random color of one of the themes with the given weights.
pub(super) fn random_color_of_themes(random: &Random, themes: &[(Theme, f32)]) -> Vec3 {
    random_theme_color(random, random.weighted(themes))
}

/// Returns `color` made brighter or darker by about `spread`, with small random changes of saturation and hue.
pub(super) fn shade(random: &Random, color: Vec3, spread: f32) -> Vec3 {
    let gray = Vec3::splat(luminance(color));
    let saturation = random.within(0.65..1.2);
    let hue = Vec3::new(random.approx_normal(), random.approx_normal(), random.approx_normal()) * 0.05 + 1.;
    let light = random.approx_normal() * 1.8 * spread;
    // Darken and brighten by the same ratio, and never beyond white.
    let factor = if light < 0. { 1. / (1. - light) } else { 1. + light };
    let shaded = (gray + (color - gray) * saturation) * hue * factor;
    shaded.clamp(Vec3::splat(0.01), Vec3::splat(0.92))
}

/// Returns a color of random hue, brightness and saturation.
pub(super) fn random_color(random: &Random) -> Vec3 {
    let color = Vec3::new(random.within(0. ..1.), random.within(0. ..1.), random.within(0. ..1.));
    let gray = Vec3::splat(luminance(color));
    (gray + (color - gray) * random.within(0.3..1.3)).clamp(Vec3::splat(0.01), Vec3::splat(0.92))
}

/// Returns the luminance of a linear color, with Rec. 709's weights.
pub(super) fn luminance(color: Vec3) -> f32 {
    color.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

/// Converts sRGB 0xrrggbb to linear RGB.
pub(super) fn srgb_to_linear(srgb: u32) -> Vec3 {
    let [_, red, green, blue] = srgb.to_be_bytes();
    let linear =
        |value: f32| if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
    [red, green, blue].map(|byte| linear(f32::from(byte) / 255.)).into()
}
