//! Textures of planks, parquet and veneer.

use glam::{Vec2, Vec2Swizzles, Vec3};
use rand_chacha::ChaCha8Rng;

use super::field::Field;
use super::layout::Layout;
use super::noise::{fractal, smooth};
use super::palette;
use super::rng::{RandomValues, unit_of};
use super::shape::smoothstep;
use super::{Canvas, Purpose, SIZE, Surface};

/// Returns grain along u, about in [-1, 1]: rings cut lengthwise, stretched into fibres, with knots.
fn grain(random: &mut ChaCha8Rng) -> Field {
    let rings = random.count(2, 14) as f32;
    let cells = [random.count(1, 2), random.count(2, 5)];
    let bend = smooth(random, SIZE, cells);
    let sway = random.between(0.3, 2.5);
    let (drawn_out, wide) = (random.count(2, 6), random.count(4, 16));
    let fibres = fractal(random, SIZE, [drawn_out, 64], 3, 0.8);
    let streaks = fractal(random, SIZE, [1, wide], 3, 0.7);
    let [figure, fibre, streak] = [(); 3].map(|()| random.between(0.1, 1.));
    let knots: Vec<(Vec2, f32)> =
        (0..random.one_of(&[0, 0, 1, 2, 4])).map(|_| (random.spot(), random.between(0.01, 0.035))).collect();
    let mut index = 0;
    let field = Field::from_fn(SIZE, |uv| {
        let mut phase = uv.y * rings + sway * bend.values[index];
        let mut dark = 0.;
        for &(centre, radius) in &knots {
            let off = uv - centre;
            let off = (off - off.round()) * Vec2::new(0.5, 1.);
            let near = radius * radius / (off.length_squared() + radius * radius);
            phase += 2. * near;
            dark += smoothstep(0.5, 0.9, near);
        }
        // Latewood ends sharply: a sawtooth with a soft flank.
        let ring = phase - phase.floor();
        let ring = ring * ring * (1. - smoothstep(0.88, 1., ring));
        let value = figure * (1.4 * ring - 0.5)
            + fibre * 0.7 * fibres.values[index]
            + streak * 0.7 * streaks.values[index];
        index += 1;
        value + 2. * dark
    });
    let scale = 1. / (figure + fibre + streak);
    field.map(|value| value * scale)
}

/// Returns two colors of one wood: earlywood and latewood.
fn tones(random: &mut ChaCha8Rng) -> (Vec3, Vec3) {
    let theme = random.weighted(&[
        (palette::WOODS, 10.),
        (palette::GREYS, 1.),
        (palette::WHITES, 1.),
        (palette::ACCENTS, 0.7),
    ]);
    let light = palette::color_of(random, theme);
    let red = Vec3::new(1., random.between(0.82, 1.), random.between(0.65, 1.));
    (light, light * red * random.between(0.35, 0.85))
}

/// Draws boards or parquet with joints.
pub(super) fn boards(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let upright = random.happens(0.5);
    let rows = random.leaning_low(3., 16.) as usize;
    let long = random.count(2, 6);
    let outdoors = matches!(purpose, Purpose::Facade | Purpose::Ground);
    let kind = if outdoors { 9 } else { random.count(0, 9) };
    let (layout, wide) = match kind {
        0 => (Layout::Herringbone { across: 2 * long * random.count(1, 2), long }, 0.06),
        1 => {
            let squares = 2 * random.count(1, 4);
            (Layout::Basket { squares, long }, 1. / (squares * long) as f32)
        }
        2 => (Layout::courses(2 * rows.div_ceil(2), 2, 0.5, upright), 1. / rows as f32),
        _ => {
            let pieces = random.leaning_low(1., 4.);
            let unequal = random.one_of(&[0., 0., 0.6]);
            (Layout::ragged(random, rows, pieces, unequal, upright), 1. / rows as f32)
        }
    };
    let (light, dark) = tones(random);
    let grain = grain(random);
    let (seed, spread) = (random.seed(), random.leaning_low(0.02, 0.9));
    let contrast = random.between(0.3, 1.1);
    let joint = wide * random.leaning_low(0.005, 0.06);
    let depth = random.between(0.3, 0.9);
    let bevel = random.between(0., 0.3);
    let other = palette::color_of(random, palette::WOODS);
    let mixed = if random.happens(0.25) { random.between(0.2, 1.) } else { 0. };
    // With fewer boards, the grain appears larger.
    let scale = random.between(0.6, 1.6);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let piece = layout.piece(uv);
        let hash = |salt: u32| unit_of(seed ^ salt, piece.id);
        let value = grain.sample(piece.at * scale + Vec2::new(hash(1), hash(2)));
        let base = light.lerp(dark, (0.45 + contrast * value).clamp(0., 1.)).lerp(other, mixed * hash(3));
        let lightness = 1. + spread * (hash(4) - 0.5);
        let near = (piece.edge - joint) * SIZE as f32;
        let groove = 1. - depth * (0.5 - near * 0.7).clamp(0., 1.);
        let rounded = 1. - bevel * smoothstep(3., 0., near);
        base * lightness * groove * rounded
    });
    Surface { canvas, repeat_metres: random.between(0.07, 0.2) * (1. / wide).min(16.) }
}

/// Draws grain without joints, as on doors and tables.
pub(super) fn veneer(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let (light, dark) = tones(random);
    let grain = grain(random);
    let contrast = random.between(0.3, 1.2);
    let upright = random.happens(0.5);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let value = grain.sample(if upright { uv.yx() } else { uv });
        light.lerp(dark, (0.4 + contrast * value).clamp(0., 1.))
    });
    Surface { canvas, repeat_metres: random.between(0.4, 1.6) }
}
