//! Textures of bricks, tiles, paving and stone walls.

use glam::Vec2;
use rand_chacha::ChaCha8Rng;

use super::field::Field;
use super::layout::Layout;
use super::noise::{fractal, smooth};
use super::palette::{self, Palette, luminance};
use super::rng::{RandomValues, unit_of};
use super::shape::smoothstep;
use super::voronoi::Voronoi;
use super::{Canvas, Purpose, SIZE, Surface};

/// Appearance of pieces and of the joints between them; lengths in repeats.
struct Finish {
    /// Colors of the pieces.
    palette: Palette,
    /// Color of the joints.
    joint: glam::Vec3,
    /// Half the width of a joint.
    joint_width: f32,
    /// Distance from a joint over which pieces are rounded.
    rounding: f32,
    /// Extra brightness of the middle of a piece.
    bulge: f32,
    /// Difference in lightness between pieces.
    spread: f32,
    /// Roughness of the pieces.
    roughness: f32,
    /// Crookedness of the edges.
    crookedness: f32,
}

fn lay(random: &mut ChaCha8Rng, layout: &Layout, finish: &Finish) -> Canvas {
    let rough = fractal(random, SIZE, [16; 2], 4, 0.8);
    let stains = fractal(random, SIZE, [4; 2], 4, 0.6);
    let [right, down] = [(); 2].map(|()| fractal(random, SIZE, [12; 2], 3, 0.6));
    let seed = random.seed();
    let light = random.direction();
    let mut index = 0;
    let mut height = Field { size: SIZE, values: vec![0.; SIZE * SIZE] };
    let mut canvas = Canvas::from_fn(SIZE, |uv| {
        let push = Vec2::new(right.values[index], down.values[index]) * finish.crookedness;
        let piece = layout.piece(uv + push);
        let (rough, stain) = (rough.values[index], stains.values[index]);
        let on_piece = smoothstep(0., 2. / SIZE as f32, piece.edge - finish.joint_width + 0.5 / SIZE as f32);
        let raised = ((piece.edge - finish.joint_width) / finish.rounding).clamp(0., 1.);
        height.values[index] = raised * (2. - raised);
        index += 1;
        let tone = unit_of(seed, piece.id);
        let lightness = 1. + finish.spread * (unit_of(seed ^ 1, piece.id) - 0.5);
        let texture = 1. + finish.roughness * (rough + 0.6 * stain);
        let middle = 1. - finish.bulge * (1. - raised);
        let color = finish.palette.ramp(tone) * (lightness * texture * middle).max(0.15);
        let joint = finish.joint * (1. + 0.25 * rough).max(0.3);
        joint.lerp(color, on_piece)
    });
    canvas.shade(&height.slope(light), random.between(0., 0.6));
    canvas
}

fn joint_color(random: &mut ChaCha8Rng, theme: palette::Theme) -> glam::Vec3 {
    let other =
        random.weighted(&[(palette::STONES, 4.), (palette::GREYS, 2.), (palette::WHITES, 2.), (theme, 1.)]);
    palette::color_of(random, other) * random.between(0.5, 1.)
}

/// Draws a texture of courses of bricks.
pub(super) fn bricks(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::BRICKS, 6.),
        (palette::STONES, 1.),
        (palette::WHITES, 1.),
        (palette::GREYS, 1.),
    ]);
    let rows = 2 * random.count(3, 8);
    let columns = (rows as f32 / random.between(2.2, 3.6)).round().max(1.) as usize;
    let upright = random.happens(0.05);
    let layout = match random.count(0, 9) {
        0 => Layout::courses(rows, columns, 0., upright),
        1 => Layout::Herringbone { across: rows / 2 * 6, long: 3 },
        2 | 3 => Layout::ragged(random, rows, columns as f32, 0.4, upright),
        _ => Layout::courses(rows, columns, 0.5, upright),
    };
    let high = 1. / rows as f32;
    let count = random.count(1, 4);
    let finish = Finish {
        palette: Palette::from_theme(random, theme, count),
        joint: joint_color(random, theme),
        joint_width: high * random.between(0.03, 0.11),
        rounding: high * random.between(0.05, 0.2),
        bulge: random.between(0., 0.25),
        spread: random.leaning_low(0.05, 0.8),
        roughness: random.leaning_low(0.03, 0.3),
        crookedness: high * random.leaning_low(0.005, 0.08),
    };
    let canvas = lay(random, &layout, &finish);
    Surface { canvas, repeat_metres: rows as f32 * random.between(0.065, 0.1) }
}

/// Draws a texture of glazed or stone tiles with grout, as in kitchens, bathrooms and halls.
pub(super) fn tiles(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::WHITES, 3.),
        (palette::BEIGES, 2.),
        (palette::GREYS, 2.),
        (palette::STONES, 2.),
        (palette::ACCENTS, 2.),
        (palette::BRICKS, 1.),
    ]);
    let across = random.leaning_low(1., 14.) as usize;
    let even = 2 * across.div_ceil(2);
    let layout = match random.count(0, 11) {
        0 => Layout::Diamonds { across },
        1 => Layout::Cells(Voronoi::new(random, even * 6 / 7 + 1, even, 0., true)),
        2 => Layout::quilt(random, across + 3, 3),
        3 | 4 => Layout::courses(2 * even, even, 0.5, random.happens(0.3)),
        5 => Layout::courses(even, even, 0.5, false),
        6 => Layout::courses(across, (across / 2).max(1), 0., random.happens(0.5)),
        7 => Layout::Basket { squares: even, long: 2 },
        _ => Layout::courses(across, across, 0., false),
    };
    let wide = 1. / across as f32;
    let count = random.one_of(&[1, 1, 1, 2, 3, 4]);
    let finish = Finish {
        palette: Palette::from_theme(random, theme, count),
        joint: joint_color(random, theme),
        joint_width: (wide * random.leaning_low(0.004, 0.03)).max(0.3 / SIZE as f32),
        rounding: wide * random.between(0.01, 0.08),
        bulge: random.between(0., 0.1),
        spread: random.leaning_low(0., 0.3),
        roughness: random.leaning_low(0., 0.12),
        crookedness: 0.,
    };
    let canvas = lay(random, &layout, &finish);
    let tile = match purpose {
        Purpose::Wall | Purpose::Thing => random.between(0.05, 0.3),
        _ => random.between(0.15, 0.6),
    };
    Surface { canvas, repeat_metres: (across as f32 * tile).clamp(0.3, 4.) }
}

/// Draws a texture of stones of all shapes: cobbles, flagstones, dry walls.
pub(super) fn stones(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::STONES, 5.),
        (palette::GREYS, 2.),
        (palette::EARTHS, 2.),
        (palette::BRICKS, 0.5),
    ]);
    let across = random.leaning_low(3., 14.) as usize;
    let layout = match random.count(0, 5) {
        0 => Layout::ragged(random, across, across as f32 * 0.7, 0.9, false),
        1 => Layout::quilt(random, across + 2, 3),
        2 => Layout::Cells(Voronoi::new(random, across, 2 * across.div_ceil(2), 0.5, true)),
        3 => Layout::courses(2 * across.div_ceil(2), across, 0.5, false),
        _ => {
            let jitter = random.between(0.6, 1.);
            Layout::Cells(Voronoi::new(random, across, across, jitter, false))
        }
    };
    let wide = 1. / across as f32;
    let joint = if random.happens(0.25) {
        palette::color_of(random, palette::GREENS) * 0.7
    } else {
        joint_color(random, palette::EARTHS) * random.between(0.3, 1.)
    };
    let count = random.count(1, 4);
    let finish = Finish {
        palette: Palette::from_theme(random, theme, count),
        joint,
        joint_width: wide * random.between(0.02, 0.09),
        rounding: wide * random.between(0.05, 0.35),
        bulge: random.between(0.1, 0.6),
        spread: random.between(0.1, 0.7),
        roughness: random.between(0.08, 0.35),
        crookedness: wide * random.leaning_low(0.01, 0.12),
    };
    let canvas = lay(random, &layout, &finish);
    Surface { canvas, repeat_metres: across as f32 * random.between(0.08, 0.4) }
}

/// Draws a texture of roof tiles or shingles: rows that overlap the one below.
pub(super) fn shingles(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::BRICKS, 3.),
        (palette::GREYS, 3.),
        (palette::WOODS, 2.),
        (palette::STONES, 1.),
    ]);
    let count = random.count(1, 4);
    let palette = Palette::from_theme(random, theme, count);
    let rows = 2 * random.count(2, 8);
    let columns = rows * random.count(1, 2);
    let (seed, scalloped) = (random.seed(), random.between(0., 0.6));
    let grain = fractal(random, SIZE, [columns * 2, 8], 4, 0.7);
    let dark = random.between(0.3, 0.7);
    let roughness = random.between(0.05, 0.25);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let row = |row: i32| {
            let shift = 0.5 * row.rem_euclid(2) as f32;
            let across = uv.x * columns as f32 + shift;
            let column = across.floor();
            let part = across - column;
            let round = scalloped * (2. * part - 1.).powi(2) * 0.5;
            let down = uv.y * rows as f32 - row as f32;
            let id =
                row.rem_euclid(rows as i32) as u32 * 64 + (column as i32).rem_euclid(columns as i32) as u32;
            (down, 1. - round, part, id)
        };
        let current = (uv.y * rows as f32).floor() as i32;
        // The next row's shingle, which lies below, is visible where this row's shingle has ended.
        let (mut down, mut end, mut part, mut id) = row(current);
        if down > end {
            (down, end, part, id) = row(current + 1);
            down += 1.;
            end += 1.;
        }
        let gap = smoothstep(0., 0.06, part.min(1. - part));
        let shadow = smoothstep(0., 0.25, (down - if end > 1. { 0. } else { -0.4 * end }).abs()).max(dark);
        let lip = 1. + 0.15 * smoothstep(0.2, 0.02, (end - down).abs());
        let tone = palette.ramp(unit_of(seed, id)) * (0.85 + 0.3 * unit_of(seed ^ 1, id));
        tone * shadow * lip * (dark + (1. - dark) * gap) * (1. + roughness * grain.sample(uv)).max(0.2)
    });
    Surface { canvas, repeat_metres: rows as f32 * random.between(0.1, 0.3) }
}

/// Draws a mosaic of small stones in many colors.
pub(super) fn mosaic(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let across = random.count(16, 40);
    let count = random.count(2, 5);
    let palette = Palette::draw(random, purpose, count);
    let drift = smooth(random, SIZE, [4; 2]);
    let seed = random.seed();
    let joint = joint_color(random, palette::GREYS);
    let follows = random.between(0., 1.);
    let layout = if random.happens(0.5) {
        Layout::courses(across, across, 0., false)
    } else {
        Layout::Cells(Voronoi::new(random, across, across, 0.6, false))
    };
    let width = 0.1 / across as f32;
    let bright = luminance(joint) > 0.5;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let piece = layout.piece(uv);
        let tone = (1. - follows) * unit_of(seed, piece.id) + follows * (0.5 + 0.6 * drift.sample(uv));
        let on_piece = smoothstep(0., 1.5 / SIZE as f32, piece.edge - width);
        let shade = if bright { 1. } else { 0.8 + 0.4 * unit_of(seed ^ 1, piece.id) };
        joint.lerp(palette.ramp(tone) * shade, on_piece)
    });
    Surface { canvas, repeat_metres: across as f32 * random.between(0.02, 0.06) }
}
