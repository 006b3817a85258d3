//! Textures of wallpaper, print and textiles: repeated figures, threads, piles and folds.

use glam::{Vec2, Vec3};

use super::canvas::{Field, Shape, coverage, grid, smoothstep};
use super::layout::Layout;
use super::noise::{Random, fractal, smooth, unit_of};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws stripes of different widths, horizontal, upright or oblique.
pub(super) fn stripes(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 5));
    let bands = bands(random, &palette);
    let (across, along) = random.one_of(&[(1., 0.), (1., 0.), (0., 1.), (1., 1.), (1., -1.), (2., 1.)]);
    let times = random.sqrt_uniform(1., 12.).floor();
    let (wave, waves) =
        (if random.chance(0.2) { random.uniform(0.02, 0.3) } else { 0. }, random.count(1, 6) as f32);
    let zigzag = random.chance(0.5);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let phase = (uv.x * along + uv.y * across) * waves;
        let swing = if zigzag {
            4. * (phase - (phase + 0.5).floor()).abs()
        } else {
            (phase * std::f32::consts::TAU).sin()
        };
        let at = (uv.x * across + uv.y * along) * times + wave * swing;
        band_at(&bands, at, times * across.abs().max(along.abs()))
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Draws stripes in both directions, woven into each other.
pub(super) fn plaid(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 4));
    let bands_across = bands(random, &palette);
    let bands_along = if random.chance(0.7) { bands_across.clone() } else { bands(random, &palette) };
    let times = random.sqrt_uniform(1., 8.).floor();
    let threads = random.one_of(&[32., 64., 128.]);
    let twill = random.uniform(0., 0.5);
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let warp = band_at(&bands_across, uv.x * times, times);
        let weft = band_at(&bands_along, uv.y * times, times);
        let over = ((uv.x + uv.y) * threads).fract() < 0.5;
        warp.lerp(weft, if over { 0.5 + twill } else { 0.5 - twill })
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.2, 1.5) }
}

/// A sequence of stripes: the end of each in [0, 1], and its color.
type Bands = Vec<(f32, Vec3)>;

fn bands(random: &Random, palette: &Palette) -> Bands {
    let widths: Vec<f32> = (0..random.count(2, 7)).map(|_| random.sqrt_uniform(0.05, 1.)).collect();
    let sum: f32 = widths.iter().sum();
    let mut end = 0.;
    let band = |(index, width): (usize, &f32)| {
        end += width / sum;
        (end, palette.color(index))
    };
    widths.iter().enumerate().map(band).collect()
}

/// Returns the color at position `at`, blended over one pixel at edges. A repeat contains the bands `times` times.
fn band_at(bands: &Bands, at: f32, times: f32) -> Vec3 {
    let at = at.rem_euclid(1.);
    let index = bands.partition_point(|(end, _)| *end <= at).min(bands.len() - 1);
    let next = bands[(index + 1) % bands.len()].1;
    let soft = times / SIZE as f32;
    bands[index].1.lerp(next, (1. - (bands[index].0 - at) / soft).clamp(0., 1.))
}

/// Draws flat pieces: checks, hexagons, diamonds, zigzags, patchwork.
pub(super) fn pieces(random: &Random, purpose: Purpose) -> Surface {
    let count = random.count(2, 5);
    let palette = Palette::draw(random, purpose, count);
    let fine = random.count(1, 6);
    let checks = random.chance(0.35);
    let layout = if checks {
        Layout::courses(2 * fine, 2 * fine, 0., false)
    } else {
        match random.count(0, 4) {
            0 => Layout::cells(random, 3 * fine, 4 * fine, 0., true),
            1 => Layout::diamonds(fine + 1),
            2 => Layout::herringbone(6 * fine, 3),
            3 => Layout::quilt(random, 4 * fine, 3),
            _ => Layout::basket(2 * fine, 2),
        }
    };
    let seed = random.seed();
    let line = if random.chance(0.4) { random.sqrt_uniform(0.001, 0.012) } else { 0. };
    let ink = palette.any(random) * random.uniform(0.3, 1.);
    let halved = random.chance(0.25);
    let inset = if random.chance(0.3) { random.uniform(0.1, 0.4) } else { 1. };
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let piece = layout.piece(uv);
        let mut number = (unit_of(seed, piece.id) * count as f32) as usize;
        if checks {
            number = ((piece.id / 64 + piece.id % 64) % 2) as usize;
        }
        // A second color for half of a piece turns squares into triangles.
        if halved && piece.at.x * piece.extent.y > piece.at.y * piece.extent.x {
            number += 1;
        }
        if piece.edge > inset * piece.extent.y {
            number += 1;
        }
        let on_line = if line > 0. { coverage(piece.edge - line, SIZE as f32) } else { 0. };
        palette.color(number).lerp(ink, on_line)
    });
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Draws dots, rings, stars, flowers and polygons on a straight, staggered or loose grid.
pub(super) fn motifs(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 5));
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    let rows = 2 * random.sqrt_uniform(1., 8.) as usize;
    let cell = 1. / rows as f32;
    let staggered = random.chance(0.6);
    let loose = if random.chance(0.3) { random.uniform(0.1, 0.8) } else { 0. };
    let kinds: Vec<Motif> = (0..random.count(1, 2)).map(|_| Motif::draw(random, &palette)).collect();
    for row in 0..rows {
        for column in 0..rows {
            let shift = if staggered && row % 2 == 1 { 0.5 } else { 0. };
            let off = (random.point() - 0.5) * loose;
            let center = (Vec2::new(column as f32 + 0.5 + shift, row as f32 + 0.5) + off) * cell;
            let turn = if loose > 0. { random.direction() } else { Vec2::X };
            kinds[(row + column) % kinds.len()].paint(&mut canvas, center, cell, turn);
        }
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.3, 3.) }
}

/// Nested shapes, the outermost first.
pub(super) struct Motif {
    layers: Vec<MotifLayer>,
}

/// A shape as a function of its radius, its radius as a fraction of the cell's width, and its color.
type MotifLayer = (Box<dyn Fn(f32) -> Shape>, f32, Vec3);

impl Motif {
    /// Draws one to four shapes.
    pub fn draw(random: &Random, palette: &Palette) -> Motif {
        let mut share = random.uniform(0.15, 0.5);
        let mut layers: Vec<MotifLayer> = Vec::new();
        for index in 0..random.count(1, 4) {
            let shape: Box<dyn Fn(f32) -> Shape> = match random.count(0, 4) {
                0 => Box::new(Shape::disk),
                1 => {
                    let corners = random.count(3, 8);
                    Box::new(move |radius| Shape::polygon(0.8 * radius, corners))
                }
                2 => {
                    let (petals, depth) = (random.count(3, 12), random.uniform(0.2, 0.8));
                    Box::new(move |radius| Shape::flower(radius, petals, depth))
                }
                3 => {
                    let width = random.uniform(0.2, 0.8);
                    Box::new(move |radius| Shape::leaf(2. * radius, width * radius))
                }
                _ => {
                    let aspect = random.uniform(0.3, 1.);
                    Box::new(move |radius| Shape::rectangle(Vec2::new(radius, aspect * radius), 0.))
                }
            };
            layers.push((shape, share, palette.color(index + 1)));
            share *= random.uniform(0.4, 0.85);
        }
        Motif { layers }
    }

    /// Paints the motif into a cell of width `cell`, rotated by `turn`.
    pub fn paint(&self, canvas: &mut Canvas, center: Vec2, cell: f32, turn: Vec2) {
        for (shape, share, color) in &self.layers {
            canvas.fill(center, &shape(share * cell).turned(turn), *color);
        }
    }
}

/// Draws ornaments with mirror symmetry, as on old wallpaper: tendrils, leaves and flowers.
pub(super) fn ornament(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(2, 4));
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    let columns = random.one_of(&[1usize, 2, 2, 3, 4]);
    let cell = 1. / columns as f32;
    let flower = Motif::draw(random, &palette);
    let width = random.uniform(0.01, 0.03) * cell;
    let leaf = Vec2::new(random.uniform(0.1, 0.25), random.uniform(0.3, 0.7));
    let steps = random.count(6, 14);
    let mut tendrils = Vec::new();
    for _ in 0..random.count(1, 3) {
        let (mut at, mut angle, curl) = (Vec2::ZERO, random.uniform(-1.5, 1.5), random.uniform(-0.6, 0.6));
        for step in 0..steps {
            let next = at + Vec2::from_angle(angle) * 0.5 / steps as f32;
            tendrils.push((at, next, angle, step));
            angle += curl + 0.3 * random.approx_normal();
            at = next;
        }
    }
    let every = random.count(2, 4);
    // The second half of the ornaments lies between the first half.
    for place in [-0.25, 0.25].into_iter().flat_map(|shift| grid(columns, columns).map(move |at| at + shift))
    {
        let center = place * cell;
        for &(from, to, angle, step) in &tendrils {
            for side in [1., -1.] {
                let mirror = Vec2::new(side, 1.);
                let (from, to) = (from * mirror * cell, to * mirror * cell);
                canvas.draw_line(center, from, to, width, palette.color(1));
                if step % every == 1 {
                    let length = leaf.x * cell;
                    let turn = Vec2::from_angle(-angle - 0.8) * mirror;
                    let tip = center + to + Vec2::new(turn.x, -turn.y) * 0.5 * length;
                    let leaf = Shape::leaf(length, length * leaf.y).turned(Vec2::from_angle(-angle - 0.8));
                    let color = palette.color(2);
                    canvas.stamp(tip, Vec2::splat(length), |at| (color, leaf.distance(at * mirror)));
                }
            }
        }
        flower.paint(&mut canvas, center, 0.5 * cell, Vec2::X);
    }
    Surface { canvas, repeat_metres: random.uniform(0.4, 1.6) * columns as f32 * 0.5 }
}

/// Draws threads that pass over and under each other.
pub(super) fn weave(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(1, 3));
    let threads = random.one_of(&[24, 32, 40, 48, 64]);
    let twill = random.one_of(&[1, 1, 2, 3]);
    let (seed, spread) = (random.seed(), random.uniform(0.05, 0.5));
    let uneven = smooth(random, SIZE, [6; 2]);
    let (round, drift) = (random.uniform(0.2, 0.7), random.uniform(0., 0.15));
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
    Surface { canvas, repeat_metres: random.uniform(0.15, 0.8) }
}

/// Draws knitted rows of loops.
pub(super) fn knit(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(1, 3));
    let columns = random.one_of(&[12, 16, 24, 32]);
    let seed = random.seed();
    let banded = random.chance(0.4);
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
    Surface { canvas, repeat_metres: random.uniform(0.1, 0.6) }
}

/// Draws carpet pile, felt or fur: fine and soft, brushed in some places.
pub(super) fn pile(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(1, 3));
    let fine = random.one_of(&[64, 96, 128, 200]);
    let stretch = random.one_of(&[[1, 1], [1, 1], [1, 3], [3, 1]]);
    let tufts = fractal(random, SIZE, stretch.map(|share| fine / share), 2, 0.8);
    let brushed = fractal(random, SIZE, [3; 2], 3, 0.5);
    let mixed = random.uniform(0.1, 0.6);
    let mut canvas = tufts.map(|value| palette.ramp(0.5 + mixed * value));
    canvas.shade(&tufts, random.uniform(0.05, 0.35));
    canvas.shade(&brushed, random.sqrt_uniform(0., 0.25));
    Surface { canvas, repeat_metres: random.uniform(0.4, 1.6) }
}

/// Draws cloth hanging in folds along v.
pub(super) fn folds(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(1, 3));
    let depth = random.uniform(0.15, 0.7);
    let (coarse, fine) = (random.count(4, 10), random.count(12, 28));
    let mut folds = smooth(random, SIZE, [coarse, 1]);
    let finer = smooth(random, SIZE, [fine, 2]);
    let strength = random.uniform(0.1, 0.7);
    folds.update_with(&finer, |fold, finer| fold + strength * finer);
    let printed = random.chance(0.3);
    let bands = random.count(2, 8) as f32;
    let canvas = Canvas::from_fn(SIZE, |uv| {
        let fold = folds.value(uv);
        let tone = if printed { (uv.y * bands).fract() } else { 0.5 + 0.3 * fold };
        palette.ramp(tone) * (1. + depth * fold).clamp(0.2, 1.6)
    });
    Surface { canvas, repeat_metres: random.uniform(0.8, 2.) }
}

/// Draws padded leather or cloth, buttoned in diamonds or stitched in channels.
pub(super) fn quilted(random: &Random, purpose: Purpose) -> Surface {
    let color = Palette::draw(random, purpose, 1).color(0);
    let across = random.count(2, 8) as f32;
    let kind = random.count(0, 2);
    let (deep, light) = (random.uniform(0.3, 0.8), random.direction());
    let height = Field::from_fn(SIZE, |uv| {
        let at = match kind {
            0 => Vec2::new(uv.x + uv.y, uv.x - uv.y) * across,
            1 => uv * across,
            _ => Vec2::new(uv.x * across, 0.5),
        };
        let part = (at - at.floor() - 0.5) * 2.;
        ((1. - part.x.powi(4)) * (1. - part.y.powi(4))).sqrt()
    });
    let mut canvas = height.map(|value| color * (1. - deep + deep * value));
    canvas.shade(&height.slope(light), random.uniform(1., 5.));
    canvas.shade(&fractal(random, SIZE, [24; 2], 4, 0.8), random.uniform(0.01, 0.12));
    Surface { canvas, repeat_metres: across * random.uniform(0.06, 0.2) }
}

/// Draws a whole carpet: borders around a field of small figures, with a medallion in the middle.
pub(super) fn carpet(random: &Random, _: Purpose) -> Surface {
    let count = random.count(3, 5);
    let themes = [(ACCENTS, 5.), (BROWNS, 2.), (BEIGES, 2.), (GRAYS, 1.), (VIVID, 0.5)];
    let palette = Palette::among(random, &themes, count);
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    let middle = Vec2::splat(0.5);
    // Paint the middle first, so that the borders cover what extends too far.
    let cells = random.count(4, 14);
    let small = Motif::draw(random, &palette);
    let crowd = random.uniform(0.3, 1.);
    for place in grid(cells, cells) {
        if random.chance(crowd) {
            small.paint(&mut canvas, place / cells as f32, 1. / cells as f32, Vec2::X);
        }
    }
    if random.chance(0.65) {
        let petals = 2 * random.count(2, 9);
        let (mut radius, depth) = (random.uniform(0.15, 0.38), random.uniform(0., 0.6));
        let squeeze = Vec2::new(1., random.uniform(0.7, 1.4));
        for layer in 0..random.count(2, 7) {
            let color = palette.color(layer + 1);
            let flower = Shape::flower(radius, petals, depth);
            canvas.stamp(middle, middle, |offset| (color, flower.distance(offset * squeeze)));
            radius *= random.uniform(0.6, 0.9);
        }
        Motif::draw(random, &palette).paint(&mut canvas, middle, 2. * radius, Vec2::X);
    }
    let mut inset = 0.;
    for border in 0..random.count(1, 6) {
        let width = random.sqrt_uniform(0.005, 0.07);
        let (color, other) = (palette.color(border + 1), palette.color(border + 2));
        let teeth = random.one_of(&[0., 0., 12., 20., 32., 48.]);
        canvas.update(|uv, below| {
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
    canvas.shade(&smooth(random, SIZE, [128; 2]), random.uniform(0.03, 0.2));
    Surface { canvas, repeat_metres: random.uniform(1.5, 3.5) }
}
