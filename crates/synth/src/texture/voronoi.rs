//! Voronoi cells around points that repeat.

use glam::{IVec2, Vec2};
use rand_chacha::ChaCha8Rng;

use super::rng::RandomValues;

/// Voronoi diagram of one point in each square of a grid over the repeat.
pub(super) struct Voronoi {
    columns: i32,
    rows: i32,
    points: Vec<Vec2>,
}

/// The cell that contains a position.
pub(super) struct Cell {
    /// Index of the grid square that contains the cell's point.
    pub id: u32,
    /// Offset from the cell's point, in repeats.
    pub offset: Vec2,
    /// Distance to the nearest border, in repeats.
    pub edge: f32,
}

impl Voronoi {
    /// Places points at random offsets from the centres of squares, with `jitter` from 0 to 1 of a square. With `staggered`, every
    /// other row is shifted by half a square, which makes hexagons if there is no jitter and requires an even number of rows.
    pub fn new(
        random: &mut ChaCha8Rng,
        columns: usize,
        rows: usize,
        jitter: f32,
        staggered: bool,
    ) -> Voronoi {
        let count = Vec2::new(columns as f32, rows as f32);
        let point = |index: usize, random: &mut ChaCha8Rng| {
            let (x, y) = (index % columns, index / columns);
            let shift = if staggered && y % 2 == 1 { 0.5 } else { 0. };
            let off = (random.spot() - 0.5) * jitter + 0.5;
            (Vec2::new(x as f32 + shift, y as f32) + off) / count
        };
        let points = (0..columns * rows).map(|index| point(index, random)).collect();
        Voronoi { columns: columns as i32, rows: rows as i32, points }
    }

    /// Returns the point of a grid square, which may lie in another repeat, and the square's index.
    fn point(&self, square: IVec2) -> (Vec2, u32) {
        let (x, y) = (square.x.rem_euclid(self.columns), square.y.rem_euclid(self.rows));
        let index = (y * self.columns + x) as usize;
        let repeat = Vec2::new(((square.x - x) / self.columns) as f32, ((square.y - y) / self.rows) as f32);
        (self.points[index] + repeat, index as u32)
    }

    /// Returns the cell at `uv`.
    pub fn cell(&self, uv: Vec2) -> Cell {
        let home = (uv * Vec2::new(self.columns as f32, self.rows as f32)).floor().as_ivec2();
        let mut nearest = (f32::INFINITY, Vec2::ZERO, 0, home);
        for y in -1..=1 {
            for x in -1..=1 {
                let square = home + IVec2::new(x, y);
                let (point, id) = self.point(square);
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
                let (other, _) = self.point(square + IVec2::new(x, y));
                let across = other - own;
                let halfway = 0.5 * (own + other);
                edge = edge.min((halfway - uv).dot(across) / across.length().max(1e-6));
            }
        }
        Cell { id, offset: uv - own, edge: edge.max(0.) }
    }
}
