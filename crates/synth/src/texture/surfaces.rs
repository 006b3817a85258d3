//! Textures of one material, which are mostly noise; and the weathering of all textures.

use glam::Vec3;

use super::canvas::smoothstep;
use super::noise::{fractal, smooth, warped};
use super::palette::*;
use super::{Canvas, Purpose, Surface};
use crate::random::Random;

/// Draws an even color with a slightly uneven coat of paint.
pub(super) fn paint(random: &Random, purpose: Purpose) -> Surface {
    let mut canvas = Canvas::filled(Palette::draw(random, purpose, 1).color(0));
    canvas.shade(&fractal(random, [random.within(1..=4); 2], 4, 0.5), random.sqrt_uniform(0.005, 0.12));
    Surface { canvas, repeat_metres: random.within(2. ..4.) }
}

/// Draws a soft gradient from one color to others and back.
pub(super) fn gradient(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(2..=4));
    let (across, along) = random.one_of(&[(0., 1.), (1., 0.), (1., 1.), (1., -1.), (0., 2.)]);
    let drift = smooth(random, [random.within(1..=3); 2]);
    let strength = random.sqrt_uniform(0.001, 0.25);
    let canvas = Canvas::from_fn(|uv| {
        let turns = uv.x * across + uv.y * along + strength * drift.value(uv);
        palette.ramp(0.5 - 0.5 * (turns * std::f32::consts::TAU).cos())
    });
    Surface { canvas, repeat_metres: random.within(1. ..4.) }
}

/// Draws clouds of noise in several colors: earth, rust, felt, sandstone.
pub(super) fn clouds(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.within(2..=5));
    let stretch = random.one_of(&[[1, 1], [1, 1], [1, 1], [1, 4], [4, 1]]);
    let cells = random.sqrt_uniform(1., 48.) as usize;
    let mut field = fractal(random, stretch.map(|factor| cells * factor), 7, random.within(0.4..0.9));
    if random.chance(0.4) {
        field = warped(random, &field, random.within(1..=6), random.sqrt_uniform(0.01, 0.2));
    }
    let contrast = random.within(0.2..0.8);
    let canvas = field.map(|value| palette.ramp(0.5 + value * contrast));
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.4, 4.) }
}

/// Draws plaster, stucco, pile or crumpled cloth: relief lit from the side.
pub(super) fn relief(random: &Random, purpose: Purpose) -> Surface {
    let mut canvas = Canvas::filled(Palette::draw(random, purpose, 1).color(0));
    let cells = random.sqrt_uniform(2., 64.) as usize;
    let stretch = random.one_of(&[[1, 1], [1, 1], [1, 3], [3, 1]]);
    let height = fractal(random, stretch.map(|factor| cells * factor), 5, random.within(0.5..0.9));
    canvas.shade(&height.slope(random.direction_in_plane()), random.within(0.1..0.9));
    canvas.shade(&height, random.within(0. ..0.2));
    Surface { canvas, repeat_metres: random.within(0.5..3.) }
}

/// Draws marble: thin and wide veins through clouds.
pub(super) fn marble(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, 2);
    let vein = random_theme_color(random, random.one_of(&[GRAYS, WHITES, BROWNS])) * random.within(0.3..1.);
    let clouds = fractal(random, [random.within(2..=4); 2], 6, 0.6);
    let veins = smooth(random, [random.within(1..=6), random.within(1..=6)]);
    let veins = warped(random, &veins, random.within(3..=6), random.within(0.03..0.15));
    let (width, share) = (random.sqrt_uniform(0.03, 0.35), random.within(0.3..1.));
    let canvas = Canvas::from_fn(|uv| {
        let cloud = clouds.value(uv);
        let thin = (1. - veins.value(uv).abs() / width).max(0.);
        palette.ramp(0.5 + 0.4 * cloud).lerp(vein, share * thin * (0.6 + 0.4 * cloud).clamp(0., 1.))
    });
    Surface { canvas, repeat_metres: random.within(0.6..2.5) }
}

/// Draws granite, concrete, asphalt or worktops: spots and grains of a few colors.
pub(super) fn speckle(random: &Random, purpose: Purpose) -> Surface {
    let base = Palette::draw(random, purpose, 1).color(0);
    let mut canvas = Canvas::filled(base);
    canvas.shade(&fractal(random, [3; 2], 7, 0.7), random.within(0.05..0.3));
    for _ in 0..random.within(2..=4) {
        let spots = smooth(random, [random.one_of(&[32, 48, 64, 96, 128, 256]); 2]);
        let color = shade(random, base, 0.7);
        let (level, share) = (random.within(0. ..0.9), random.within(0.3..1.));
        canvas.update_with(&spots, |pixel, value| {
            pixel.lerp(color, share * smoothstep(level, level + 0.3, value))
        });
    }
    Surface { canvas, repeat_metres: random.within(0.3..2.) }
}

/// Applies some of these effects, each with its own probability: dirt, grain, a tint, another contrast.
pub(super) fn weather(random: &Random, canvas: &mut Canvas) {
    if random.chance(0.25) {
        let color = random_theme_color(random, random.one_of(&[EARTHS, EARTHS, GRAYS, GREENS]));
        let color = color * random.within(0.2..1.);
        let patches = fractal(random, [random.within(2..=6); 2], 6, random.within(0.5..0.85));
        let (level, most) = (random.within(-0.3..0.9), random.within(0.1..0.6));
        canvas.update_with(&patches, |pixel, value| {
            pixel.lerp(color, most * smoothstep(level, level + 0.9, value))
        });
    }
    if random.chance(0.4) {
        let grain = smooth(random, [random.one_of(&[2, 64, 128, 256]); 2]);
        canvas.shade(&grain, random.sqrt_uniform(0.01, 0.15));
    }
    if random.chance(0.3) {
        let tint = Vec3::new(random.approx_normal(), random.approx_normal(), random.approx_normal());
        let tint = 1. + tint * random.within(0.03..0.15);
        canvas.update(|_, pixel| pixel * tint);
    }
    if random.chance(0.4) {
        let (contrast, mean) = (random.within(0.3..1.4), canvas.mean());
        canvas.update(|_, pixel| mean + (pixel - mean) * contrast);
    }
}
