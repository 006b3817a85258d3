//! Textures of one material: paint, plastic, metal, clouds of noise; and the weathering of all textures.

use glam::Vec3;

use super::canvas::{Field, smoothstep};
use super::layout::Layout;
use super::noise::{Random, folded_fractal, fractal, ridge, smooth, unit_of, warped};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws an even color with a slightly uneven coat of paint.
pub(super) fn paint(random: &Random, purpose: Purpose) -> Surface {
    let mut canvas = Canvas::filled(SIZE, Palette::draw(random, purpose, 1).color(0));
    let coat = fractal(random, SIZE, [random.count(1, 4); 2], 4, 0.5);
    canvas.shade(&coat, random.sqrt_uniform(0.005, 0.12));
    if random.chance(0.6) {
        let coat = smooth(random, SIZE, [random.one_of(&[48, 96, 128]); 2]);
        canvas.shade(&coat.slope(random.direction()), random.sqrt_uniform(0.02, 0.25));
    }
    Surface { canvas, repeat_metres: random.uniform(2., 4.) }
}

/// Draws a soft gradient from one color to others and back.
pub(super) fn gradient(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 4));
    let (across, along) = random.one_of(&[(0., 1.), (1., 0.), (1., 1.), (1., -1.), (0., 2.)]);
    let drift = smooth(random, SIZE, [random.count(1, 3); 2]);
    let strength = random.sqrt_uniform(0.001, 0.25);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let turns = uv.x * across + uv.y * along + strength * drift.sample(uv);
        palette.ramp(0.5 - 0.5 * (turns * std::f32::consts::TAU).cos())
    });
    Surface { canvas, repeat_metres: random.uniform(1., 4.) }
}

/// Draws metal brushed in one direction.
pub(super) fn brushed(random: &Random, purpose: Purpose) -> Surface {
    let color = random_color_of_themes(random, &[(GRAYS, 4.), (BEIGES, 1.), (ACCENTS, 0.5)]);
    let mut canvas = Canvas::filled(SIZE, color);
    let cells = random.one_of(&[[2, 128], [128, 2], [4, 64], [64, 4], [1, 256]]);
    canvas.shade(&fractal(random, SIZE, cells, 2, 0.7), random.uniform(0.04, 0.2));
    canvas.shade(&smooth(random, SIZE, cells.map(|count| count.div_ceil(24))), random.uniform(0., 0.25));
    // Rust, mostly outdoors.
    if matches!(purpose, Purpose::Facade | Purpose::Ground) || random.chance(0.15) {
        let rust = srgb_to_linear(random.one_of(&[0x7a4426, 0x8f5a33, 0x5b3a2a]));
        let patches = fractal(random, SIZE, [3; 2], 6, 0.65);
        let level = random.uniform(0.1, 0.9);
        canvas.update_with(&patches, |pixel, value| {
            pixel.lerp(rust * (1. + 0.4 * value), ((value - level) * 5.).clamp(0., 0.9))
        });
    }
    Surface { canvas, repeat_metres: random.uniform(0.5, 1.5) }
}

/// Draws bright and dull spots as on polished or wet surfaces.
pub(super) fn glossy(random: &Random, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let lights = fractal(random, SIZE, [random.count(1, 3), random.count(1, 3)], 2, 0.4);
    let level = random.uniform(0.1, 0.6);
    let light = Vec3::splat(random.uniform(0.5, 0.9));
    let share = random.uniform(0.15, 0.5);
    let canvas = lights.map(|value| {
        (color * (1. + 0.15 * value)).lerp(light, share * smoothstep(level, level + 0.5, value))
    });
    Surface { canvas, repeat_metres: random.uniform(0.6, 2.) }
}

/// Draws a texture of a random kind of noise.
pub(super) fn clouds(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 5));
    let mut field = raw(random);
    if random.chance(0.4) {
        field = warped(random, &field, random.count(1, 6), random.sqrt_uniform(0.01, 0.2));
    }
    field = field.stretched();
    if random.chance(0.2) {
        // Flat patches, like camouflage or flaking paint.
        let steps = random.count(2, 6) as f32;
        let patch = |value: f32| smoothstep(0.42, 0.58, (value * steps).fract()) + (value * steps).floor();
        field = field.map(patch).stretched();
    }
    let contrast = random.uniform(0.6, 1.6);
    let canvas = field.map(|value| palette.ramp(0.5 + (value - 0.5) * contrast));
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.4, 4.) }
}

fn raw(random: &Random) -> Field {
    let cells = random.sqrt_uniform(1., 24.) as usize;
    let stretch = if random.chance(0.25) { random.one_of(&[[1, 4], [4, 1], [1, 8]]) } else { [1, 1] };
    let cells = stretch.map(|factor| cells * factor);
    let gain = random.uniform(0.4, 0.85);
    match random.count(0, 5) {
        0 | 1 => fractal(random, SIZE, cells, 7, gain),
        2 => folded_fractal(random, SIZE, cells, 6, gain, ridge),
        kind @ (3 | 4) => {
            let count = cells[0].max(3);
            let layout = Layout::cells(random, count, count, 0.95, false);
            if kind == 4 {
                let seed = random.seed();
                return Field::from_fn(SIZE, |uv| unit_of(seed, layout.piece(uv).id));
            }
            let (scale, hollow) = (count as f32, random.chance(0.5));
            Field::from_fn(SIZE, |uv| {
                let piece = layout.piece(uv);
                if hollow { piece.at.length() * scale } else { (piece.edge * scale * 3.).min(1.) }
            })
        }
        _ => smooth(random, SIZE, cells),
    }
}

/// Applies some of these effects, each with its own probability.
pub(super) fn weather(random: &Random, canvas: &mut Canvas, purpose: Purpose) {
    let outdoors = matches!(purpose, Purpose::Ground | Purpose::Facade | Purpose::Foliage);
    let often = if outdoors { 1.5 } else { 1. };
    if random.chance(0.18 * often) {
        dirt(random, canvas);
    }
    if random.chance(0.07 * often) {
        scratches(random, canvas);
    }
    if random.chance(0.25) {
        let patches = fractal(random, SIZE, [random.count(1, 3); 2], 2, 0.5);
        canvas.shade(&patches, random.uniform(0.03, 0.2));
    }
    if random.chance(0.3) {
        let grain = smooth(random, SIZE, [random.one_of(&[64, 128, 256]); 2]);
        canvas.shade(&grain, random.sqrt_uniform(0.01, 0.15));
    }
    if random.chance(0.3) {
        let tint = Vec3::new(random.approx_normal(), random.approx_normal(), random.approx_normal())
            * random.uniform(0.03, 0.15);
        canvas.update(|_, pixel| pixel * (1. + tint));
    }
    if random.chance(0.25) {
        let contrast = if random.chance(0.6) { random.uniform(0.25, 0.9) } else { random.uniform(1.1, 1.5) };
        let mean = canvas.mean();
        canvas.update(|_, pixel| mean + (pixel - mean) * contrast);
    }
    if random.chance(0.2) {
        let light = random.uniform(0.5, 1.3);
        canvas.update(|_, pixel| pixel * light);
    }
}

/// Adds patches of dust, moss or soot.
fn dirt(random: &Random, canvas: &mut Canvas) {
    let color =
        random_color_of_themes(random, &[(EARTHS, 4.), (GRAYS, 2.), (GREENS, 1.)]) * random.uniform(0.2, 1.);
    let cells = random.one_of(&[[2, 2], [3, 3], [5, 5], [8, 2]]);
    let patches = fractal(random, SIZE, cells, 6, random.uniform(0.5, 0.85));
    let (level, most) = (random.uniform(-0.3, 0.9), random.uniform(0.1, 0.6));
    canvas.update_with(&patches, |pixel, value| {
        pixel.lerp(color, most * smoothstep(level, level + 0.9, value))
    });
}

/// Adds thin brighter or darker lines.
fn scratches(random: &Random, canvas: &mut Canvas) {
    let lines = folded_fractal(random, SIZE, [random.count(2, 6); 2], 3, 0.6, ridge);
    let patches = smooth(random, SIZE, [4; 2]);
    let change = if random.chance(0.5) { random.uniform(0.1, 0.4) } else { -random.uniform(0.1, 0.5) };
    let width = random.uniform(0.05, 0.2);
    canvas.update(|uv, pixel| {
        let strength = smoothstep(1. - width, 1., lines.value(uv)) * patches.value(uv).clamp(0., 1.);
        pixel * (1. + change * strength)
    });
}
