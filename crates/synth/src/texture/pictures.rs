//! Pictures for walls: landscapes, abstract pictures, prints. One repeat is the whole picture.

use glam::{Vec2, Vec3};

use super::canvas::{Shape, coverage, smoothstep};
use super::figures::write;
use super::noise::fractal;
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};
use crate::random::Random;

/// Draws a picture of a random kind, often with a mat.
pub(super) fn picture(random: &Random, _: Purpose) -> Surface {
    let kind: fn(&Random) -> Canvas = random.one_of(&[landscape as _, shapes, dead_leaves, print]);
    let mut canvas = kind(random);
    if random.chance(0.5) {
        let (mat, margin) = (random_theme_color(random, WHITES), random.within(0.02..0.15));
        canvas.update(|uv, pixel| pixel.lerp(mat, coverage(uv.min(1. - uv).min_element() - margin)));
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.25, 1.4) }
}

/// Draws a landscape: sky over ranges of hills.
fn landscape(random: &Random) -> Canvas {
    let skies = [
        [0x5f93c9, 0xd6e4ee],
        [0x8fa5b5, 0xe3e0d8],
        [0x2e3f66, 0xe0946a],
        [0xb9a58a, 0xeee2c8],
        [0x22304a, 0x6d87a0],
    ];
    let [zenith, haze] = random.one_of(&skies).map(srgb_to_linear).map(|color| shade(random, color, 0.2));
    let clouds = fractal(random, [2, 5], 7, 0.6);
    let (level, cover) = (random.within(-0.5..1.), random.within(0. ..0.9));
    let horizon = random.within(0.35..0.75);
    let mut canvas = Canvas::from_fn(|uv| {
        let cloud = cover * smoothstep(level, level + 0.8, clouds.value(uv));
        zenith.lerp(haze, (uv.y / horizon).min(1.)).lerp(Vec3::splat(0.85).lerp(haze, 0.3), cloud)
    });
    let theme = random.weighted(&[(GREENS, 4.), (AUTUMN, 2.), (ACCENTS, 1.), (STONES, 1.)]);
    let ranges = random.within(2..=6);
    for range in 0..ranges {
        let near = (range + 1) as f32 / ranges as f32;
        let profile = fractal(random, [random.within(1..=4), 1], 6, random.within(0.3..0.65));
        let texture = fractal(random, [4, 16], 5, 0.8);
        let ground = random_theme_color(random, theme).lerp(haze, 0.75 * (1. - near));
        let base = horizon + (1. - horizon) * (near - 0.5 / ranges as f32) * 0.8;
        let height = random.within(0. ..0.18);
        canvas.update(|uv, below| {
            let top = base - height * (1. + profile.value(Vec2::new(uv.x, 0.)));
            below.lerp(ground * (1. + 0.35 * near * texture.value(uv)), coverage(top - uv.y))
        });
    }
    canvas
}

/// Draws an abstract picture of large flat shapes.
fn shapes(random: &Random) -> Canvas {
    let palette = Palette::draw(random, Purpose::Poster, random.within(3..=5));
    let mut canvas = Canvas::filled(palette.color(0));
    for _ in 0..random.within(3..=40) {
        let shape = Shape::draw(random, random.sqrt_uniform(0.03, 0.45)).turned(random.direction_in_plane());
        canvas.fill(random.point(), &shape, palette.any(random));
    }
    canvas
}

/// Draws overlapping shapes of all sizes, more of the small ones, as in the statistics of photos (dead leaves model).
fn dead_leaves(random: &Random) -> Canvas {
    let palettes = [Purpose::Thing, Purpose::Poster].map(|purpose| Palette::draw(random, purpose, 4));
    let mut canvas = Canvas::filled(palettes[0].color(0));
    let (light, decline) = (random.direction_in_plane(), random.sqrt_uniform(0.02, 0.3));
    for step in 0..random.within(40..=250) {
        // Large shapes first, so that they don't hide everything.
        let size = 0.4 / (1. + decline * step as f32) * random.within(0.6..1.5);
        let color =
            palettes[usize::from(random.chance(0.2))].ramp(random.within(0. ..1.)) * random.within(0.5..1.3);
        let shading = random.within(0. ..0.5);
        canvas.paint(
            random.point(),
            &Shape::draw(random, size).turned(random.direction_in_plane()),
            |offset| color * (1. + shading * offset.dot(light) / size).max(0.1),
        );
    }
    canvas
}

/// Draws a poster, a sign or a screen: paragraphs and pictures on paper.
fn print(random: &Random) -> Canvas {
    let mut canvas = Canvas::filled(Palette::draw(random, Purpose::Poster, 1).color(0));
    let inner = random.one_of(&[landscape as fn(&Random) -> Canvas, shapes, dead_leaves])(random);
    let mut top = 0.06;
    while top < 0.9 {
        let height = random.within(0.08..0.5f32).min(0.94 - top);
        let (corner, extent) = (Vec2::new(0.06, top), Vec2::new(0.88, height));
        if random.chance(0.3) {
            canvas.update(|uv, below| {
                let inside = (uv - corner).min(corner + extent - uv).min_element();
                below.lerp(inner.value(uv), 1. - coverage(inside))
            });
        } else {
            write(
                random,
                &mut canvas,
                corner,
                extent,
                random.sqrt_uniform(4. / SIZE as f32, 0.2).min(height),
            );
        }
        top += height + 0.03;
    }
    canvas
}
