//! Scalar fields over one repeat of a texture.

use glam::Vec2;

/// A square of values whose width is a power of two. It repeats in both directions.
#[derive(Clone)]
pub(super) struct Field {
    /// Number of values in a row.
    pub size: usize,
    /// Values row by row.
    pub values: Vec<f32>,
}

impl Field {
    /// Creates a field from a function of the centre of each value's square, in repeats.
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
