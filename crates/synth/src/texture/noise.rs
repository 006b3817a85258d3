//! Random draws, and smooth noise over one repeat of a texture.

use glam::Vec2;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::cell::RefCell;

use super::canvas::Field;
use crate::noise::hash;

/// Handle of a random number generator, whose draws may be arguments of each other.
pub(super) struct Random<'a>(RefCell<&'a mut ChaCha8Rng>);

impl<'a> Random<'a> {
    pub fn new(generator: &'a mut ChaCha8Rng) -> Random<'a> {
        Random(RefCell::new(generator))
    }

    /// Returns a uniform random value in [0, 1).
    pub fn unit(&self) -> f32 {
        self.0.borrow_mut().random()
    }

    /// Returns a uniform random value in [low, high).
    pub fn uniform(&self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Returns a random value in [low, high) that favours low values: the square of a uniform draw between the square roots.
    pub fn sqrt_uniform(&self, low: f32, high: f32) -> f32 {
        let root = self.uniform(low.sqrt(), high.sqrt());
        root * root
    }

    /// Returns a random value in (-2, 2) with a bell-shaped distribution around 0.
    pub fn approx_normal(&self) -> f32 {
        self.unit() + self.unit() - self.unit() - self.unit()
    }

    /// Returns `true` with the given probability.
    pub fn chance(&self, probability: f32) -> bool {
        self.unit() < probability
    }

    /// Returns a uniform random integer from `low` to `high`, both inclusive.
    pub fn count(&self, low: usize, high: usize) -> usize {
        self.0.borrow_mut().random_range(low..=high)
    }

    /// Returns one of the choices, all equally likely.
    pub fn one_of<T: Copy>(&self, choices: &[T]) -> T {
        choices[self.0.borrow_mut().random_range(0..choices.len())]
    }

    /// Returns one of the choices with the given weights, which needn't add up to 1.
    pub fn weighted<T: Copy>(&self, choices: &[(T, f32)]) -> T {
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
    pub fn point(&self) -> Vec2 {
        Vec2::new(self.unit(), self.unit())
    }

    /// Returns a random direction of length 1.
    pub fn direction(&self) -> Vec2 {
        Vec2::from_angle(self.unit() * std::f32::consts::TAU)
    }

    /// Returns a seed for [`unit_of`].
    pub fn seed(&self) -> u32 {
        self.0.borrow_mut().random()
    }
}

/// Returns a pseudo-random value in [0, 1) determined by `seed` and `id`, for pieces that are visited in no fixed order.
pub(super) fn unit_of(seed: u32, id: u32) -> f32 {
    let bits = hash(seed ^ id.wrapping_mul(0x9e37_79b9));
    ((bits ^ (bits >> 15)) >> 8) as f32 / (1 << 24) as f32
}

/// Interpolates a lattice of random values by cubic B-splines: about in [-1, 1], with `cells` per repeat in x and y.
pub(super) fn smooth(random: &Random, size: usize, cells: [usize; 2]) -> Field {
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
    Field::new(size, values)
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
pub(super) fn fractal(random: &Random, size: usize, cells: [usize; 2], octaves: usize, gain: f32) -> Field {
    folded_fractal(random, size, cells, octaves, gain, |value| value)
}

/// Sums octaves like [`fractal`], each of whose values is mapped by `fold`.
pub(super) fn folded_fractal(
    random: &Random,
    size: usize,
    cells: [usize; 2],
    octaves: usize,
    gain: f32,
    fold: fn(f32) -> f32,
) -> Field {
    let mut sum = Field::filled(size, 0.);
    let mut strength = 1.;
    let mut power = 0.;
    for octave in 0..octaves {
        let finer = cells.map(|count| count << octave);
        if finer.iter().any(|&count| count > size) {
            break;
        }
        sum.update_with(&smooth(random, size, finer), |sum, value| sum + strength * fold(value));
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
pub(super) fn warped(random: &Random, field: &Field, cells: usize, reach: f32) -> Field {
    let [right, down] = [(); 2].map(|()| fractal(random, field.size, [cells; 2], 3, 0.5));
    Field::from_fn(field.size, |uv| {
        let push = Vec2::new(right.value(uv), down.value(uv));
        field.sample(uv + push * reach)
    })
}
