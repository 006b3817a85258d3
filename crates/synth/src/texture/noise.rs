//! Smooth noise over one repeat of a texture.

use glam::Vec2;

use super::SIZE;
use super::canvas::{Field, Raster};
use crate::noise::hash;
use crate::random::Random;

/// Returns a pseudo-random value in [0, 1) determined by `seed` and `id`, for pieces that are visited in no fixed order.
pub(super) fn unit_of(seed: u32, id: u32) -> f32 {
    let bits = hash(seed ^ id.wrapping_mul(0x9e37_79b9));
    ((bits ^ (bits >> 15)) >> 8) as f32 / (1 << 24) as f32
}

/// Interpolates a lattice of random values by cubic B-splines: about in [-1, 1], with `cells` per repeat in x and y.
pub(super) fn smooth(random: &Random, cells: [usize; 2]) -> Field {
    let [columns, rows] = cells.map(|count| count.clamp(1, SIZE));
    // The spline halves the spread of uniform noise. With doubled lattice values, few results leave [-1, 1].
    let lattice: Vec<f32> = (0..columns * rows).map(|_| random.within(-2. ..2.)).collect();
    let mut wide = vec![0f32; rows * SIZE];
    for x in 0..SIZE {
        let (first, weights) = spline(x, columns);
        for y in 0..rows {
            let row = &lattice[y * columns..(y + 1) * columns];
            wide[y * SIZE + x] = (0..4).map(|i| weights[i] * row[(first + i) % columns]).sum();
        }
    }
    let mut values = Vec::with_capacity(SIZE * SIZE);
    for y in 0..SIZE {
        let (first, weights) = spline(y, rows);
        let [a, b, c, d] = [0, 1, 2, 3].map(|i| &wide[(first + i) % rows * SIZE..][..SIZE]);
        let between = |x| weights[0] * a[x] + weights[1] * b[x] + weights[2] * c[x] + weights[3] * d[x];
        values.extend((0..SIZE).map(between));
    }
    Raster(values)
}

/// Returns the first of the four lattice points of a cubic B-spline for element `index` of a row, and their weights.
fn spline(index: usize, points: usize) -> (usize, [f32; 4]) {
    let at = (index as f32 + 0.5) / SIZE as f32 * points as f32;
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
pub(super) fn fractal(random: &Random, cells: [usize; 2], octaves: usize, gain: f32) -> Field {
    let mut sum = Field::filled(0.);
    let (mut strength, mut power) = (1., 0f32);
    for octave in 0..octaves {
        let finer = cells.map(|count| count << octave);
        if finer.iter().any(|&count| count > SIZE) {
            break;
        }
        sum.update_with(&smooth(random, finer), |sum, value| sum + strength * value);
        power += strength * strength;
        strength *= gain;
    }
    sum.map(|value| value / power.max(1e-6).sqrt())
}

/// Returns a field whose positions are displaced by about `reach` repeats, in patches of which `cells` fit into a repeat.
pub(super) fn warped(random: &Random, field: &Field, cells: usize, reach: f32) -> Field {
    let [right, down] = [(); 2].map(|()| fractal(random, [cells; 2], 3, 0.5));
    Field::from_fn(|uv| field.sample(uv + Vec2::new(right.value(uv), down.value(uv)) * reach))
}
