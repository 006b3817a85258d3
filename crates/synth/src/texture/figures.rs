//! Textures of many figures on a ground: stripes, threads, motifs, leaves, grass, gravel, writing.

use glam::{Vec2, Vec3};

use super::canvas::Shape;
use super::noise::{fractal, unit_of};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};
use crate::random::Random;

/// Draws stripes of different widths, horizontal, upright or oblique, straight or wavy; or in both directions.
pub(super) fn stripes(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(2..=5));
    let widths: Vec<f32> = (0..random.within(2..=7)).map(|_| random.sqrt_uniform(0.05, 1.)).collect();
    let sum: f32 = widths.iter().sum();
    let ends: Vec<f32> = widths
        .iter()
        .scan(0., |end, width| {
            *end += width / sum;
            Some(*end)
        })
        .collect();
    let times = random.sqrt_uniform(1., 12.).floor();
    // Returns the color at position `at`, blended over one pixel at edges.
    let band = |at: f32| {
        let at = at.rem_euclid(1.);
        let index = ends.partition_point(|end| *end <= at).min(ends.len() - 1);
        let soft = (1. - (ends[index] - at) * SIZE as f32 / times).clamp(0., 1.);
        palette.color(index).lerp(palette.color((index + 1) % ends.len()), soft)
    };
    let direction = random.one_of(&[Vec2::X, Vec2::X, Vec2::Y, Vec2::ONE, Vec2::new(1., -1.)]);
    let wave = if random.chance(0.2) { random.within(0.02..0.3) } else { 0. };
    let waves = std::f32::consts::TAU * random.within(1..=6) as f32;
    let crossed = if random.chance(0.3) { 0.5 } else { 0. };
    let canvas = Canvas::from_fn(|uv| {
        let swing = wave * (waves * uv.dot(direction.perp())).sin();
        let along = band(uv.dot(direction) * times + swing);
        along.lerp(band(uv.dot(direction.perp()) * times), crossed)
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Draws threads that pass over and under each other.
pub(super) fn weave(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(1..=3));
    let threads = random.one_of(&[24, 32, 40, 48, 64]);
    let twill = random.one_of(&[1, 1, 2]);
    let (seed, spread, round) = (random.seed(), random.within(0.05..0.5), random.within(0.2..0.7));
    let canvas = Canvas::from_fn(|uv| {
        let at = uv * threads as f32;
        let (column, row) = (at.x as u32, at.y as u32);
        let part = at - at.floor() - 0.5;
        let over = (column + twill * row) % (2 * twill) < twill;
        let (thread, across) = if over { (column, part.x) } else { (row + 512, part.y) };
        let tone = palette.ramp(if over { 0. } else { 1. }) * (1. + spread * (unit_of(seed, thread) - 0.5));
        tone * (1. - round * 4. * across * across)
    });
    Surface { canvas, repeat_metres: random.within(0.15..0.8) }
}

/// Draws figures of one kind, nested in each other, on a straight, staggered or loose grid.
pub(super) fn motifs(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(2..=5));
    let mut canvas = Canvas::filled(palette.color(0));
    let rows = 2 * random.sqrt_uniform(1., 8.) as usize;
    let cell = 1. / rows as f32;
    let shift = if random.chance(0.6) { 0.5 } else { 0. };
    let loose = if random.chance(0.3) { random.within(0.1..0.8) } else { 0. };
    let mut share = random.within(0.15..0.5);
    let layers: Vec<Shape> = (0..random.within(1..=4))
        .map(|_| {
            share *= random.within(0.5..1.);
            Shape::draw(random, share * cell).turned(random.direction_in_plane())
        })
        .collect();
    for index in 0..rows * rows {
        let (column, row) = (index % rows, index / rows);
        let corner = Vec2::new(column as f32 + shift * (row % 2) as f32, row as f32);
        let center = (corner + 0.5 + (random.point() - 0.5) * loose) * cell;
        for (layer, shape) in layers.iter().enumerate() {
            canvas.fill(center, shape, palette.color(layer + 1));
        }
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Draws ground that lies below scattered figures.
fn ground(random: &Random, theme: Theme) -> Canvas {
    let palette = Palette::from_theme(random, theme, 2);
    let dark = random.within(0.35..1.);
    fractal(random, [random.within(2..=12); 2], 6, 0.75).map(|value| palette.ramp(0.5 + 0.5 * value) * dark)
}

/// Draws overlapping leaves, the upper ones brighter.
pub(super) fn leaves(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(GREENS, 5.), (AUTUMN, 2.)]);
    let length = random.sqrt_uniform(0.025, 0.16);
    let slim = random.within(0.25..0.9);
    let outline = |size: f32| Shape::leaf(size, slim * size);
    let below = ground(random, random.one_of(&[EARTHS, theme]));
    let canvas = scatter(random, below, theme, length, slim, outline);
    Surface { canvas, repeat_metres: random.within(0.04..0.1) / length }
}

/// Draws pebbles or chips, with shadows between them.
pub(super) fn gravel(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(STONES, 4.), (EARTHS, 2.), (GRAYS, 2.), (AUTUMN, 0.5)]);
    let length = random.sqrt_uniform(0.016, 0.12);
    let (corners, depth) = (random.within(3..=7), random.within(0. ..0.3));
    let canvas = scatter(random, ground(random, EARTHS), theme, length, 1., |size| {
        Shape::flower(0.5 * size, corners, depth)
    });
    Surface { canvas, repeat_metres: random.within(0.02..0.1) / length }
}

/// Draws bits of any shape in several colors: confetti, terrazzo, splashes.
pub(super) fn confetti(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(3..=5));
    let mut canvas = Canvas::filled(palette.color(0));
    let length = random.sqrt_uniform(0.02, 0.3);
    for _ in 0..(random.within(0.3..3.) / (length * length)).min(800.) as usize {
        let bit =
            Shape::draw(random, 0.5 * length * random.within(0.3..1.2)).turned(random.direction_in_plane());
        canvas.fill(random.point(), &bit, palette.any(random));
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.4, 3.) }
}

/// Covers `canvas` with shapes of about `length` and `slim` times as wide, lit from one side, the upper ones brighter.
fn scatter(
    random: &Random,
    mut canvas: Canvas,
    theme: Theme,
    length: f32,
    slim: f32,
    outline: impl Fn(f32) -> Shape,
) -> Canvas {
    let palette = Palette::from_theme(random, theme, 4);
    let count = ((random.within(0.3..2.4) / (length * length * slim * 0.5)) as usize).min(2600);
    let (light, strength, depth) =
        (random.direction_in_plane(), random.within(0.1..0.7), random.within(0.2..0.8));
    for index in 0..count {
        let size = length * random.within(0.5..1.4);
        let height = 1.15 - depth * (1. - index as f32 / count as f32) + 0.2 * random.approx_normal();
        let color = palette.ramp(random.within(0. ..1.)) * height.max(0.1);
        canvas.paint(random.point(), &outline(size).turned(random.direction_in_plane()), |offset| {
            color * (1. + 2. * strength * offset.dot(light) / size).max(0.1)
        });
    }
    canvas
}

/// Draws blades of grass, needles or straw.
pub(super) fn grass(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(GREENS, 6.), (AUTUMN, 1.5), (EARTHS, 0.5)]);
    let mut canvas = ground(random, random.one_of(&[EARTHS, theme]));
    let palette = Palette::from_theme(random, theme, 4);
    let (patches, bare) = (fractal(random, [3; 2], 4, 0.6), random.within(-1.5..0.3));
    let length = random.sqrt_uniform(0.025, 0.11);
    let (width, upright) = (random.within(0.4..1.2) / SIZE as f32, random.within(0. ..0.9));
    for _ in 0..(random.within(50. ..110.) / length) as usize {
        let root = random.point();
        let patch = patches.value(root);
        let lean = random.direction_in_plane() * (1. - upright) - Vec2::Y * upright;
        let half = lean * 0.5 * length * random.within(0.4..1.2);
        let color = palette.ramp(random.within(0. ..1.)) * random.within(0.45..1.25) * (1. + 0.2 * patch);
        if patch > bare {
            canvas.fill(root, &Shape::stroke(-half, half, width), color);
        }
    }
    Surface { canvas, repeat_metres: random.within(0.06..0.3) / length }
}

/// Draws lines of invented writing on paper, like newspapers, labels and notices.
pub(super) fn writing(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, 2);
    let mut canvas = Canvas::filled(palette.color(0));
    for _ in 0..random.within(1..=4) {
        let corner = 0.8 * random.point();
        let extent = (0.97 - corner).min(Vec2::new(random.within(0.2..1.), random.within(0.1..1.)));
        write(random, &mut canvas, corner, extent, random.sqrt_uniform(0.02, 0.2));
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.2, 1.5) }
}

/// Fills the rectangle with its upper left corner at `corner` and the size `extent` with lines of an invented script, whose letters are
/// `height` high. A glyph consists of strokes between points of a 3 × 3 grid.
pub(super) fn write(random: &Random, canvas: &mut Canvas, corner: Vec2, extent: Vec2, height: f32) {
    let paper = luminance(canvas.value(corner + 0.5 * extent));
    let ink = random_color_of_themes(random, &[(GRAYS, 4.), (VIVID, 1.), (ACCENTS, 1.)]);
    let ink = if paper > 0.3 { ink * 0.35 } else { Vec3::splat(0.75).lerp(ink, 0.3) };
    let weight = (random.within(0.05..0.14) * height).max(0.35 / SIZE as f32);
    let step = || random.within(0..=2) as f32 / 2.;
    let strokes =
        || (0..random.within(2..=4)).map(|_| [(); 2].map(|()| Vec2::new(0.6 * step(), step()))).collect();
    let glyphs: Vec<Vec<[Vec2; 2]>> = (0..random.within(10..=26)).map(|_| strokes()).collect();
    let (advance, spacing) = (0.9 * height, height * random.within(1.3..2.2));
    for line in 0..(extent.y / spacing) as usize {
        let letters = (extent.x / advance * random.one_of(&[1., 1., random.within(0.2..1.)])) as usize;
        for letter in 0..letters {
            // About one glyph in five is a space.
            let Some(glyph) = glyphs.get(random.within(0..=(glyphs.len() * 6 / 5))) else { continue };
            let place = corner + Vec2::new(letter as f32 * advance, line as f32 * spacing);
            for [from, to] in glyph {
                let (from, to) = (*from * height, *to * height);
                let middle = 0.5 * (from + to);
                canvas.fill(place + middle, &Shape::stroke(from - middle, to - middle, weight), ink);
            }
        }
    }
}
