//! Layouts of pieces over one repeat: bricks, tiles, planks, stones.

use glam::{Vec2, Vec2Swizzles};
use rand_chacha::ChaCha8Rng;

use super::noise::{RandomValues, Voronoi};

/// Arrangement of pieces.
pub(super) enum Layout {
    /// Rows of pieces separated by cuts: the rows' tops in [0, 1], and the cuts of each row.
    Courses { tops: Vec<f32>, cuts: Vec<Vec<f32>>, upright: bool },
    /// Strips `long` times as long as wide, in a zigzag. A repeat is `across` strip widths wide, a multiple of 2 `long`.
    Herringbone { across: usize, long: usize },
    /// Squares of `long` strips each, alternately horizontal and upright. A repeat has `squares` of them per side, an even number.
    Basket { squares: usize, long: usize },
    /// Squares standing on their corners, `across` per repeat.
    Diamonds { across: usize },
    /// Cells around points.
    Cells(Voronoi),
    /// Rectangles of whole squares: the rectangle that each square belongs to, and the rectangles' corners and extents.
    Quilt { squares: usize, owners: Vec<u32>, pieces: Vec<(Vec2, Vec2)> },
}

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
        Layout::Courses { tops, cuts: (0..rows).map(cuts).collect(), upright }
    }

    /// Creates rows of about equal height, each with about `columns` pieces of different lengths.
    pub fn ragged(
        random: &mut ChaCha8Rng,
        rows: usize,
        columns: f32,
        unequal_rows: f32,
        upright: bool,
    ) -> Layout {
        let heights: Vec<f32> = (0..rows).map(|_| 1. + unequal_rows * random.uniform(-0.5, 0.5)).collect();
        let mut tops = vec![0.];
        let sum: f32 = heights.iter().sum();
        tops.extend(heights.iter().scan(0., |top, height| {
            *top += height / sum;
            Some(*top)
        }));
        let cuts = (0..rows).map(|_| {
            let pieces = (columns * random.uniform(0.7, 1.3)).round().max(1.) as usize;
            let start = random.unit();
            let mut cuts: Vec<f32> = (0..pieces)
                .map(|piece| {
                    (start + (piece as f32 + random.uniform(-0.3, 0.3)) / pieces as f32).rem_euclid(1.)
                })
                .collect();
            cuts.sort_by(f32::total_cmp);
            cuts
        });
        Layout::Courses { tops, cuts: cuts.collect(), upright }
    }

    /// Creates rectangles of up to `largest` squares per side that fill a repeat.
    pub fn quilt(random: &mut ChaCha8Rng, squares: usize, largest: usize) -> Layout {
        const FREE: u32 = u32::MAX;
        let mut owners = vec![FREE; squares * squares];
        let mut pieces = Vec::new();
        for first in 0..squares * squares {
            if owners[first] != FREE {
                continue;
            }
            let (x, y) = (first % squares, first / squares);
            let (wide, high) = (random.count(1, largest), random.count(1, largest));
            let covered = |wide: usize, high: usize| {
                (0..high).flat_map(move |j| {
                    (0..wide).map(move |i| (y + j) % squares * squares + (x + i) % squares)
                })
            };
            let fits = |wide: usize, high: usize| covered(wide, high).all(|square| owners[square] == FREE);
            let wide = (1..=wide).take_while(|&wide| fits(wide, 1)).last().unwrap_or(1);
            let high = (1..=high).take_while(|&high| fits(wide, high)).last().unwrap_or(1);
            for square in covered(wide, high).collect::<Vec<_>>() {
                owners[square] = pieces.len() as u32;
            }
            let scale = 1. / squares as f32;
            let corner = Vec2::new(x as f32, y as f32) * scale;
            pieces.push((corner, Vec2::new(wide as f32, high as f32) * scale));
        }
        Layout::Quilt { squares, owners, pieces }
    }

    /// Returns the piece at `uv`.
    pub fn piece(&self, uv: Vec2) -> Piece {
        let uv = uv - uv.floor();
        match self {
            Layout::Courses { tops, cuts, upright } => {
                let uv = if *upright { uv.yx() } else { uv };
                let row = tops.partition_point(|&top| top <= uv.y).clamp(1, cuts.len()) - 1;
                let cuts = &cuts[row];
                let after = cuts.partition_point(|&cut| cut <= uv.x);
                let start = if after == 0 { cuts[cuts.len() - 1] - 1. } else { cuts[after - 1] };
                let end = if after == cuts.len() { cuts[0] + 1. } else { cuts[after] };
                let number = (after + cuts.len() - 1) % cuts.len();
                let at = uv - Vec2::new(start, tops[row]);
                let extent = Vec2::new(end - start, tops[row + 1] - tops[row]);
                Piece::within((row * 64 + number) as u32, at, extent)
            }
            Layout::Herringbone { across, long } => {
                let scale = *across as f32;
                let cell = (uv * scale).floor().as_ivec2();
                let part = uv * scale - cell.as_vec2();
                let (long, across) = (*long as i32, *across as i32);
                let phase = (cell.x - cell.y).rem_euclid(2 * long);
                let (start, at) = if phase < long {
                    (cell - glam::IVec2::new(phase, 0), part + Vec2::new(phase as f32, 0.))
                } else {
                    let passed = 2 * long - 1 - phase;
                    (cell - glam::IVec2::new(0, passed), part.yx() + Vec2::new(passed as f32, 0.))
                };
                let id = start.x.rem_euclid(across) * across + start.y.rem_euclid(across);
                let extent = Vec2::new(long as f32, 1.) / scale;
                Piece::within(id as u32, at / scale, extent)
            }
            Layout::Basket { squares, long } => {
                let scale = *squares as f32;
                let cell = (uv * scale).floor().min(Vec2::splat(scale - 1.));
                let part = uv * scale - cell;
                let upright = (cell.x + cell.y) as usize % 2 == 1;
                let part = if upright { part.yx() } else { part };
                let strip = (part.y * *long as f32).floor();
                let at = Vec2::new(part.x, part.y - strip / *long as f32) / scale;
                let id = ((cell.y * scale + cell.x) * *long as f32 + strip) as u32;
                Piece::within(id, at, Vec2::new(1., 1. / *long as f32) / scale)
            }
            Layout::Diamonds { across } => {
                let count = *across as f32;
                let turned = Vec2::new(uv.x + uv.y, uv.x - uv.y) * count;
                let cell = turned.floor();
                // A repeat to the right adds (count, count), one down (count, -count): reduce by both.
                let double = 2. * count;
                let sum = (cell.x + cell.y).rem_euclid(double);
                let difference = (cell.x - cell.y).rem_euclid(double);
                let side = std::f32::consts::FRAC_1_SQRT_2 / count;
                Piece::within((sum * double + difference) as u32, (turned - cell) * side, Vec2::splat(side))
            }
            Layout::Cells(voronoi) => {
                let cell = voronoi.cell(uv);
                let extent = Vec2::splat(2. * (cell.edge + cell.offset.length()));
                Piece { id: cell.id, at: cell.offset, extent, edge: cell.edge }
            }
            Layout::Quilt { squares, owners, pieces } => {
                let cell = (uv * *squares as f32).as_uvec2().min(glam::UVec2::splat(*squares as u32 - 1));
                let owner = owners[cell.y as usize * squares + cell.x as usize];
                let (corner, extent) = pieces[owner as usize];
                let at = uv - corner;
                Piece::within(owner, at - at.floor(), extent)
            }
        }
    }
}

impl Piece {
    fn within(id: u32, at: Vec2, extent: Vec2) -> Piece {
        let edge = at.min(extent - at).min_element().max(0.);
        Piece { id, at, extent, edge }
    }
}
