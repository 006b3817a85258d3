//! Random draws, and scalar fields over one repeat of a texture: smooth noise and Voronoi cells.

use glam::{IVec2, Vec2};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::noise::hash;

/// Random draws that texture families need from a generator.
pub(super) trait RandomValues: Rng {
    /// Returns a uniform random value in [0, 1).
    fn unit(&mut self) -> f32 {
        self.random()
    }

    /// Returns a uniform random value in [low, high).
    fn uniform(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Returns a random value in [low, high) that favours low values: the square of a uniform draw between the square roots.
    fn sqrt_uniform(&mut self, low: f32, high: f32) -> f32 {
        let root = self.uniform(low.sqrt(), high.sqrt());
        root * root
    }

    /// Returns a random value in (-2, 2) with a bell-shaped distribution around 0.
    fn approx_normal(&mut self) -> f32 {
        self.unit() + self.unit() - self.unit() - self.unit()
    }

    /// Returns `true` with the given probability.
    fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    /// Returns a uniform random integer from `low` to `high`, both inclusive.
    fn count(&mut self, low: usize, high: usize) -> usize {
        self.random_range(low..=high)
    }

    /// Returns one of the choices, all equally likely.
    fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.random_range(0..choices.len())]
    }

    /// Returns one of the choices with the given weights, which needn't add up to 1.
    fn weighted<T: Copy>(&mut self, choices: &[(T, f32)]) -> T {
        let sum: f32 = choices.iter().map(|(_, weight)| weight).sum();
        let mut left = self.unit() * sum;
        let mut chosen = None;
        // Rounding errors fall to the last choice with a weight above 0.
        for &(choice, weight) in choices.iter().filter(|(_, weight)| *weight > 0.) {
            chosen = Some(choice);
            left -= weight;
            if left < 0. {
                break;
            }
        }
        chosen.expect("a weight above 0")
    }

    /// Returns a uniformly random position in the repeat.
    fn point(&mut self) -> Vec2 {
        Vec2::new(self.unit(), self.unit())
    }

    /// Returns a random direction of length 1.
    fn direction(&mut self) -> Vec2 {
        Vec2::from_angle(self.unit() * std::f32::consts::TAU)
    }

    /// Returns a seed for [`unit_of`].
    fn seed(&mut self) -> u32 {
        self.random()
    }
}

impl RandomValues for ChaCha8Rng {}

/// Returns a pseudo-random value in [0, 1) determined by `seed` and `id`, for pieces that are visited in no fixed order.
pub(super) fn unit_of(seed: u32, id: u32) -> f32 {
    let bits = hash(seed ^ id.wrapping_mul(0x9e37_79b9));
    ((bits ^ (bits >> 15)) >> 8) as f32 / (1 << 24) as f32
}

/// A square of values whose width is a power of two. It repeats in both directions.
#[derive(Clone)]
pub(super) struct Field {
    /// Number of values in a row.
    pub size: usize,
    /// Values row by row.
    pub values: Vec<f32>,
}

impl Field {
    /// Creates a field from a function of the center of each value's square, in repeats.
    pub fn from_fn(size: usize, mut value: impl FnMut(Vec2) -> f32) -> Field {
        let mut values = Vec::with_capacity(size * size);
        for y in 0..size {
            for x in 0..size {
                values.push(value((Vec2::new(x as f32, y as f32) + 0.5) / size as f32));
            }
        }
        Field { size, values }
    }

    /// Applies `change` to each value.
    pub fn map(mut self, change: impl Fn(f32) -> f32) -> Field {
        for value in &mut self.values {
            *value = change(*value);
        }
        self
    }

    /// Adds `factor` times another field of the same size.
    pub fn plus(mut self, other: &Field, factor: f32) -> Field {
        for (value, more) in self.values.iter_mut().zip(&other.values) {
            *value += factor * more;
        }
        self
    }

    /// Returns the field rescaled to [0, 1].
    pub fn stretched(self) -> Field {
        let low = self.values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = self.values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let scale = 1. / (high - low).max(1e-6);
        self.map(|value| (value - low) * scale)
    }

    /// Returns the value whose square contains `uv`, which is in [0, 1)².
    pub fn value(&self, uv: Vec2) -> f32 {
        let at = (uv * self.size as f32).as_uvec2();
        self.values[at.y as usize * self.size + at.x as usize]
    }

    /// Returns the bilinear interpolation of four values at `uv` in repeats.
    pub fn sample(&self, uv: Vec2) -> f32 {
        let at = uv * self.size as f32 - 0.5;
        let floor = at.floor();
        let part = at - floor;
        let (left, top) = (self.wrapped(floor.x as i32), self.wrapped(floor.y as i32));
        let (right, bottom) = (self.wrapped(left as i32 + 1), self.wrapped(top as i32 + 1));
        let row = |y: usize| {
            let (a, b) = (self.values[y * self.size + left], self.values[y * self.size + right]);
            a + (b - a) * part.x
        };
        let (above, below) = (row(top), row(bottom));
        above + (below - above) * part.y
    }

    /// Returns the slope in `direction`, per distance between values.
    pub fn slope(&self, direction: Vec2) -> Field {
        let mut values = Vec::with_capacity(self.values.len());
        for y in 0..self.size {
            let row = y * self.size;
            let above = self.wrapped(y as i32 - 1) * self.size;
            let below = self.wrapped(y as i32 + 1) * self.size;
            for x in 0..self.size {
                let (left, right) = (self.wrapped(x as i32 - 1), self.wrapped(x as i32 + 1));
                let rise = Vec2::new(
                    self.values[row + right] - self.values[row + left],
                    self.values[below + x] - self.values[above + x],
                );
                values.push(0.5 * rise.dot(direction));
            }
        }
        Field { size: self.size, values }
    }

    fn wrapped(&self, index: i32) -> usize {
        index as usize & (self.size - 1)
    }
}

/// Interpolates a lattice of random values by cubic B-splines: about in [-1, 1], with `cells` per repeat in x and y.
pub(super) fn smooth(random: &mut ChaCha8Rng, size: usize, cells: [usize; 2]) -> Field {
    let [columns, rows] = cells.map(|count| count.clamp(1, size));
    // The spline halves the spread of uniform noise. With doubled lattice values, few results leave [-1, 1].
    let lattice: Vec<f32> = (0..columns * rows).map(|_| random.uniform(-2., 2.)).collect();
    let mut wide = vec![0f32; rows * size];
    for x in 0..size {
        let (first, weights) = spline(x, size, columns);
        for y in 0..rows {
            let row = &lattice[y * columns..(y + 1) * columns];
            wide[y * size + x] = (0..4).map(|i| weights[i] * row[(first + i) % columns]).sum();
        }
    }
    let mut values = Vec::with_capacity(size * size);
    for y in 0..size {
        let (first, weights) = spline(y, size, rows);
        let [a, b, c, d] = [0, 1, 2, 3].map(|i| {
            let row = (first + i) % rows * size;
            &wide[row..row + size]
        });
        let between = |x| weights[0] * a[x] + weights[1] * b[x] + weights[2] * c[x] + weights[3] * d[x];
        values.extend((0..size).map(between));
    }
    Field { size, values }
}

/// Returns the first of the four lattice points of a cubic B-spline for element `index` of a row, and their weights.
fn spline(index: usize, size: usize, points: usize) -> (usize, [f32; 4]) {
    let at = (index as f32 + 0.5) / size as f32 * points as f32;
    let floor = at.floor();
    let t = at - floor;
    let rest = 1. - t;
    let weights = [
        rest * rest * rest / 6.,
        (4. - 6. * t * t + 3. * t * t * t) / 6.,
        (4. - 6. * rest * rest + 3. * rest * rest * rest) / 6.,
        t * t * t / 6.,
    ];
    (floor as usize + points - 1, weights)
}

/// Sums octaves of [`smooth`], each with twice the frequency and `gain` times the amplitude of the previous one; about in [-1, 1].
pub(super) fn fractal(
    random: &mut ChaCha8Rng,
    size: usize,
    cells: [usize; 2],
    octaves: usize,
    gain: f32,
) -> Field {
    folded_fractal(random, size, cells, octaves, gain, |value| value)
}

/// Sums octaves like [`fractal`], each of whose values is mapped by `fold`.
pub(super) fn folded_fractal(
    random: &mut ChaCha8Rng,
    size: usize,
    cells: [usize; 2],
    octaves: usize,
    gain: f32,
    fold: fn(f32) -> f32,
) -> Field {
    let mut sum = Field { size, values: vec![0.; size * size] };
    let mut strength = 1.;
    let mut power = 0.;
    for octave in 0..octaves {
        let finer = cells.map(|count| count << octave);
        if finer.iter().any(|&count| count > size) {
            break;
        }
        sum = sum.plus(&smooth(random, size, finer).map(fold), strength);
        power += strength * strength;
        strength *= gain;
    }
    let scale = 1. / f32::sqrt(power.max(1e-6));
    sum.map(|value| value * scale)
}

/// Folds noise at 0: ridges of 1 between valleys.
pub(super) fn ridge(value: f32) -> f32 {
    1. - 2. * value.abs().min(1.)
}

/// Returns a field whose positions are displaced by about `reach` repeats, in patches of which `cells` fit into a repeat.
pub(super) fn warped(random: &mut ChaCha8Rng, field: &Field, cells: usize, reach: f32) -> Field {
    let [right, down] = [(); 2].map(|()| fractal(random, field.size, [cells; 2], 3, 0.5));
    Field::from_fn(field.size, |uv| {
        let push = Vec2::new(right.value(uv), down.value(uv));
        field.sample(uv + push * reach)
    })
}

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
    /// Places points at random offsets from the centers of squares, with `jitter` from 0 to 1 of a square. With `staggered`, every
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
            let off = (random.point() - 0.5) * jitter + 0.5;
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
