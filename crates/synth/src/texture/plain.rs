//! Textures of paint, plastic and metal: one color with small variations.

use glam::Vec3;
use rand_chacha::ChaCha8Rng;

use super::noise::{fractal, smooth};
use super::palette::{self, Palette};
use super::rng::RandomValues;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws an even color with a slightly uneven coat of paint.
pub(super) fn paint(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let mut canvas = Canvas::filled(SIZE, color);
    let cells = random.count(1, 4);
    canvas.shade(&fractal(random, SIZE, [cells; 2], 4, 0.5), random.leaning_low(0.005, 0.12));
    if random.happens(0.6) {
        let grain = random.one_of(&[48, 96, 128]);
        let coat = smooth(random, SIZE, [grain; 2]);
        canvas.shade(&coat.slope(random.direction()), random.leaning_low(0.02, 0.25));
    }
    Surface { canvas, repeat_metres: random.between(2., 4.) }
}

/// Draws a soft gradient from one color to others and back.
pub(super) fn gradient(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(2, 4);
    let palette = Palette::draw(random, purpose, count);
    let (across, along) = random.one_of(&[(0., 1.), (1., 0.), (1., 1.), (1., -1.), (0., 2.)]);
    let cells = random.count(1, 3);
    let drift = smooth(random, SIZE, [cells; 2]);
    let strength = random.leaning_low(0.001, 0.25);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let turns = uv.x * across + uv.y * along + strength * drift.sample(uv);
        palette.ramp(0.5 - 0.5 * (turns * std::f32::consts::TAU).cos())
    });
    Surface { canvas, repeat_metres: random.between(1., 4.) }
}

/// Draws metal brushed in one direction.
pub(super) fn brushed(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[(palette::GREYS, 4.), (palette::BEIGES, 1.), (palette::ACCENTS, 0.5)]);
    let color = palette::color_of(random, theme);
    let mut canvas = Canvas::filled(SIZE, color);
    let cells = random.one_of(&[[2, 128], [128, 2], [4, 64], [64, 4], [1, 256]]);
    canvas.shade(&fractal(random, SIZE, cells, 2, 0.7), random.between(0.04, 0.2));
    canvas.shade(&smooth(random, SIZE, cells.map(|count| count.div_ceil(24))), random.between(0., 0.25));
    // Rust, mostly outdoors.
    if matches!(purpose, Purpose::Facade | Purpose::Ground) || random.happens(0.15) {
        let rust = palette::linear_of(random.one_of(&[0x7a4426, 0x8f5a33, 0x5b3a2a]));
        let patches = fractal(random, SIZE, [3; 2], 6, 0.65);
        let level = random.between(0.1, 0.9);
        for (pixel, value) in canvas.pixels.iter_mut().zip(&patches.values) {
            *pixel = pixel.lerp(rust * (1. + 0.4 * value), ((value - level) * 5.).clamp(0., 0.9));
        }
    }
    Surface { canvas, repeat_metres: random.between(0.5, 1.5) }
}

/// Draws bright and dull spots as on polished or wet surfaces.
pub(super) fn glossy(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let cells = [random.count(1, 3), random.count(1, 3)];
    let lights = fractal(random, SIZE, cells, 2, 0.4);
    let level = random.between(0.1, 0.6);
    let light = Vec3::splat(random.between(0.5, 0.9));
    let share = random.between(0.15, 0.5);
    let canvas = Canvas::of_field(&lights, |value| {
        let bright = super::shape::smoothstep(level, level + 0.5, value);
        (color * (1. + 0.15 * value)).lerp(light, share * bright)
    });
    Surface { canvas, repeat_metres: random.between(0.6, 2.) }
}
