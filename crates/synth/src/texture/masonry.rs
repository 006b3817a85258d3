//! Textures of bricks, tiles, paving, stone, concrete, plaster and asphalt.

use glam::{Vec2, Vec3};

use super::canvas::{Field, Shape, smoothstep};
use super::layout::Layout;
use super::noise::{Random, folded_fractal, fractal, ridge, smooth, unit_of, warped};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Appearance of pieces and of the joints between them; lengths in repeats.
struct Finish {
    /// Colors of the pieces.
    palette: Palette,
    /// Color of the joints.
    joint: Vec3,
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

fn lay(random: &Random, layout: &Layout, finish: &Finish) -> Canvas {
    let rough = fractal(random, SIZE, [16; 2], 4, 0.8);
    let stains = fractal(random, SIZE, [4; 2], 4, 0.6);
    let [right, down] = [(); 2].map(|()| fractal(random, SIZE, [12; 2], 3, 0.6));
    let seed = random.seed();
    let light = random.direction();
    let mut heights = Vec::with_capacity(SIZE * SIZE);
    let mut canvas = Canvas::from_fn(SIZE, |uv| {
        let at = uv + Vec2::new(right.value(uv), down.value(uv)) * finish.crookedness;
        let piece = layout.piece(at - at.floor());
        let (rough, stain) = (rough.value(uv), stains.value(uv));
        let on_piece = smoothstep(0., 2. / SIZE as f32, piece.edge - finish.joint_width + 0.5 / SIZE as f32);
        let raised = ((piece.edge - finish.joint_width) / finish.rounding).clamp(0., 1.);
        heights.push(raised * (2. - raised));
        let tone = unit_of(seed, piece.id);
        let lightness = 1. + finish.spread * (unit_of(seed ^ 1, piece.id) - 0.5);
        let texture = 1. + finish.roughness * (rough + 0.6 * stain);
        let middle = 1. - finish.bulge * (1. - raised);
        let color = finish.palette.ramp(tone) * (lightness * texture * middle).max(0.15);
        let joint = finish.joint * (1. + 0.25 * rough).max(0.3);
        joint.lerp(color, on_piece)
    });
    let height = Field::new(SIZE, heights);
    canvas.shade(&height.slope(light), random.uniform(0., 0.6));
    canvas
}

fn joint_color(random: &Random, theme: Theme) -> Vec3 {
    let themes = [(STONES, 4.), (GRAYS, 2.), (WHITES, 2.), (theme, 1.)];
    random_color_of_themes(random, &themes) * random.uniform(0.5, 1.)
}

/// Draws a texture of courses of bricks.
pub(super) fn bricks(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(BRICKS, 6.), (STONES, 1.), (WHITES, 1.), (GRAYS, 1.)]);
    let rows = 2 * random.count(3, 8);
    let columns = (rows as f32 / random.uniform(2.2, 3.6)).round().max(1.) as usize;
    let upright = random.chance(0.05);
    let layout = match random.count(0, 9) {
        0 => Layout::courses(rows, columns, 0., upright),
        1 => Layout::herringbone(rows / 2 * 6, 3),
        2 | 3 => Layout::ragged(random, rows, columns as f32, 0.4, upright),
        _ => Layout::courses(rows, columns, 0.5, upright),
    };
    let high = 1. / rows as f32;
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.count(1, 4)),
        joint: joint_color(random, theme),
        joint_width: high * random.uniform(0.03, 0.11),
        rounding: high * random.uniform(0.05, 0.2),
        bulge: random.uniform(0., 0.25),
        spread: random.sqrt_uniform(0.05, 0.8),
        roughness: random.sqrt_uniform(0.03, 0.3),
        crookedness: high * random.sqrt_uniform(0.005, 0.08),
    };
    Surface { canvas: lay(random, &layout, &finish), repeat_metres: rows as f32 * random.uniform(0.065, 0.1) }
}

/// Draws a texture of glazed or stone tiles with grout, as in kitchens, bathrooms and halls.
pub(super) fn tiles(random: &Random, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[
        (WHITES, 3.),
        (BEIGES, 2.),
        (GRAYS, 2.),
        (STONES, 2.),
        (ACCENTS, 2.),
        (BRICKS, 1.),
    ]);
    let across = random.sqrt_uniform(1., 14.) as usize;
    let even = 2 * across.div_ceil(2);
    let layout = match random.count(0, 11) {
        0 => Layout::diamonds(across),
        1 => Layout::cells(random, even * 6 / 7 + 1, even, 0., true),
        2 => Layout::quilt(random, across + 3, 3),
        3 | 4 => Layout::courses(2 * even, even, 0.5, random.chance(0.3)),
        5 => Layout::courses(even, even, 0.5, false),
        6 => Layout::courses(across, (across / 2).max(1), 0., random.chance(0.5)),
        7 => Layout::basket(even, 2),
        _ => Layout::courses(across, across, 0., false),
    };
    let wide = 1. / across as f32;
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.one_of(&[1, 1, 1, 2, 3, 4])),
        joint: joint_color(random, theme),
        joint_width: (wide * random.sqrt_uniform(0.004, 0.03)).max(0.3 / SIZE as f32),
        rounding: wide * random.uniform(0.01, 0.08),
        bulge: random.uniform(0., 0.1),
        spread: random.sqrt_uniform(0., 0.3),
        roughness: random.sqrt_uniform(0., 0.12),
        crookedness: 0.,
    };
    let canvas = lay(random, &layout, &finish);
    let tile = match purpose {
        Purpose::Wall | Purpose::Thing => random.uniform(0.05, 0.3),
        _ => random.uniform(0.15, 0.6),
    };
    Surface { canvas, repeat_metres: (across as f32 * tile).clamp(0.3, 4.) }
}

/// Draws a texture of stones of all shapes: cobbles, flagstones, dry walls.
pub(super) fn stones(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(STONES, 5.), (GRAYS, 2.), (EARTHS, 2.), (BRICKS, 0.5)]);
    let across = random.sqrt_uniform(3., 14.) as usize;
    let layout = match random.count(0, 5) {
        0 => Layout::ragged(random, across, across as f32 * 0.7, 0.9, false),
        1 => Layout::quilt(random, across + 2, 3),
        2 => Layout::cells(random, across, 2 * across.div_ceil(2), 0.5, true),
        3 => Layout::courses(2 * across.div_ceil(2), across, 0.5, false),
        _ => Layout::cells(random, across, across, random.uniform(0.6, 1.), false),
    };
    let wide = 1. / across as f32;
    let joint = if random.chance(0.25) {
        random_theme_color(random, GREENS) * 0.7
    } else {
        joint_color(random, EARTHS) * random.uniform(0.3, 1.)
    };
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.count(1, 4)),
        joint,
        joint_width: wide * random.uniform(0.02, 0.09),
        rounding: wide * random.uniform(0.05, 0.35),
        bulge: random.uniform(0.1, 0.6),
        spread: random.uniform(0.1, 0.7),
        roughness: random.uniform(0.08, 0.35),
        crookedness: wide * random.sqrt_uniform(0.01, 0.12),
    };
    Surface {
        canvas: lay(random, &layout, &finish),
        repeat_metres: across as f32 * random.uniform(0.08, 0.4),
    }
}

/// Draws a texture of roof tiles or shingles: rows that overlap the one below.
pub(super) fn shingles(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(BRICKS, 3.), (GRAYS, 3.), (WOODS, 2.), (STONES, 1.)]);
    let palette = Palette::from_theme(random, theme, random.count(1, 4));
    let rows = 2 * random.count(2, 8);
    let columns = rows * random.count(1, 2);
    let (seed, scalloped) = (random.seed(), random.uniform(0., 0.6));
    let grain = fractal(random, SIZE, [columns * 2, 8], 4, 0.7);
    let dark = random.uniform(0.3, 0.7);
    let roughness = random.uniform(0.05, 0.25);
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
    Surface { canvas, repeat_metres: rows as f32 * random.uniform(0.1, 0.3) }
}

/// Draws a mosaic of small stones in many colors.
pub(super) fn mosaic(random: &Random, purpose: Purpose) -> Surface {
    let across = random.count(16, 40);
    let palette = Palette::draw(random, purpose, random.count(2, 5));
    let drift = smooth(random, SIZE, [4; 2]);
    let seed = random.seed();
    let joint = joint_color(random, GRAYS);
    let follows = random.uniform(0., 1.);
    let layout = if random.chance(0.5) {
        Layout::courses(across, across, 0., false)
    } else {
        Layout::cells(random, across, across, 0.6, false)
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
    Surface { canvas, repeat_metres: across as f32 * random.uniform(0.02, 0.06) }
}

/// Draws marble: thin and wide veins through clouds.
pub(super) fn marble(random: &Random, _: Purpose) -> Surface {
    let palette =
        Palette::among(random, &[(WHITES, 4.), (GRAYS, 2.), (BEIGES, 2.), (BROWNS, 1.), (ACCENTS, 1.)], 2);
    let vein = if random.chance(0.7) {
        random_theme_color(random, GRAYS) * random.uniform(0.3, 1.)
    } else {
        random_theme_color(random, random.one_of(&[WHITES, BROWNS, AUTUMN]))
    };
    let clouds = fractal(random, SIZE, [random.count(2, 4); 2], 6, 0.6);
    let reach = random.uniform(0.03, 0.15);
    let veins = smooth(random, SIZE, [random.count(1, 4), random.count(1, 5)]);
    let veins = warped(random, &veins, 3, reach);
    let fine = smooth(random, SIZE, [random.count(4, 9); 2]);
    let fine = warped(random, &fine, 6, 0.04);
    let (width, fine_width) = (random.sqrt_uniform(0.03, 0.35), random.sqrt_uniform(0.02, 0.15));
    let (share, fine_share) = (random.uniform(0.3, 1.), random.uniform(0., 0.6));
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let cloud = clouds.value(uv);
        let ground = palette.ramp(0.5 + 0.4 * cloud);
        let thin = |value: f32, width: f32| (1. - value.abs() / width).max(0.);
        let strength = share * thin(veins.value(uv), width) * (0.6 + 0.5 * cloud).clamp(0., 1.)
            + fine_share * thin(fine.value(uv), fine_width) * (0.4 - 0.6 * cloud).clamp(0., 1.);
        ground.lerp(vein, strength.min(0.95))
    });
    Surface { canvas, repeat_metres: random.uniform(0.6, 2.5) }
}

/// Draws terrazzo: chips of stone in cement.
pub(super) fn terrazzo(random: &Random, purpose: Purpose) -> Surface {
    let ground = Palette::draw(random, purpose, 1).color(0);
    let count = random.count(2, 5);
    let palette = Palette::among(random, &[(STONES, 3.), (WHITES, 1.), (ACCENTS, 2.), (BEIGES, 1.)], count);
    let across = random.count(14, 48);
    let chips = Layout::cells(random, across, across, 1., false);
    let (seed, crowd) = (random.seed(), random.uniform(0.25, 0.9));
    let gap = random.uniform(0.04, 0.2) / across as f32;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let piece = chips.piece(uv);
        let hash = |salt: u32| unit_of(seed ^ salt, piece.id);
        if hash(0) > crowd {
            return ground;
        }
        let chip = palette.ramp(hash(1)) * (0.8 + 0.4 * hash(2));
        let inner = gap * (1. + 2. * hash(3));
        ground.lerp(chip, smoothstep(0., 1.5 / SIZE as f32, piece.edge - inner))
    });
    Surface { canvas, repeat_metres: across as f32 * random.uniform(0.01, 0.04) }
}

/// Draws granite, sandstone or worktops: grains of a few colors.
pub(super) fn speckle(random: &Random, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[(STONES, 4.), (GRAYS, 3.), (BEIGES, 2.), (BROWNS, 1.)]);
    let base = if random.chance(0.7) {
        random_theme_color(random, theme)
    } else {
        Palette::draw(random, purpose, 1).color(0)
    };
    let mut canvas = Canvas::filled(SIZE, base);
    for _ in 0..random.count(2, 4) {
        let field = smooth(random, SIZE, [random.one_of(&[32, 48, 64, 96, 128]); 2]);
        let spots = shade(random, base, 0.7);
        let level = random.uniform(0., 0.9);
        let share = random.uniform(0.3, 1.);
        let share_at = |value| share * smoothstep(level, level + 0.3, value);
        canvas.update_with(&field, |pixel, value| pixel.lerp(spots, share_at(value)));
    }
    Surface { canvas, repeat_metres: random.uniform(0.3, 1.2) }
}

/// Draws concrete with stains, pores and the joints of its formwork.
pub(super) fn concrete(random: &Random, _: Purpose) -> Surface {
    let base = random_color_of_themes(random, &[(GRAYS, 3.), (STONES, 4.), (BEIGES, 1.)]);
    let mut canvas = Canvas::filled(SIZE, base);
    canvas.shade(&fractal(random, SIZE, [3; 2], 7, 0.7), random.uniform(0.05, 0.3));
    canvas.shade(&fractal(random, SIZE, [16, 2], 4, 0.6), random.sqrt_uniform(0., 0.25));
    canvas.shade(&smooth(random, SIZE, [128; 2]), random.uniform(0.02, 0.12));
    for _ in 0..random.count(0, 250) {
        let radius = random.sqrt_uniform(0.5, 2.5) / SIZE as f32;
        let dark = base * random.uniform(0.3, 0.8);
        canvas.fill(random.point(), &Shape::disk(radius), dark);
    }
    if random.chance(0.4) {
        let layout = Layout::courses(random.count(1, 3), random.count(1, 2), 0., false);
        let width = random.uniform(0.5, 2.) / SIZE as f32;
        let dark = random.uniform(0.3, 0.8);
        canvas.update(|uv, color| color * (1. - dark * smoothstep(2. * width, 0., layout.piece(uv).edge)));
    }
    Surface { canvas, repeat_metres: random.uniform(1., 4.) }
}

/// Draws plaster or stucco: relief lit from the side.
pub(super) fn plaster(random: &Random, purpose: Purpose) -> Surface {
    let mut canvas = Canvas::filled(SIZE, Palette::draw(random, purpose, 1).color(0));
    let cells = random.sqrt_uniform(2., 48.) as usize;
    let gain = random.uniform(0.5, 0.9);
    let relief = match random.count(0, 3) {
        0 => folded_fractal(random, SIZE, [cells; 2], 5, gain, ridge),
        1 => fractal(random, SIZE, [cells, 3 * cells], 5, gain),
        2 => warped(random, &fractal(random, SIZE, [cells, 2 * cells], 4, gain), 4, 0.12),
        _ => fractal(random, SIZE, [cells; 2], 6, gain),
    };
    canvas.shade(&relief.slope(random.direction()), random.uniform(0.1, 0.9));
    canvas.shade(&relief, random.uniform(0., 0.08));
    canvas.shade(&fractal(random, SIZE, [2; 2], 4, 0.5), random.uniform(0., 0.1));
    Surface { canvas, repeat_metres: random.uniform(0.8, 3.) }
}

/// Draws asphalt, tarmac or worn roads: fine grit, patches and cracks.
pub(super) fn asphalt(random: &Random, _: Purpose) -> Surface {
    let base = srgb_to_linear(random.one_of(&[0x4a4a4b, 0x5f5e5c, 0x6f6c68, 0x3a3a3c, 0x85817b]));
    let mut canvas = Canvas::filled(SIZE, shade(random, base, 0.15));
    canvas.shade(&smooth(random, SIZE, [256; 2]), random.uniform(0.15, 0.5));
    canvas.shade(&smooth(random, SIZE, [96; 2]), random.uniform(0.05, 0.25));
    canvas.shade(&fractal(random, SIZE, [2; 2], 5, 0.6), random.uniform(0.05, 0.25));
    if random.chance(0.5) {
        let cells = random.count(1, 3);
        let slabs = Layout::cells(random, cells + 1, cells + 1, 1., false);
        let [right, down] = [(); 2].map(|()| fractal(random, SIZE, [6; 2], 5, 0.65));
        let width = random.uniform(0.001, 0.006);
        let dark = random.uniform(0.3, 0.9);
        canvas.update(|uv, color| {
            let push = Vec2::new(right.sample(uv), down.sample(uv)) * 0.04;
            color * (1. - dark * smoothstep(width, 0.2 * width, slabs.piece(uv + push).edge))
        });
    }
    if random.chance(0.2) {
        let paint = srgb_to_linear(random.one_of(&[0xe8e6e0, 0xd8b23a]));
        let (from, half) = (random.unit(), random.uniform(0.02, 0.05));
        let worn = fractal(random, SIZE, [8; 2], 5, 0.8);
        canvas.update(|uv, color| {
            let off = uv.x - from;
            let inside = smoothstep(half, half - 0.006, (off - off.round()).abs());
            color.lerp(paint, inside * (0.8 + worn.sample(uv)).clamp(0., 0.95))
        });
    }
    Surface { canvas, repeat_metres: random.uniform(1.5, 4.) }
}
