//! Noise textures colored by a palette ramp.

use rand_chacha::ChaCha8Rng;

use super::field::Field;
use super::noise::{fractal, ridged, smooth, warped};
use super::palette::Palette;
use super::rng::{RandomValues, unit_of};
use super::voronoi::Voronoi;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws a texture of a random kind of noise.
pub(super) fn clouds(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(2, 5);
    let palette = Palette::draw(random, purpose, count);
    let mut field = raw(random);
    if random.happens(0.4) {
        let (cells, reach) = (random.count(1, 6), random.leaning_low(0.01, 0.2));
        field = warped(random, &field, cells, reach);
    }
    let mut field = field.stretched();
    if random.happens(0.2) {
        // Flat patches, like camouflage or flaking paint.
        let steps = random.count(2, 6) as f32;
        field = field.map(|value| {
            super::shape::smoothstep(0.42, 0.58, (value * steps).fract()) + (value * steps).floor()
        });
        field = field.stretched();
    }
    let contrast = random.between(0.6, 1.6);
    let canvas = Canvas::of_field(&field, |value| palette.ramp(0.5 + (value - 0.5) * contrast));
    Surface { canvas, repeat_metres: random.leaning_low(0.4, 4.) }
}

fn raw(random: &mut ChaCha8Rng) -> Field {
    let cells = random.leaning_low(1., 24.) as usize;
    let stretch = if random.happens(0.25) { random.one_of(&[[1, 4], [4, 1], [1, 8]]) } else { [1, 1] };
    let cells = stretch.map(|factor| cells * factor);
    let gain = random.between(0.4, 0.85);
    match random.count(0, 5) {
        0 | 1 => fractal(random, SIZE, cells, 7, gain),
        2 => ridged(random, SIZE, cells, 6, gain),
        3 => {
            let count = cells[0].max(3);
            let voronoi = Voronoi::new(random, count, count, 0.95, false);
            let scale = count as f32;
            let hollow = random.happens(0.5);
            Field::from_fn(SIZE, |uv| {
                let cell = voronoi.cell(uv);
                if hollow { cell.offset.length() * scale } else { (cell.edge * scale * 3.).min(1.) }
            })
        }
        4 => {
            let count = cells[0].max(3);
            let voronoi = Voronoi::new(random, count, count, 0.95, false);
            let seed = random.seed();
            Field::from_fn(SIZE, |uv| unit_of(seed, voronoi.cell(uv).id))
        }
        _ => smooth(random, SIZE, cells),
    }
}
