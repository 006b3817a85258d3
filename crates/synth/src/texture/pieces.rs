//! Textures of pieces beside each other: bricks, tiles, stones, boards, checks, windows.

use glam::{Vec2, Vec3};

use super::canvas::{Field, coverage, smoothstep};
use super::layout::Layout;
use super::noise::{fractal, smooth, unit_of};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};
use crate::random::Random;

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
    /// Difference in lightness between pieces.
    spread: f32,
    /// Roughness of the pieces.
    roughness: f32,
    /// Crookedness of the edges.
    crookedness: f32,
}

/// Paints the pieces of a layout, lit from a random side. A piece with id `piece` has the texture `pattern` at an offset of its own.
fn lay(random: &Random, layout: &Layout, finish: &Finish, pattern: &Field) -> Canvas {
    let [right, down] = [(); 2].map(|()| fractal(random, [12; 2], 3, 0.6));
    let seed = random.seed();
    let mut height = Field::filled(0.);
    let mut canvas = Canvas::filled(Vec3::ZERO);
    let mut heights = height.0.iter_mut();
    canvas.update(|uv, _| {
        let at = uv + Vec2::new(right.value(uv), down.value(uv)) * finish.crookedness;
        let piece = layout.piece(at - at.floor());
        let hash = |salt: u32| unit_of(seed ^ salt, piece.id);
        let raised = ((piece.edge - finish.joint_width) / finish.rounding).clamp(0., 1.);
        *heights.next().expect("as many") = raised * (2. - raised);
        let texture = finish.roughness * pattern.sample(piece.at + Vec2::new(hash(1), hash(2)));
        let lightness = (1. + finish.spread * (hash(3) - 0.5)) * (1. + texture);
        let color = finish.palette.ramp(hash(4)) * lightness.max(0.15);
        finish.joint.lerp(color, 1. - coverage(piece.edge - finish.joint_width))
    });
    canvas.shade(&height.slope(random.direction_in_plane()), random.within(0. ..0.6));
    canvas
}

fn joint_color(random: &Random) -> Vec3 {
    random_color_of_themes(random, &[(STONES, 4.), (GRAYS, 2.), (WHITES, 2.)]) * random.within(0.4..1.)
}

/// Draws courses of bricks.
pub(super) fn bricks(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(BRICKS, 6.), (STONES, 1.), (WHITES, 1.), (GRAYS, 1.)]);
    let rows = 2 * random.within(3..=8);
    let columns = (rows as f32 / random.within(2.2..3.6)).round().max(1.) as usize;
    let layout = match random.within(0..=3) {
        0 => Layout::ragged(random, rows, columns as f32, 0.4, false),
        _ => Layout::courses(rows, columns, 0.5, false),
    };
    let high = 1. / rows as f32;
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.within(1..=4)),
        joint: joint_color(random),
        joint_width: high * random.within(0.03..0.11),
        rounding: high * random.within(0.05..0.2),
        spread: random.sqrt_uniform(0.05, 0.8),
        roughness: random.sqrt_uniform(0.03, 0.3),
        crookedness: high * random.sqrt_uniform(0.005, 0.08),
    };
    let canvas = lay(random, &layout, &finish, &fractal(random, [8; 2], 5, 0.8));
    Surface { canvas, repeat_metres: rows as f32 * random.within(0.065..0.1) }
}

/// Draws glazed or stone tiles with grout, or a mosaic of many small ones.
pub(super) fn tiles(random: &Random, purpose: Purpose) -> Surface {
    let across = random.sqrt_uniform(1., 32.) as usize;
    let even = 2 * across.div_ceil(2);
    let layout = match random.within(0..=7) {
        0 => Layout::diamonds(across),
        1 => Layout::cells(random, even * 6 / 7 + 1, even, 0., true),
        2 => Layout::courses(2 * even, even, 0.5, random.chance(0.3)),
        3 => Layout::courses(across, (across / 2).max(1), 0., random.chance(0.5)),
        _ => Layout::courses(across, across, 0., false),
    };
    let wide = 1. / across as f32;
    let finish = Finish {
        palette: Palette::draw(random, purpose, random.one_of(&[1, 1, 1, 2, 3, 4])),
        joint: joint_color(random),
        joint_width: (wide * random.sqrt_uniform(0.004, 0.03)).max(0.3 / SIZE as f32),
        rounding: wide * random.within(0.01..0.08),
        spread: random.sqrt_uniform(0., 0.3),
        roughness: random.sqrt_uniform(0., 0.12),
        crookedness: 0.,
    };
    let canvas = lay(random, &layout, &finish, &fractal(random, [4; 2], 6, 0.7));
    Surface { canvas, repeat_metres: (across as f32 * random.within(0.03..0.5)).clamp(0.3, 4.) }
}

/// Draws stones of all shapes: cobbles, flagstones, dry walls.
pub(super) fn stones(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(STONES, 5.), (GRAYS, 2.), (EARTHS, 2.), (BRICKS, 0.5)]);
    let across = random.sqrt_uniform(3., 14.) as usize;
    let layout = match random.within(0..=2) {
        0 => Layout::ragged(random, across, across as f32 * 0.7, 0.9, false),
        _ => Layout::cells(random, across, across, random.within(0.6..1.), false),
    };
    let wide = 1. / across as f32;
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.within(1..=4)),
        joint: random_theme_color(random, random.one_of(&[EARTHS, STONES, GREENS])) * random.within(0.3..1.),
        joint_width: wide * random.within(0.02..0.09),
        rounding: wide * random.within(0.05..0.35),
        spread: random.within(0.1..0.7),
        roughness: random.within(0.08..0.35),
        crookedness: wide * random.sqrt_uniform(0.01, 0.12),
    };
    let canvas = lay(random, &layout, &finish, &fractal(random, [8; 2], 5, 0.8));
    Surface { canvas, repeat_metres: across as f32 * random.within(0.08..0.4) }
}

/// Draws boards, siding or parquet with grain along them.
pub(super) fn boards(random: &Random, _: Purpose) -> Surface {
    let upright = random.chance(0.5);
    let rows = random.sqrt_uniform(1., 16.) as usize;
    let layout = match random.within(0..=3) {
        0 => Layout::courses(2 * rows.div_ceil(2), 2, 0.5, upright),
        _ => Layout::ragged(random, rows, random.sqrt_uniform(1., 4.), random.one_of(&[0., 0.6]), upright),
    };
    let high = 1. / rows as f32;
    let theme = random.weighted(&[(WOODS, 10.), (GRAYS, 1.), (WHITES, 1.), (ACCENTS, 1.)]);
    let finish = Finish {
        palette: Palette::from_theme(random, theme, random.within(1..=3)),
        joint: random_theme_color(random, WOODS) * random.within(0.1..0.6),
        joint_width: high * random.sqrt_uniform(0.002, 0.06),
        rounding: high * random.within(0.01..0.3),
        spread: random.sqrt_uniform(0.02, 0.9),
        roughness: random.within(0.1..0.5),
        crookedness: 0.,
    };
    let canvas = lay(random, &layout, &finish, &grain(random));
    Surface { canvas, repeat_metres: random.within(0.07..0.2) * rows as f32 }
}

/// Returns wood grain along u, about in [-1, 1]: rings cut lengthwise between fibres.
fn grain(random: &Random) -> Field {
    let (rings, sway) = (random.within(2..=14) as f32, random.within(0.3..2.5));
    let bend = smooth(random, [random.within(1..=2), random.within(2..=5)]);
    let fibres = fractal(random, [random.within(2..=6), 64], 3, 0.8);
    let share = random.within(0.2..0.8);
    Field::from_fn(|uv| {
        // Latewood ends sharply: a sawtooth with a soft flank.
        let ring = (uv.y * rings + sway * bend.value(uv)).rem_euclid(1.);
        let ring = ring * ring * (1. - smoothstep(0.88, 1., ring));
        share * (1. - 2. * ring) + (1. - share) * fibres.value(uv)
    })
}

/// Draws flat pieces in several colors: checks, hexagons, diamonds, patchwork.
pub(super) fn checks(random: &Random, purpose: Purpose) -> Surface {
    let count = random.within(2..=5);
    let palette = Palette::draw(random, purpose, count);
    let fine = random.within(1..=8);
    let layout = match random.within(0..=4) {
        0 => Layout::cells(random, 3 * fine, 4 * fine, 0., true),
        1 => Layout::cells(random, 2 * fine, 2 * fine, random.within(0.5..1.), false),
        2 => Layout::diamonds(fine + 1),
        _ => Layout::courses(2 * fine, 2 * fine, 0., false),
    };
    let (seed, halved) = (random.seed(), random.chance(0.25));
    let line = if random.chance(0.4) { random.sqrt_uniform(0.001, 0.012) } else { -1. };
    let ink = palette.any(random) * random.within(0.3..1.);
    let canvas = Canvas::from_fn(|uv| {
        let piece = layout.piece(uv);
        let number = (unit_of(seed, piece.id) * count as f32) as usize;
        // A second color for half of a piece turns squares into triangles.
        let second = halved && piece.at.x * piece.extent.y > piece.at.y * piece.extent.x;
        palette.color(number + usize::from(second)).lerp(ink, coverage(piece.edge - line))
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Draws the front of a house or a cupboard: framed panes or panels in rows on a plain wall.
pub(super) fn windows(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, 2);
    let (rows, columns) = (random.within(1..=5), random.within(1..=6));
    let layout = Layout::courses(rows, columns, 0., false);
    let small = 1. / rows.max(columns) as f32;
    let (margin, frame) = (small * random.within(0.02..0.3), small * random.within(0.02..0.1));
    let bars = Vec2::new(random.within(1..=3) as f32, random.within(1..=4) as f32);
    let sky = Vec3::new(0.35, 0.45, 0.6) * random.within(0. ..1.2);
    let pane = if random.chance(0.6) { Vec3::splat(0.05) } else { palette.color(1) };
    let slant = random.within(-1. ..1.);
    let canvas = Canvas::from_fn(|uv| {
        let piece = layout.piece(uv);
        let at = (piece.at / piece.extent * bars).fract();
        let bar = (0.5 - (at - 0.5).abs()).min_element() * 0.3 * small;
        let share = smoothstep(-0.3, 0.3, slant * at.x + 0.5 - at.y);
        let inside = pane.lerp(sky, 0.8 * share);
        let framed = palette.color(1).lerp(inside, 1. - coverage((piece.edge - margin - frame).min(bar)));
        palette.color(0).lerp(framed, 1. - coverage(piece.edge - margin))
    });
    Surface { canvas, repeat_metres: rows as f32 * random.one_of(&[0.5, 3.]) * random.within(0.8..1.2) }
}
