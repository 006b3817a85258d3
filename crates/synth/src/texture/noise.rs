//! Noise fields that repeat: smoothly interpolated lattices of random values, and sums of them.

use glam::Vec2;
use rand_chacha::ChaCha8Rng;

use super::field::Field;
use super::rng::RandomValues;

/// Interpolates a lattice of random values by cubic B-splines: about in [-1, 1], with `cells` per repeat in x and y.
pub(super) fn smooth(random: &mut ChaCha8Rng, size: usize, cells: [usize; 2]) -> Field {
    let [columns, rows] = cells.map(|count| count.clamp(1, size));
    // The spline halves the spread of uniform noise. With doubled lattice values, few results leave [-1, 1].
    let lattice: Vec<f32> = (0..columns * rows).map(|_| random.between(-2., 2.)).collect();
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
    octaves_of(random, size, cells, octaves, gain, |value| value)
}

/// Sums octaves like [`fractal`], each folded at 0: ridges of 1 between valleys.
pub(super) fn ridged(
    random: &mut ChaCha8Rng,
    size: usize,
    cells: [usize; 2],
    octaves: usize,
    gain: f32,
) -> Field {
    octaves_of(random, size, cells, octaves, gain, |value| 1. - 2. * value.abs().min(1.))
}

fn octaves_of(
    random: &mut ChaCha8Rng,
    size: usize,
    cells: [usize; 2],
    octaves: usize,
    gain: f32,
    fold: impl Fn(f32) -> f32,
) -> Field {
    let mut sum = Field { size, values: vec![0.; size * size] };
    let mut strength = 1.;
    let mut power = 0.;
    for octave in 0..octaves {
        let finer = cells.map(|count| count << octave);
        if finer.iter().any(|&count| count > size) {
            break;
        }
        sum = sum.plus(&smooth(random, size, finer).map(&fold), strength);
        power += strength * strength;
        strength *= gain;
    }
    let scale = 1. / f32::sqrt(power.max(1e-6));
    sum.map(|value| value * scale)
}

/// Returns a field whose positions are displaced by about `reach` repeats, in patches of which `cells` fit into a repeat.
pub(super) fn warped(random: &mut ChaCha8Rng, field: &Field, cells: usize, reach: f32) -> Field {
    let [right, down] = [(); 2].map(|()| fractal(random, field.size, [cells; 2], 3, 0.5));
    let mut index = 0;
    Field::from_fn(field.size, |uv| {
        let push = Vec2::new(right.values[index], down.values[index]);
        index += 1;
        field.sample(uv + push * reach)
    })
}
