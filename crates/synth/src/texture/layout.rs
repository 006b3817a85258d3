//! Layouts of pieces over one repeat: bricks, tiles, planks, stones.

use glam::{IVec2, Vec2, Vec2Swizzles};

use crate::random::Random;

/// Arrangement of pieces, as a function that returns the piece at a position.
pub(super) struct Layout(Box<dyn Fn(Vec2) -> Piece>);

/// The piece at a position.
pub(super) struct Piece {
    /// Identifier that is constant over the piece.
    pub id: u32,
    /// Offset from the piece's corner, or from its point for cells, in repeats; x is along its length.
    pub at: Vec2,
    /// Length and width of the piece in repeats; approximate for cells.
    pub extent: Vec2,
    /// Distance to the nearest edge of the piece, in repeats.
    pub edge: f32,
}

impl Layout {
    /// Creates rows of equal pieces, each row shifted by `shift` of a piece relative to the one above. All shifts together must be
    /// a whole number.
    pub fn courses(rows: usize, columns: usize, shift: f32, upright: bool) -> Layout {
        let tops = (0..=rows).map(|row| row as f32 / rows as f32).collect();
        let cuts = |row: usize| {
            let start = (row as f32 * shift).fract();
            (0..columns).map(|column| (column as f32 + start) / columns as f32).collect()
        };
        Layout::rows(tops, (0..rows).map(cuts).collect(), upright)
    }

    /// Creates rows of about equal height, each with about `columns` pieces of different lengths.
    pub fn ragged(random: &Random, rows: usize, columns: f32, unequal_rows: f32, upright: bool) -> Layout {
        let heights: Vec<f32> = (0..rows).map(|_| 1. + unequal_rows * random.within(-0.5..0.5)).collect();
        let mut tops = vec![0.];
        let sum: f32 = heights.iter().sum();
        tops.extend(heights.iter().scan(0., |top, height| {
            *top += height / sum;
            Some(*top)
        }));
        let cuts = (0..rows).map(|_| {
            let pieces = (columns * random.within(0.7..1.3)).round().max(1.) as usize;
            let start = random.within(0. ..1.);
            let mut cuts: Vec<f32> = (0..pieces)
                .map(|piece| {
                    (start + (piece as f32 + random.within(-0.3..0.3)) / pieces as f32).rem_euclid(1.)
                })
                .collect();
            cuts.sort_by(f32::total_cmp);
            cuts
        });
        Layout::rows(tops, cuts.collect(), upright)
    }

    /// Creates rows of pieces: the rows begin at `tops` in [0, 1] and end at 1, and `cuts` separate the pieces of each row.
    fn rows(tops: Vec<f32>, cuts: Vec<Vec<f32>>, upright: bool) -> Layout {
        Layout(Box::new(move |uv| {
            let uv = if upright { uv.yx() } else { uv };
            let row = tops.partition_point(|&top| top <= uv.y).clamp(1, cuts.len()) - 1;
            let cuts = &cuts[row];
            let after = cuts.partition_point(|&cut| cut <= uv.x);
            let start = if after == 0 { cuts[cuts.len() - 1] - 1. } else { cuts[after - 1] };
            let end = if after == cuts.len() { cuts[0] + 1. } else { cuts[after] };
            let number = (after + cuts.len() - 1) % cuts.len();
            let at = uv - Vec2::new(start, tops[row]);
            let extent = Vec2::new(end - start, tops[row + 1] - tops[row]);
            Piece::within((row * 64 + number) as u32, at, extent)
        }))
    }

    /// Creates squares standing on their corners, `across` per repeat.
    pub fn diamonds(across: usize) -> Layout {
        let count = across as f32;
        Layout(Box::new(move |uv| {
            let turned = Vec2::new(uv.x + uv.y, uv.x - uv.y) * count;
            let cell = turned.floor();
            // A repeat to the right adds (count, count), one down (count, -count): reduce by both.
            let double = 2. * count;
            let sum = (cell.x + cell.y).rem_euclid(double);
            let difference = (cell.x - cell.y).rem_euclid(double);
            let side = std::f32::consts::FRAC_1_SQRT_2 / count;
            Piece::within((sum * double + difference) as u32, (turned - cell) * side, Vec2::splat(side))
        }))
    }

    /// Creates the Voronoi cells of one point in each square of a grid. The points have random offsets from the centers of the squares,
    /// with `jitter` from 0 to 1 of a square. With `staggered`, every other row is shifted by half a square, which makes hexagons if
    /// there is no jitter and requires an even number of rows.
    pub fn cells(random: &Random, columns: usize, rows: usize, jitter: f32, staggered: bool) -> Layout {
        let count = Vec2::new(columns as f32, rows as f32);
        let mut point = |index: usize| {
            let (x, y) = (index % columns, index / columns);
            let shift = if staggered && y % 2 == 1 { 0.5 } else { 0. };
            let off = (random.point() - 0.5) * jitter + 0.5;
            (Vec2::new(x as f32 + shift, y as f32) + off) / count
        };
        let points: Vec<Vec2> = (0..columns * rows).map(&mut point).collect();
        let (columns, rows) = (columns as i32, rows as i32);
        // Returns the point of a grid square, which may lie in another repeat, and the square's index.
        let point = move |square: IVec2| {
            let (x, y) = (square.x.rem_euclid(columns), square.y.rem_euclid(rows));
            let index = (y * columns + x) as usize;
            let repeat = Vec2::new(((square.x - x) / columns) as f32, ((square.y - y) / rows) as f32);
            (points[index] + repeat, index as u32)
        };
        Layout(Box::new(move |uv| {
            let home = (uv * count).floor().as_ivec2();
            let mut nearest = (f32::INFINITY, Vec2::ZERO, 0, home);
            for y in -1..=1 {
                for x in -1..=1 {
                    let square = home + IVec2::new(x, y);
                    let (point, id) = point(square);
                    let away = point.distance_squared(uv);
                    if away < nearest.0 {
                        nearest = (away, point, id, square);
                    }
                }
            }
            let (_, own, id, square) = nearest;
            let mut edge = f32::INFINITY;
            for y in -2..=2i32 {
                for x in -2..=2i32 {
                    // Cells at the corners of this block hardly ever touch.
                    if (x, y) == (0, 0) || x.abs() + y.abs() == 4 {
                        continue;
                    }
                    let (other, _) = point(square + IVec2::new(x, y));
                    let across = other - own;
                    let halfway = 0.5 * (own + other);
                    edge = edge.min((halfway - uv).dot(across) / across.length().max(1e-6));
                }
            }
            let (at, edge) = (uv - own, edge.max(0.));
            Piece { id, at, extent: Vec2::splat(2. * (edge + at.length())), edge }
        }))
    }

    /// Returns the piece at `uv` in [0, 1)². Cells also extend beyond it.
    pub fn piece(&self, uv: Vec2) -> Piece {
        (self.0)(uv)
    }
}

impl Piece {
    fn within(id: u32, at: Vec2, extent: Vec2) -> Piece {
        let edge = at.min(extent - at).min_element().max(0.);
        Piece { id, at, extent, edge }
    }
}
