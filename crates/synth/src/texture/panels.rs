//! Textures of wood, and of regular arrangements: windows of a house, books on shelves, doors, keys, slats, ceiling boards, grids.

use glam::{Vec2, Vec2Swizzles, Vec3};

use super::canvas::{Field, Shape, grid, smoothstep};
use super::layout::Layout;
use super::marks::{Script, ink_for};
use super::noise::{Random, fractal, smooth, unit_of};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Returns grain along u, about in [-1, 1]: rings cut lengthwise, stretched into fibres, with knots.
fn grain(random: &Random) -> Field {
    let rings = random.count(2, 14) as f32;
    let bend = smooth(random, SIZE, [random.count(1, 2), random.count(2, 5)]);
    let sway = random.uniform(0.3, 2.5);
    let (drawn_out, wide) = (random.count(2, 6), random.count(4, 16));
    let fibres = fractal(random, SIZE, [drawn_out, 64], 3, 0.8);
    let streaks = fractal(random, SIZE, [1, wide], 3, 0.7);
    let [figure, fibre, streak] = [(); 3].map(|()| random.uniform(0.1, 1.));
    let knots: Vec<(Vec2, f32)> =
        (0..random.one_of(&[0, 0, 1, 2, 4])).map(|_| (random.point(), random.uniform(0.01, 0.035))).collect();
    let field = Field::from_fn(SIZE, |uv| {
        let mut phase = uv.y * rings + sway * bend.value(uv);
        let mut dark = 0.;
        for &(center, radius) in &knots {
            let off = uv - center;
            let off = (off - off.round()) * Vec2::new(0.5, 1.);
            let near = radius * radius / (off.length_squared() + radius * radius);
            phase += 2. * near;
            dark += smoothstep(0.5, 0.9, near);
        }
        // Latewood ends sharply: a sawtooth with a soft flank.
        let ring = phase - phase.floor();
        let ring = ring * ring * (1. - smoothstep(0.88, 1., ring));
        let value =
            figure * (1.4 * ring - 0.5) + fibre * 0.7 * fibres.value(uv) + streak * 0.7 * streaks.value(uv);
        value + 2. * dark
    });
    let scale = 1. / (figure + fibre + streak);
    field.map(|value| value * scale)
}

/// Returns two colors of one wood: earlywood and latewood.
fn tones(random: &Random) -> (Vec3, Vec3) {
    let light = random_color_of_themes(random, &[(WOODS, 10.), (GRAYS, 1.), (WHITES, 1.), (ACCENTS, 0.7)]);
    let red = Vec3::new(1., random.uniform(0.82, 1.), random.uniform(0.65, 1.));
    (light, light * red * random.uniform(0.35, 0.85))
}

/// Draws boards or parquet with joints.
pub(super) fn boards(random: &Random, purpose: Purpose) -> Surface {
    let upright = random.chance(0.5);
    let rows = random.sqrt_uniform(3., 16.) as usize;
    let long = random.count(2, 6);
    let outdoors = matches!(purpose, Purpose::Facade | Purpose::Ground);
    let kind = if outdoors { 9 } else { random.count(0, 9) };
    let (layout, wide) = match kind {
        0 => (Layout::herringbone(2 * long * random.count(1, 2), long), 0.06),
        1 => {
            let squares = 2 * random.count(1, 4);
            (Layout::basket(squares, long), 1. / (squares * long) as f32)
        }
        2 => (Layout::courses(2 * rows.div_ceil(2), 2, 0.5, upright), 1. / rows as f32),
        _ => {
            let (pieces, unequal) = (random.sqrt_uniform(1., 4.), random.one_of(&[0., 0., 0.6]));
            (Layout::ragged(random, rows, pieces, unequal, upright), 1. / rows as f32)
        }
    };
    let (light, dark) = tones(random);
    let grain = grain(random);
    let (seed, spread) = (random.seed(), random.sqrt_uniform(0.02, 0.9));
    let contrast = random.uniform(0.3, 1.1);
    let joint = wide * random.sqrt_uniform(0.005, 0.06);
    let depth = random.uniform(0.3, 0.9);
    let bevel = random.uniform(0., 0.3);
    let other = random_theme_color(random, WOODS);
    let mixed = if random.chance(0.25) { random.uniform(0.2, 1.) } else { 0. };
    // With fewer boards, the grain appears larger.
    let scale = random.uniform(0.6, 1.6);
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
    Surface { canvas, repeat_metres: random.uniform(0.07, 0.2) * (1. / wide).min(16.) }
}

/// Draws grain without joints, as on doors and tables.
pub(super) fn veneer(random: &Random, _: Purpose) -> Surface {
    let (light, dark) = tones(random);
    let grain = grain(random);
    let contrast = random.uniform(0.3, 1.2);
    let upright = random.chance(0.5);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let value = grain.sample(if upright { uv.yx() } else { uv });
        light.lerp(dark, (0.4 + contrast * value).clamp(0., 1.))
    });
    Surface { canvas, repeat_metres: random.uniform(0.4, 1.6) }
}

/// Paints a raised rectangle. Along its edges, over a width of `bevel` repeats, `relief` brightens the left and upper sides and darkens the
/// right and lower sides. A rectangle with a negative `relief` is sunk.
fn paint_panel(canvas: &mut Canvas, middle: Vec2, half: Vec2, color: Vec3, bevel: f32, relief: f32) {
    canvas.stamp(middle, half, |offset| {
        let inside = half - offset.abs();
        let edge_distance = inside.min_element();
        let side = if inside.x < inside.y { offset.x.signum() } else { offset.y.signum() };
        let edge = smoothstep(bevel, 0.3 * bevel, edge_distance);
        (color * (1. - relief * side * edge), -edge_distance)
    });
}

/// Draws a texture of a house wall with rows of windows, which have frames, curtains and reflections.
pub(super) fn windows(random: &Random, _: Purpose) -> Surface {
    let wall = super::masonry_or_paint(random);
    let mut canvas = wall.canvas;
    let (rows, columns) = (random.count(1, 5), random.count(1, 6));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let share = Vec2::new(random.uniform(0.35, 0.95), random.uniform(0.4, 0.95));
    let frame = random_color_of_themes(random, &[(WHITES, 4.), (GRAYS, 2.), (BROWNS, 2.), (ACCENTS, 1.)]);
    let (panes_x, panes_y) = (random.count(1, 3), random.count(1, 4));
    let border = random.uniform(0.02, 0.07) * cell.min_element();
    let sill = random.chance(0.5);
    let sky = Vec3::new(0.35, 0.45, 0.6) * random.uniform(0.4, 1.2);
    let dark = Vec3::splat(random.uniform(0.02, 0.1));
    let curtains = random.uniform(0., 0.5);
    for place in grid(columns, rows) {
        let middle = place * cell;
        let half = 0.5 * share * cell;
        paint_panel(&mut canvas, middle, half, frame, border, 0.3);
        if sill {
            let below = middle + Vec2::new(0., half.y);
            paint_panel(&mut canvas, below, Vec2::new(1.1 * half.x, border), frame * 0.8, border, 0.4);
        }
        let curtain = random.chance(curtains).then(|| random_theme_color(random, BEIGES) * 0.6);
        let slant = random.uniform(-1., 1.);
        let level = random.uniform(-0.8, 0.8);
        let drawn = random.uniform(0.2, 1.);
        let count = Vec2::new(panes_x as f32, panes_y as f32);
        for pane in grid(panes_x, panes_y) {
            let inner = half - border;
            let at = (pane / count * 2. - 1.) * inner;
            let half_pane = inner / count - 0.4 * border;
            canvas.stamp(middle + at, half_pane, |offset| {
                let position = (at + offset) / inner;
                let mirrored = smoothstep(-0.3, 0.3, level - position.y + slant * position.x);
                let mut color = dark.lerp(sky, mirrored * 0.8);
                if let Some(curtain) = curtain
                    && position.x.abs() > 1. - drawn
                {
                    color = color.lerp(curtain * (0.8 + 0.2 * (position.x * 40.).sin()), 0.7);
                }
                (color, (offset.abs() - half_pane).max_element())
            });
        }
    }
    Surface { canvas, repeat_metres: rows as f32 * random.uniform(2.5, 3.5) }
}

/// Draws a texture of shelves with upright books, folders or boxes.
pub(super) fn shelves(random: &Random, _: Purpose) -> Surface {
    let wood = random_color_of_themes(random, &[(WOODS, 4.), (WHITES, 2.), (GRAYS, 1.)]);
    let mut canvas = Canvas::filled(SIZE, wood * random.uniform(0.15, 0.5));
    let rows = random.count(2, 6);
    let row_height = 1. / rows as f32;
    let board = row_height * random.uniform(0.05, 0.12);
    let covers = [ACCENTS, VIVID, WHITES, BROWNS, GRAYS];
    let weights = covers.map(|theme| (theme, random.unit() * random.unit() + 0.05));
    let (thin, thick) = (random.uniform(0.012, 0.025), random.uniform(0.03, 0.08));
    let fill_probability = random.uniform(0.5, 1.);
    let script = Script::draw(random);
    for row in 0..rows {
        let floor = (row + 1) as f32 * row_height - board;
        let mut x = 0.01;
        while x < 0.99 {
            let width = random.sqrt_uniform(thin, thick).min(0.995 - x).max(0.005);
            if random.chance(fill_probability) {
                let height = (row_height - board) * random.uniform(0.6, 0.96);
                let color = random_color_of_themes(random, &weights);
                let middle = Vec2::new(x + 0.5 * width, floor - 0.5 * height);
                let half = 0.5 * Vec2::new(width, height);
                let roundness = random.uniform(0.2, 0.6);
                canvas.stamp(middle, half, |offset| {
                    let across = offset.x / half.x;
                    (color * (1. - roundness * across * across), (offset.abs() - half).max_element())
                });
                let label = ink_for(random, color);
                for _ in 0..random.count(0, 3) {
                    let band = random.uniform(0.3, 2.) / SIZE as f32;
                    let place = middle + Vec2::new(0., half.y * random.uniform(-0.85, 0.85));
                    let half_band = Vec2::new(0.9 * half.x, band);
                    canvas.fill(place, &Shape::rectangle(half_band, 0.), label);
                }
                if width > 0.04 {
                    let start = Vec2::new(x + 0.15 * width, middle.y);
                    script.write(random, &mut canvas, start, 0.75 * width, 0.014, label);
                }
            }
            x += width;
        }
        let (middle, half) = (Vec2::new(0.5, floor + 0.5 * board), Vec2::new(0.52, 0.5 * board));
        paint_panel(&mut canvas, middle, half, wood, 0.3 * board, 0.3);
    }
    paint_panel(&mut canvas, Vec2::new(0., 0.5), Vec2::new(0.012, 0.52), wood, 0.004, 0.3);
    Surface { canvas, repeat_metres: rows as f32 * random.uniform(0.25, 0.4) }
}

/// Draws a texture of doors and drawers with handles and inset panels in relief.
pub(super) fn cupboards(random: &Random, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[(WHITES, 4.), (WOODS, 3.), (GRAYS, 2.), (ACCENTS, 2.)]);
    let color = random_theme_color(random, theme);
    let mut canvas = Canvas::filled(SIZE, color * random.uniform(0.15, 0.6));
    let (columns, rows) = (random.count(1, 4), random.count(1, 5));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let gap = random.uniform(0.004, 0.012);
    let bevel = random.uniform(0.006, 0.02);
    let relief = random.uniform(0.1, 0.5);
    let insets = random.count(0, 2);
    let metal = random_theme_color(random, GRAYS);
    let handle = random.count(0, 3);
    let handle_length = random.uniform(0.1, 0.4);
    for place in grid(columns, rows) {
        let middle = place * cell;
        let mut half = 0.5 * cell - gap;
        let tone = color * random.uniform(0.95, 1.05);
        paint_panel(&mut canvas, middle, half, tone, bevel, relief);
        for inset in 0..insets {
            half -= random.uniform(0.1, 0.25) * cell.min_element();
            if half.min_element() > 2. * bevel {
                // The first inset panel is sunk, and the second one is raised.
                let relief = if inset == 0 { -relief } else { relief };
                paint_panel(&mut canvas, middle, half, tone * 0.96, bevel, relief);
            }
        }
        let (place, knob) = match handle {
            0 => (Vec2::new(0.42, 0.), Vec2::new(0.008, handle_length * 0.5 * cell.y)),
            1 => (Vec2::new(0., -0.4), Vec2::new(handle_length * 0.5 * cell.x, 0.008)),
            2 => (Vec2::new(0.4, 0.), Vec2::splat(0.014)),
            _ => continue,
        };
        let at = middle + place * cell;
        let knob = Shape::rectangle(knob, knob.min_element());
        canvas.fill(at + 0.006, &knob, color * 0.35);
        canvas.fill(at, &knob, metal);
    }
    if theme == WOODS {
        let cells = if matches!(purpose, Purpose::Wall) { [2, 48] } else { [48, 2] };
        canvas.shade(&fractal(random, SIZE, cells, 3, 0.7), random.uniform(0.05, 0.25));
    }
    Surface { canvas, repeat_metres: columns as f32 * random.uniform(0.35, 0.7) }
}

/// Draws a texture of keys, switches, buttons or vents: small rounded boxes in rows, some of them labelled.
pub(super) fn keys(random: &Random, purpose: Purpose) -> Surface {
    let ground = Palette::draw(random, purpose, 1).color(0);
    let palette = Palette::draw(random, Purpose::Thing, random.count(1, 3));
    let mut canvas = Canvas::filled(SIZE, ground * random.uniform(0.3, 1.));
    let (columns, rows) = (random.count(2, 16), random.count(2, 12));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let share = Vec2::new(random.uniform(0.4, 0.95), random.uniform(0.4, 0.95));
    let relief = random.uniform(0., 0.5);
    let label_probability = random.unit();
    let script = Script::draw(random);
    for row in 0..rows {
        let mut column = 0;
        while column < columns {
            let span = if random.chance(0.12) { 2.min(columns - column) } else { 1 };
            let middle = Vec2::new(column as f32 + 0.5 * span as f32, row as f32 + 0.5) * cell;
            let half = 0.5 * (Vec2::new(span as f32, 1.) * cell - (1. - share) * cell.min_element());
            let color = palette.any(random);
            paint_panel(&mut canvas, middle, half, color, 0.3 * half.min_element(), relief);
            if random.chance(label_probability) {
                let ink = ink_for(random, color);
                let height = 0.8 * half.y;
                let start = middle - Vec2::new(0.6 * half.x, 0.);
                script.write(random, &mut canvas, start, 1.2 * half.x, height, ink);
            }
            column += span;
        }
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.2, 2.) }
}

/// Draws a texture of parallel strips with the same profile: blinds, shutters, siding, radiators, corrugated sheets.
pub(super) fn slats(random: &Random, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let count = random.sqrt_uniform(4., 40.).floor();
    let upright = random.chance(0.5);
    let profile = random.count(0, 2);
    let (depth, gap) = (random.uniform(0.1, 0.7), random.uniform(0.02, 0.25));
    let seam = random.uniform(0.2, 0.9);
    let uneven = smooth(random, SIZE, if upright { [64, 2] } else { [2, 64] });
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let part = (if upright { uv.x } else { uv.y } * count).fract();
        let light = match profile {
            0 => 1. + depth * (std::f32::consts::TAU * part).sin(),
            1 => 1. + depth * (0.5 - part),
            _ => 1.,
        };
        let soft = 1.5 * count / SIZE as f32;
        let joint = 1. - seam * smoothstep(0.5 * gap + soft, 0.5 * gap, part.min(1. - part));
        color * light * joint * (1. + 0.06 * uneven.value(uv))
    });
    Surface { canvas, repeat_metres: count * random.sqrt_uniform(0.02, 0.15) }
}

/// Draws a texture of a suspended ceiling: a grid of boards, which may have specks, with some lamps.
pub(super) fn ceiling_boards(random: &Random, _: Purpose) -> Surface {
    let board = random_theme_color(random, WHITES);
    let mut canvas = Canvas::filled(SIZE, board * random.uniform(0.7, 1.1));
    let (columns, rows) = random.one_of(&[(2, 2), (3, 3), (4, 4), (2, 4), (1, 2)]);
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let speck = random.uniform(0., 0.5);
    let lamps = random.uniform(0., 0.2);
    let relief = random.uniform(0.05, 0.3);
    let rough = smooth(random, SIZE, [random.one_of(&[64, 128]); 2]);
    for place in grid(columns, rows) {
        let middle = place * cell;
        let tone = board * random.uniform(0.96, 1.02);
        paint_panel(&mut canvas, middle, 0.5 * cell - 0.008, tone, 0.008, relief);
        if random.chance(lamps) {
            paint_panel(&mut canvas, middle, 0.4 * cell, Vec3::splat(0.93), 0.006, relief);
        }
    }
    canvas.update_with(&rough, |pixel, value| pixel * (1. - speck * smoothstep(0.5, 0.9, value)));
    Surface { canvas, repeat_metres: columns as f32 * 0.6 }
}

/// Draws a texture of bars or wires over a background: fences, grates, nets, trellis.
pub(super) fn grids(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 3));
    let behind = fractal(random, SIZE, [3; 2], 4, 0.6);
    let dark = random.uniform(0.1, 0.8);
    let bar = palette.color(1);
    let bars = Vec2::new(random.count(2, 20) as f32, random.count(2, 20) as f32);
    let bars = if random.chance(0.6) { Vec2::splat(bars.x) } else { bars };
    let oblique = random.chance(0.4);
    let width = random.uniform(0.05, 0.35);
    let has_crossbars = random.chance(0.7);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let at = if oblique { Vec2::new(uv.x + uv.y, uv.x - uv.y) * bars.x } else { uv * bars };
        let part = (at - at.floor() - 0.5).abs() * 2.;
        let soft = 2. * bars / SIZE as f32;
        let across = smoothstep(1. - width - soft.x, 1. - width + soft.x, part.x);
        let along =
            if has_crossbars { smoothstep(1. - width - soft.y, 1. - width + soft.y, part.y) } else { 0. };
        let nearness = if across > along { part.x } else { part.y };
        let ground = palette.color(0) * dark * (1. + 0.3 * behind.value(uv));
        ground.lerp(bar * (0.6 + 0.4 * smoothstep(1. - width, 1., nearness)), across.max(along))
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 2.) }
}
