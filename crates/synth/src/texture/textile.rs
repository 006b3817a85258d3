//! Textures of weaves, knits, piles, curtains and carpets.

use glam::Vec2;
use rand_chacha::ChaCha8Rng;

use super::noise::{fractal, smooth};
use super::palette::Palette;
use super::patterns::Motif;
use super::rng::{RandomValues, unit_of};
use super::shape::{self, smoothstep};
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws threads that pass over and under each other.
pub(super) fn weave(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(1, 3);
    let palette = Palette::draw(random, purpose, count);
    let threads = random.one_of(&[24, 32, 40, 48, 64]);
    let twill = random.one_of(&[1, 1, 2, 3]);
    let (seed, spread) = (random.seed(), random.between(0.05, 0.5));
    let uneven = smooth(random, SIZE, [6; 2]);
    let (round, drift) = (random.between(0.2, 0.7), random.between(0., 0.15));
    let scale = threads as f32;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let at = uv * scale;
        let (column, row) = (at.x as u32, at.y as u32);
        let part = at - at.floor() - 0.5;
        let over = (column + twill * row) % (2 * twill) < twill;
        let (thread, across) = if over { (column, part.x) } else { (row + 512, part.y) };
        let tone = palette.ramp(if over { 0. } else { 1. }) * (1. + spread * (unit_of(seed, thread) - 0.5));
        tone * (1. - round * 4. * across * across) * (1. + drift * uneven.sample(uv))
    });
    Surface { canvas, repeat_metres: random.between(0.15, 0.8) }
}

/// Draws knitted rows of loops.
pub(super) fn knit(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(1, 3);
    let palette = Palette::draw(random, purpose, count);
    let columns = random.one_of(&[12, 16, 24, 32]);
    let seed = random.seed();
    let banded = random.happens(0.4);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let at = uv * columns as f32;
        let side = (at.x.fract() - 0.5).abs();
        // Each loop is a V: two legs that rise outwards.
        let climbed = at.y + side * 1.4;
        let row = climbed.floor() as u32 % columns;
        let (along, across) = (climbed.fract() - 0.5, side - 0.25);
        let thick = 1. - 3. * along * along - 5. * across * across;
        let id = if banded { row / 3 } else { row * 64 + at.x as u32 };
        palette.ramp(unit_of(seed, id)) * (0.25 + 0.75 * thick.max(0.))
    });
    Surface { canvas, repeat_metres: random.between(0.1, 0.6) }
}

/// Draws carpet pile, felt or fur: fine and soft, brushed in some places.
pub(super) fn pile(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(1, 3);
    let palette = Palette::draw(random, purpose, count);
    let fine = random.one_of(&[64, 96, 128, 200]);
    let stretch = random.one_of(&[[1, 1], [1, 1], [1, 3], [3, 1]]);
    let tufts = fractal(random, SIZE, stretch.map(|share| fine / share), 2, 0.8);
    let brushed = fractal(random, SIZE, [3; 2], 3, 0.5);
    let mixed = random.between(0.1, 0.6);
    let mut canvas = Canvas::of_field(&tufts, |value| palette.ramp(0.5 + mixed * value));
    canvas.shade(&tufts, random.between(0.05, 0.35));
    canvas.shade(&brushed, random.leaning_low(0., 0.25));
    Surface { canvas, repeat_metres: random.between(0.4, 1.6) }
}

/// Draws cloth hanging in folds along v.
pub(super) fn folds(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(1, 3);
    let palette = Palette::draw(random, purpose, count);
    let depth = random.between(0.15, 0.7);
    let (coarse, fine) = (random.count(4, 10), random.count(12, 28));
    let folds =
        smooth(random, SIZE, [coarse, 1]).plus(&smooth(random, SIZE, [fine, 2]), random.between(0.1, 0.7));
    let printed = random.happens(0.3);
    let bands = random.count(2, 8) as f32;
    let mut index = 0;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let fold = folds.values[index];
        index += 1;
        let tone = if printed { (uv.y * bands).fract() } else { 0.5 + 0.3 * fold };
        palette.ramp(tone) * (1. + depth * fold).clamp(0.2, 1.6)
    });
    Surface { canvas, repeat_metres: random.between(0.8, 2.) }
}

/// Draws padded leather or cloth, buttoned in diamonds or stitched in channels.
pub(super) fn quilted(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let across = random.count(2, 8) as f32;
    let kind = random.count(0, 2);
    let (deep, light) = (random.between(0.3, 0.8), random.direction());
    let height = super::Field::from_fn(SIZE, |uv| {
        let at = match kind {
            0 => Vec2::new(uv.x + uv.y, uv.x - uv.y) * across,
            1 => uv * across,
            _ => Vec2::new(uv.x * across, 0.5),
        };
        let part = (at - at.floor() - 0.5) * 2.;
        ((1. - part.x.powi(4)) * (1. - part.y.powi(4))).sqrt()
    });
    let mut canvas = Canvas::of_field(&height, |value| color * (1. - deep + deep * value));
    canvas.shade(&height.slope(light), random.between(1., 5.));
    canvas.shade(&fractal(random, SIZE, [24; 2], 4, 0.8), random.between(0.01, 0.12));
    Surface { canvas, repeat_metres: across * random.between(0.06, 0.2) }
}

/// Draws a whole carpet: borders around a field of small figures, with a medallion in the middle.
pub(super) fn carpet(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let count = random.count(3, 5);
    let theme = random.weighted(&[
        (super::palette::ACCENTS, 5.),
        (super::palette::BROWNS, 2.),
        (super::palette::BEIGES, 2.),
        (super::palette::GREYS, 1.),
        (super::palette::VIVID, 0.5),
    ]);
    let palette = Palette::from_theme(random, theme, count);
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    let middle = Vec2::splat(0.5);
    // Paint the middle first, so that the borders cover what extends too far.
    let cells = random.count(4, 14);
    let small = Motif::draw(random, &palette);
    let crowd = random.between(0.3, 1.);
    for index in 0..cells * cells {
        let place = Vec2::new((index % cells) as f32, (index / cells) as f32) + 0.5;
        if random.happens(crowd) {
            small.paint(&mut canvas, place / cells as f32, 1. / cells as f32, Vec2::X);
        }
    }
    if random.happens(0.65) {
        let petals = 2 * random.count(2, 9);
        let (mut radius, depth) = (random.between(0.15, 0.38), random.between(0., 0.6));
        let squeeze = Vec2::new(1., random.between(0.7, 1.4));
        for layer in 0..random.count(2, 7) {
            let color = palette.color(layer + 1);
            canvas.fill(middle, Vec2::splat(0.5), color, |offset| {
                shape::flower(offset * squeeze, radius, petals, depth)
            });
            radius *= random.between(0.6, 0.9);
        }
        Motif::draw(random, &palette).paint(&mut canvas, middle, 2. * radius, Vec2::X);
    }
    let mut inset = 0.;
    for border in 0..random.count(1, 6) {
        let width = random.leaning_low(0.005, 0.07);
        let (color, other) = (palette.color(border + 1), palette.color(border + 2));
        let teeth = random.one_of(&[0., 0., 12., 20., 32., 48.]);
        canvas.change(|uv, below| {
            let from_edge = uv.min(1. - uv).min_element();
            let share = smoothstep(-1., 1., (inset + width - from_edge) * SIZE as f32);
            let outside = smoothstep(-1., 1., (inset - from_edge) * SIZE as f32);
            let along = if uv.x.min(1. - uv.x) < uv.y.min(1. - uv.y) { uv.y } else { uv.x };
            let tooth = (along * teeth).fract() * 2. - 1.;
            let toothed = teeth > 0. && (from_edge - inset) / width > tooth.abs();
            below.lerp(if toothed { other } else { color }, share * (1. - outside))
        });
        inset += width;
    }
    canvas.shade(&smooth(random, SIZE, [128; 2]), random.between(0.03, 0.2));
    Surface { canvas, repeat_metres: random.between(1.5, 3.5) }
}
