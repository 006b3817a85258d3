//! Textures of invented writing and of scribbles.

use glam::{Vec2, Vec3};

use super::canvas::Shape;
use super::noise::Random;
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Glyphs of an invented script. A glyph consists of strokes between points of a 3 × 3 grid, in a box of height 1.
pub(super) struct Script {
    glyphs: Vec<Vec<(Vec2, Vec2)>>,
    /// Width of a glyph's box.
    aspect: f32,
    /// Half the width of a stroke.
    weight: f32,
}

impl Script {
    /// Draws a random script.
    pub fn draw(random: &Random) -> Script {
        let aspect = random.uniform(0.4, 0.8);
        let rounded = random.chance(0.5);
        let glyph = || {
            let mut strokes = Vec::new();
            // Most letters have a stem.
            if random.chance(0.7) {
                strokes.push((Vec2::new(0., -0.5), Vec2::new(0., 0.5)));
            }
            for _ in 0..random.count(1, 3) {
                let step = || random.count(0, 2) as f32 / 2.;
                let point = || Vec2::new(step() * aspect, step() - 0.5);
                let (from, to) = (point(), point());
                let bend = if rounded { (to - from).perp() * random.uniform(-0.4, 0.4) } else { Vec2::ZERO };
                let middle = 0.5 * (from + to) + bend;
                strokes.extend([(from, middle), (middle, to)]);
            }
            strokes
        };
        let glyphs = (0..random.count(10, 26)).map(|_| glyph()).collect();
        Script { glyphs, aspect, weight: random.uniform(0.05, 0.14) }
    }

    /// Writes a line of random words. The line is `length` long and `height` high, and `start` is the middle of its left edge, all in
    /// repeats of the texture.
    pub fn write(
        &self,
        random: &Random,
        canvas: &mut Canvas,
        start: Vec2,
        length: f32,
        height: f32,
        color: Vec3,
    ) {
        let advance = (self.aspect + 0.3) * height;
        let weight = (self.weight * height).max(0.35 / canvas.size as f32);
        let mut x = 0.;
        let mut letters = random.count(2, 9);
        while x + advance <= length {
            if letters == 0 {
                letters = random.count(1, 9);
                x += 0.6 * advance;
                continue;
            }
            letters -= 1;
            let glyph = random.count(0, self.glyphs.len() - 1);
            // A third of the glyphs are capitals; the others are shorter.
            let scale = if glyph.is_multiple_of(3) { 1. } else { 0.65 };
            for &(from, to) in &self.glyphs[glyph] {
                let place = |point: Vec2| {
                    Vec2::new(x, 0.)
                        + (point * Vec2::new(1., scale) + Vec2::new(0., 0.5 - 0.5 * scale)) * height
                };
                canvas.draw_line(start, place(from), place(to), weight, color);
            }
            x += advance;
        }
    }

    /// Fills the rectangle with its upper left corner at `corner` and the size `extent` with lines of writing, whose letters are `height`
    /// high.
    pub fn paragraph(
        &self,
        random: &Random,
        canvas: &mut Canvas,
        corner: Vec2,
        extent: Vec2,
        height: f32,
        color: Vec3,
    ) {
        let line_spacing = height * random.uniform(1.5, 2.2);
        let lines = (extent.y / line_spacing) as usize;
        for line in 0..lines {
            let ends_paragraph = line + 1 == lines || random.chance(0.1);
            let length =
                extent.x * if ends_paragraph { random.uniform(0.2, 0.9) } else { random.uniform(0.93, 1.) };
            let start = corner + Vec2::new(0., (line as f32 + 0.5) * line_spacing);
            self.write(random, canvas, start, length, height, color);
        }
    }
}

/// Returns a color of paper: white with the probability `white`, or a likely one for `purpose`.
pub(super) fn paper(random: &Random, purpose: Purpose, white: f32) -> Vec3 {
    if random.chance(white) {
        random_theme_color(random, WHITES)
    } else {
        Palette::draw(random, purpose, 1).color(0)
    }
}

/// Returns a color that is legible on `paper`.
pub(super) fn ink_for(random: &Random, paper: Vec3) -> Vec3 {
    let ink = random_color_of_themes(random, &[(GRAYS, 4.), (VIVID, 1.), (ACCENTS, 1.)]);
    if luminance(paper) > 0.3 { ink * 0.35 } else { Vec3::splat(0.75).lerp(ink, 0.3) }
}

/// Draws a texture of columns of writing, like newspapers, labels and notices.
pub(super) fn writing(random: &Random, purpose: Purpose) -> Surface {
    let paper = paper(random, purpose, 0.6);
    let mut canvas = Canvas::filled(SIZE, paper);
    let ink = ink_for(random, paper);
    let columns = random.count(1, 3);
    let height = random.sqrt_uniform(0.014, 0.1);
    let script = Script::draw(random);
    let margin = 0.03;
    for column in 0..columns {
        let width = 1. / columns as f32;
        let mut corner = Vec2::new(column as f32 * width + margin, margin);
        while corner.y < 0.9 {
            let extent = Vec2::new(width - 2. * margin, (0.97 - corner.y).min(random.uniform(0.15, 0.8)));
            match random.count(0, 5) {
                0 => script.write(random, &mut canvas, corner + Vec2::new(0., 0.05), extent.x, 0.05, ink),
                1 => {
                    let block = Palette::draw(random, Purpose::Poster, 1).color(0);
                    let half = Vec2::new(0.5 * extent.x, 0.45 * extent.y);
                    let middle = corner + half;
                    canvas.fill(middle, &Shape::rectangle(half, 0.), block);
                }
                _ => script.paragraph(random, &mut canvas, corner, extent, height, ink),
            }
            corner.y += extent.y.max(0.1);
        }
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.2, 1.5) }
}

/// Draws a texture of curly lines drawn by hand, as with chalk, crayons or spray paint.
pub(super) fn scribbles(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 5));
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    for _ in 0..random.count(1, 12) {
        let color = palette.any(random);
        let width = random.sqrt_uniform(0.8, 5.) / SIZE as f32;
        let mut at = random.point();
        let (mut angle, mut curl) = (random.uniform(0., 6.), 0.);
        let step_length = random.uniform(0.01, 0.04);
        for _ in 0..random.count(10, 120) {
            curl = 0.8 * curl + 0.3 * random.approx_normal();
            angle += curl;
            let step = Vec2::from_angle(angle) * step_length;
            canvas.fill(at + 0.5 * step, &Shape::stroke(-0.5 * step, 0.5 * step, width), color);
            at += step;
        }
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}
