//! Textures of marble, terrazzo, concrete, plaster and asphalt.

use glam::Vec2;
use rand_chacha::ChaCha8Rng;

use super::layout::Layout;
use super::noise::{fractal, ridged, smooth, warped};
use super::palette::{self, Palette};
use super::rng::{RandomValues, unit_of};
use super::shape::{self, smoothstep};
use super::voronoi::Voronoi;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws marble: thin and wide veins through clouds.
pub(super) fn marble(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::WHITES, 4.),
        (palette::GREYS, 2.),
        (palette::BEIGES, 2.),
        (palette::BROWNS, 1.),
        (palette::ACCENTS, 1.),
    ]);
    let palette = Palette::from_theme(random, theme, 2);
    let vein = if random.happens(0.7) {
        palette::color_of(random, palette::GREYS) * random.between(0.3, 1.)
    } else {
        let theme = random.one_of(&[palette::WHITES, palette::BROWNS, palette::AUTUMN]);
        palette::color_of(random, theme)
    };
    let cells = random.count(2, 4);
    let clouds = fractal(random, SIZE, [cells; 2], 6, 0.6);
    let reach = random.between(0.03, 0.15);
    let cells = [random.count(1, 4), random.count(1, 5)];
    let veins = smooth(random, SIZE, cells);
    let veins = warped(random, &veins, 3, reach);
    let cells = random.count(4, 9);
    let fine = smooth(random, SIZE, [cells; 2]);
    let fine = warped(random, &fine, 6, 0.04);
    let (width, fine_width) = (random.leaning_low(0.03, 0.35), random.leaning_low(0.02, 0.15));
    let (share, fine_share) = (random.between(0.3, 1.), random.between(0., 0.6));
    let mut index = 0;
    let canvas = Canvas::from_fn(SIZE, |_| {
        let i = index;
        index += 1;
        let ground = palette.ramp(0.5 + 0.4 * clouds.values[i]);
        let thin = |value: f32, width: f32| (1. - value.abs() / width).max(0.);
        let strength = share * thin(veins.values[i], width) * (0.6 + 0.5 * clouds.values[i]).clamp(0., 1.)
            + fine_share * thin(fine.values[i], fine_width) * (0.4 - 0.6 * clouds.values[i]).clamp(0., 1.);
        ground.lerp(vein, strength.min(0.95))
    });
    Surface { canvas, repeat_metres: random.between(0.6, 2.5) }
}

/// Draws terrazzo: chips of stone in cement.
pub(super) fn terrazzo(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let ground = Palette::draw(random, purpose, 1).color(0);
    let count = random.count(2, 5);
    let theme = random.weighted(&[
        (palette::STONES, 3.),
        (palette::WHITES, 1.),
        (palette::ACCENTS, 2.),
        (palette::BEIGES, 1.),
    ]);
    let palette = Palette::from_theme(random, theme, count);
    let across = random.count(14, 48);
    let voronoi = Voronoi::new(random, across, across, 1., false);
    let (seed, crowd) = (random.seed(), random.between(0.25, 0.9));
    let gap = random.between(0.04, 0.2) / across as f32;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let cell = voronoi.cell(uv);
        let hash = |salt: u32| unit_of(seed ^ salt, cell.id);
        if hash(0) > crowd {
            return ground;
        }
        let chip = palette.ramp(hash(1)) * (0.8 + 0.4 * hash(2));
        let inner = gap * (1. + 2. * hash(3));
        ground.lerp(chip, smoothstep(0., 1.5 / SIZE as f32, cell.edge - inner))
    });
    Surface { canvas, repeat_metres: across as f32 * random.between(0.01, 0.04) }
}

/// Draws granite, sandstone or worktops: grains of a few colors.
pub(super) fn speckle(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::STONES, 4.),
        (palette::GREYS, 3.),
        (palette::BEIGES, 2.),
        (palette::BROWNS, 1.),
    ]);
    let base = if random.happens(0.7) {
        palette::color_of(random, theme)
    } else {
        Palette::draw(random, purpose, 1).color(0)
    };
    let mut canvas = Canvas::filled(SIZE, base);
    for _ in 0..random.count(2, 4) {
        let grain = random.one_of(&[32, 48, 64, 96, 128]);
        let field = smooth(random, SIZE, [grain; 2]);
        let spots = palette::shade(random, base, 0.7);
        let level = random.between(0., 0.9);
        let share = random.between(0.3, 1.);
        for (pixel, value) in canvas.pixels.iter_mut().zip(&field.values) {
            *pixel = pixel.lerp(spots, share * smoothstep(level, level + 0.3, *value));
        }
    }
    Surface { canvas, repeat_metres: random.between(0.3, 1.2) }
}

/// Draws concrete with stains, pores and the joints of its formwork.
pub(super) fn concrete(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[(palette::GREYS, 3.), (palette::STONES, 4.), (palette::BEIGES, 1.)]);
    let base = palette::color_of(random, theme);
    let mut canvas = Canvas::filled(SIZE, base);
    canvas.shade(&fractal(random, SIZE, [3; 2], 7, 0.7), random.between(0.05, 0.3));
    let streaks = fractal(random, SIZE, [16, 2], 4, 0.6);
    canvas.shade(&streaks, random.leaning_low(0., 0.25));
    canvas.shade(&smooth(random, SIZE, [128; 2]), random.between(0.02, 0.12));
    for _ in 0..random.count(0, 250) {
        let radius = random.leaning_low(0.5, 2.5) / SIZE as f32;
        let dark = base * random.between(0.3, 0.8);
        canvas.fill(random.spot(), Vec2::splat(2. * radius), dark, |offset| shape::disk(offset, radius));
    }
    if random.happens(0.4) {
        let layout = Layout::courses(random.count(1, 3), random.count(1, 2), 0., false);
        let width = random.between(0.5, 2.) / SIZE as f32;
        let dark = random.between(0.3, 0.8);
        canvas.change(|uv, color| color * (1. - dark * smoothstep(2. * width, 0., layout.piece(uv).edge)));
    }
    Surface { canvas, repeat_metres: random.between(1., 4.) }
}

/// Draws plaster or stucco: relief lit from the side.
pub(super) fn plaster(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let mut canvas = Canvas::filled(SIZE, color);
    let cells = random.leaning_low(2., 48.) as usize;
    let gain = random.between(0.5, 0.9);
    let relief = match random.count(0, 3) {
        0 => ridged(random, SIZE, [cells; 2], 5, gain),
        1 => fractal(random, SIZE, [cells, 3 * cells], 5, gain),
        2 => {
            let strokes = fractal(random, SIZE, [cells, 2 * cells], 4, gain);
            warped(random, &strokes, 4, 0.12)
        }
        _ => fractal(random, SIZE, [cells; 2], 6, gain),
    };
    canvas.shade(&relief.slope(random.direction()), random.between(0.1, 0.9));
    canvas.shade(&relief, random.between(0., 0.08));
    canvas.shade(&fractal(random, SIZE, [2; 2], 4, 0.5), random.between(0., 0.1));
    Surface { canvas, repeat_metres: random.between(0.8, 3.) }
}

/// Draws asphalt, tarmac or worn roads: fine grit, patches and cracks.
pub(super) fn asphalt(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let base = palette::linear_of(random.one_of(&[0x4a4a4b, 0x5f5e5c, 0x6f6c68, 0x3a3a3c, 0x85817b]));
    let base = palette::shade(random, base, 0.15);
    let mut canvas = Canvas::filled(SIZE, base);
    canvas.shade(&smooth(random, SIZE, [256; 2]), random.between(0.15, 0.5));
    canvas.shade(&smooth(random, SIZE, [96; 2]), random.between(0.05, 0.25));
    canvas.shade(&fractal(random, SIZE, [2; 2], 5, 0.6), random.between(0.05, 0.25));
    if random.happens(0.5) {
        let cells = random.count(1, 3);
        let voronoi = Voronoi::new(random, cells + 1, cells + 1, 1., false);
        let [right, down] = [(); 2].map(|()| fractal(random, SIZE, [6; 2], 5, 0.65));
        let width = random.between(0.001, 0.006);
        let dark = random.between(0.3, 0.9);
        canvas.change(|uv, color| {
            let push = Vec2::new(right.sample(uv), down.sample(uv)) * 0.04;
            color * (1. - dark * smoothstep(width, 0.2 * width, voronoi.cell(uv + push).edge))
        });
    }
    if random.happens(0.2) {
        let paint = palette::linear_of(random.one_of(&[0xe8e6e0, 0xd8b23a]));
        let (from, half) = (random.unit(), random.between(0.02, 0.05));
        let worn = fractal(random, SIZE, [8; 2], 5, 0.8);
        canvas.change(|uv, color| {
            let off = uv.x - from;
            let inside = smoothstep(half, half - 0.006, (off - off.round()).abs());
            color.lerp(paint, inside * (0.8 + worn.sample(uv)).clamp(0., 0.95))
        });
    }
    Surface { canvas, repeat_metres: random.between(1.5, 4.) }
}
