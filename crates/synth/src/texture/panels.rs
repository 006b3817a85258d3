//! Textures of regular arrangements: windows of a house, books on shelves, cupboard doors, keys, slats, ceiling boards, grids.

use glam::{Vec2, Vec3};
use rand_chacha::ChaCha8Rng;

use super::marks::{Script, ink_for};
use super::noise::{fractal, smooth};
use super::palette::{self, Palette};
use super::rng::RandomValues;
use super::shape::{self, smoothstep};
use super::{Canvas, Purpose, SIZE, Surface};

/// Paints a raised rectangle. Along its edges, over a width of `bevel` repeats, `relief` brightens the left and upper sides and darkens the
/// right and lower sides. A rectangle with a negative `relief` is sunk.
fn paint_panel(canvas: &mut Canvas, middle: Vec2, half: Vec2, color: Vec3, bevel: f32, relief: f32) {
    let pixels = canvas.size as f32;
    canvas.stamp(middle, half, |offset| {
        let inside = half - offset.abs();
        let edge_distance = inside.min_element();
        let side = if inside.x < inside.y { offset.x.signum() } else { offset.y.signum() };
        let edge = smoothstep(bevel, 0.3 * bevel, edge_distance);
        (color * (1. - relief * side * edge), (0.5 + edge_distance * pixels).clamp(0., 1.))
    });
}

/// Draws a texture of a house wall with rows of windows, which have frames, curtains and reflections.
pub(super) fn windows(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let wall = super::masonry_or_paint(random);
    let mut canvas = wall.canvas;
    let (rows, columns) = (random.count(1, 5), random.count(1, 6));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let share = Vec2::new(random.between(0.35, 0.95), random.between(0.4, 0.95));
    let theme = random.weighted(&[
        (palette::WHITES, 4.),
        (palette::GREYS, 2.),
        (palette::BROWNS, 2.),
        (palette::ACCENTS, 1.),
    ]);
    let frame = palette::color_of(random, theme);
    let (panes_x, panes_y) = (random.count(1, 3), random.count(1, 4));
    let border = random.between(0.02, 0.07) * cell.min_element();
    let sill = random.happens(0.5);
    let sky = Vec3::new(0.35, 0.45, 0.6) * random.between(0.4, 1.2);
    let dark = Vec3::splat(random.between(0.02, 0.1));
    let curtains = random.between(0., 0.5);
    for index in 0..rows * columns {
        let middle = (Vec2::new((index % columns) as f32, (index / columns) as f32) + 0.5) * cell;
        let half = 0.5 * share * cell;
        paint_panel(&mut canvas, middle, half, frame, border, 0.3);
        if sill {
            let below = middle + Vec2::new(0., half.y);
            paint_panel(&mut canvas, below, Vec2::new(1.1 * half.x, border), frame * 0.8, border, 0.4);
        }
        let curtain = random.happens(curtains).then(|| palette::color_of(random, palette::BEIGES) * 0.6);
        let slant = random.between(-1., 1.);
        let level = random.between(-0.8, 0.8);
        let drawn = random.between(0.2, 1.);
        for pane in 0..panes_x * panes_y {
            let count = Vec2::new(panes_x as f32, panes_y as f32);
            let place = (Vec2::new((pane % panes_x) as f32, (pane / panes_x) as f32) + 0.5) / count * 2. - 1.;
            let inner = half - border;
            let at = place * inner;
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
                let edge_distance = (half_pane - offset.abs()).min_element();
                (color, (0.5 + edge_distance * SIZE as f32).clamp(0., 1.))
            });
        }
    }
    Surface { canvas, repeat_metres: rows as f32 * random.between(2.5, 3.5) }
}

/// Draws a texture of shelves with upright books, folders or boxes.
pub(super) fn shelves(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let theme = random.weighted(&[(palette::WOODS, 4.), (palette::WHITES, 2.), (palette::GREYS, 1.)]);
    let wood = palette::color_of(random, theme);
    let mut canvas = Canvas::filled(SIZE, wood * random.between(0.15, 0.5));
    let rows = random.count(2, 6);
    let row_height = 1. / rows as f32;
    let board = row_height * random.between(0.05, 0.12);
    let covers = [palette::ACCENTS, palette::VIVID, palette::WHITES, palette::BROWNS, palette::GREYS];
    let weights = covers.map(|theme| (theme, random.unit() * random.unit() + 0.05));
    let (thin, thick) = (random.between(0.012, 0.025), random.between(0.03, 0.08));
    let fill_probability = random.between(0.5, 1.);
    let script = Script::draw(random);
    for row in 0..rows {
        let floor = (row + 1) as f32 * row_height - board;
        let mut x = 0.01;
        while x < 0.99 {
            let width = random.leaning_low(thin, thick).min(0.995 - x).max(0.005);
            if random.happens(fill_probability) {
                let height = (row_height - board) * random.between(0.6, 0.96);
                let theme = random.weighted(&weights);
                let color = palette::color_of(random, theme);
                let middle = Vec2::new(x + 0.5 * width, floor - 0.5 * height);
                let half = 0.5 * Vec2::new(width, height);
                let roundness = random.between(0.2, 0.6);
                canvas.stamp(middle, half, |offset| {
                    let across = offset.x / half.x;
                    (
                        color * (1. - roundness * across * across),
                        ((half - offset.abs()).min_element() * SIZE as f32 + 0.5).clamp(0., 1.),
                    )
                });
                let label = ink_for(random, color);
                for _ in 0..random.count(0, 3) {
                    let band = random.between(0.3, 2.) / SIZE as f32;
                    let place = middle + Vec2::new(0., half.y * random.between(-0.85, 0.85));
                    let half_band = Vec2::new(0.9 * half.x, band);
                    canvas.fill(place, half_band, label, |offset| shape::rectangle(offset, half_band, 0.));
                }
                if width > 0.04 {
                    let start = Vec2::new(x + 0.15 * width, middle.y);
                    script.write(random, &mut canvas, start, 0.75 * width, 0.014, label);
                }
            }
            x += width;
        }
        paint_panel(
            &mut canvas,
            Vec2::new(0.5, floor + 0.5 * board),
            Vec2::new(0.52, 0.5 * board),
            wood,
            0.3 * board,
            0.3,
        );
    }
    paint_panel(&mut canvas, Vec2::new(0., 0.5), Vec2::new(0.012, 0.52), wood, 0.004, 0.3);
    Surface { canvas, repeat_metres: rows as f32 * random.between(0.25, 0.4) }
}

/// Draws a texture of doors and drawers with handles and inset panels in relief.
pub(super) fn cupboards(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let theme = random.weighted(&[
        (palette::WHITES, 4.),
        (palette::WOODS, 3.),
        (palette::GREYS, 2.),
        (palette::ACCENTS, 2.),
    ]);
    let color = palette::color_of(random, theme);
    let mut canvas = Canvas::filled(SIZE, color * random.between(0.15, 0.6));
    let (columns, rows) = (random.count(1, 4), random.count(1, 5));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let gap = random.between(0.004, 0.012);
    let bevel = random.between(0.006, 0.02);
    let relief = random.between(0.1, 0.5);
    let insets = random.count(0, 2);
    let metal = palette::color_of(random, palette::GREYS);
    let handle = random.count(0, 3);
    let handle_length = random.between(0.1, 0.4);
    for index in 0..rows * columns {
        let middle = (Vec2::new((index % columns) as f32, (index / columns) as f32) + 0.5) * cell;
        let mut half = 0.5 * cell - gap;
        let tone = color * random.between(0.95, 1.05);
        paint_panel(&mut canvas, middle, half, tone, bevel, relief);
        for inset in 0..insets {
            half -= random.between(0.1, 0.25) * cell.min_element();
            if half.min_element() > 2. * bevel {
                // The first inset panel is sunk, and the second one is raised.
                paint_panel(
                    &mut canvas,
                    middle,
                    half,
                    tone * 0.96,
                    bevel,
                    if inset == 0 { -relief } else { relief },
                );
            }
        }
        let (place, knob) = match handle {
            0 => (Vec2::new(0.42, 0.), Vec2::new(0.008, handle_length * 0.5 * cell.y)),
            1 => (Vec2::new(0., -0.4), Vec2::new(handle_length * 0.5 * cell.x, 0.008)),
            2 => (Vec2::new(0.4, 0.), Vec2::splat(0.014)),
            _ => continue,
        };
        let at = middle + place * cell;
        canvas.fill(at + 0.006, knob + 0.01, color * 0.35, |offset| {
            shape::rectangle(offset, knob, knob.min_element())
        });
        canvas.fill(at, knob + 0.01, metal, |offset| shape::rectangle(offset, knob, knob.min_element()));
    }
    if theme == palette::WOODS {
        let cells = if matches!(purpose, Purpose::Wall) { [2, 48] } else { [48, 2] };
        canvas.shade(&fractal(random, SIZE, cells, 3, 0.7), random.between(0.05, 0.25));
    }
    Surface { canvas, repeat_metres: columns as f32 * random.between(0.35, 0.7) }
}

/// Draws a texture of keys, switches, buttons or vents: small rounded boxes in rows, some of them labelled.
pub(super) fn keys(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let ground = Palette::draw(random, purpose, 1).color(0);
    let count = random.count(1, 3);
    let palette = Palette::draw(random, Purpose::Thing, count);
    let mut canvas = Canvas::filled(SIZE, ground * random.between(0.3, 1.));
    let (columns, rows) = (random.count(2, 16), random.count(2, 12));
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let share = Vec2::new(random.between(0.4, 0.95), random.between(0.4, 0.95));
    let relief = random.between(0., 0.5);
    let label_probability = random.unit();
    let script = Script::draw(random);
    for row in 0..rows {
        let mut column = 0;
        while column < columns {
            let span = if random.happens(0.12) { 2.min(columns - column) } else { 1 };
            let middle = Vec2::new(column as f32 + 0.5 * span as f32, row as f32 + 0.5) * cell;
            let half = 0.5 * (Vec2::new(span as f32, 1.) * cell - (1. - share) * cell.min_element());
            let color = palette.any(random);
            paint_panel(&mut canvas, middle, half, color, 0.3 * half.min_element(), relief);
            if random.happens(label_probability) {
                let ink = ink_for(random, color);
                let height = 0.8 * half.y;
                let start = middle - Vec2::new(0.6 * half.x, 0.);
                script.write(random, &mut canvas, start, 1.2 * half.x, height, ink);
            }
            column += span;
        }
    }
    Surface { canvas, repeat_metres: random.leaning_low(0.2, 2.) }
}

/// Draws a texture of parallel strips with the same profile: blinds, shutters, siding, radiators, corrugated sheets.
pub(super) fn slats(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let count = random.leaning_low(4., 40.).floor();
    let upright = random.happens(0.5);
    let profile = random.count(0, 2);
    let (depth, gap) = (random.between(0.1, 0.7), random.between(0.02, 0.25));
    let seam = random.between(0.2, 0.9);
    let uneven = smooth(random, SIZE, if upright { [64, 2] } else { [2, 64] });
    let mut index = 0;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let part = (if upright { uv.x } else { uv.y } * count).fract();
        let light = match profile {
            0 => 1. + depth * (std::f32::consts::TAU * part).sin(),
            1 => 1. + depth * (0.5 - part),
            _ => 1.,
        };
        let soft = 1.5 * count / SIZE as f32;
        let joint = 1. - seam * smoothstep(0.5 * gap + soft, 0.5 * gap, part.min(1. - part));
        index += 1;
        color * light * joint * (1. + 0.06 * uneven.values[index - 1])
    });
    Surface { canvas, repeat_metres: count * random.leaning_low(0.02, 0.15) }
}

/// Draws a texture of a suspended ceiling: a grid of boards, which may have specks, with some lamps.
pub(super) fn ceiling_boards(random: &mut ChaCha8Rng, _: Purpose) -> Surface {
    let board = palette::color_of(random, palette::WHITES);
    let rail = board * random.between(0.7, 1.1);
    let mut canvas = Canvas::filled(SIZE, rail);
    let (columns, rows) = random.one_of(&[(2, 2), (3, 3), (4, 4), (2, 4), (1, 2)]);
    let cell = Vec2::new(1. / columns as f32, 1. / rows as f32);
    let speck = random.between(0., 0.5);
    let lamps = random.between(0., 0.2);
    let relief = random.between(0.05, 0.3);
    let cells = random.one_of(&[64, 128]);
    let rough = smooth(random, SIZE, [cells; 2]);
    for index in 0..columns * rows {
        let middle = (Vec2::new((index % columns) as f32, (index / columns) as f32) + 0.5) * cell;
        let tone = board * random.between(0.96, 1.02);
        paint_panel(&mut canvas, middle, 0.5 * cell - 0.008, tone, 0.008, relief);
        if random.happens(lamps) {
            paint_panel(&mut canvas, middle, 0.4 * cell, Vec3::splat(0.93), 0.006, relief);
        }
    }
    for (pixel, value) in canvas.pixels.iter_mut().zip(&rough.values) {
        *pixel *= 1. - speck * smoothstep(0.5, 0.9, *value);
    }
    Surface { canvas, repeat_metres: columns as f32 * 0.6 }
}

/// Draws a texture of bars or wires over a background: fences, grates, nets, trellis.
pub(super) fn grids(random: &mut ChaCha8Rng, purpose: Purpose) -> Surface {
    let count = random.count(2, 3);
    let palette = Palette::draw(random, purpose, count);
    let behind = fractal(random, SIZE, [3; 2], 4, 0.6);
    let dark = random.between(0.1, 0.8);
    let bar = palette.color(1);
    let bars = Vec2::new(random.count(2, 20) as f32, random.count(2, 20) as f32);
    let bars = if random.happens(0.6) { Vec2::splat(bars.x) } else { bars };
    let oblique = random.happens(0.4);
    let width = random.between(0.05, 0.35);
    let has_crossbars = random.happens(0.7);
    let mut index = 0;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let at = if oblique { Vec2::new(uv.x + uv.y, uv.x - uv.y) * bars.x } else { uv * bars };
        let part = (at - at.floor() - 0.5).abs() * 2.;
        let soft = 2. * bars / SIZE as f32;
        let across = smoothstep(1. - width - soft.x, 1. - width + soft.x, part.x);
        let along =
            if has_crossbars { smoothstep(1. - width - soft.y, 1. - width + soft.y, part.y) } else { 0. };
        let nearness = if across > along { part.x } else { part.y };
        let ground = palette.color(0) * dark * (1. + 0.3 * behind.values[index]);
        index += 1;
        ground.lerp(bar * (0.6 + 0.4 * smoothstep(1. - width, 1., nearness)), across.max(along))
    });
    Surface { canvas, repeat_metres: random.leaning_low(0.3, 2.) }
}
