//! Smooth random fields.

use glam::{IVec3, Vec3};

/// Value noise: random values on the integer lattice, smoothly interpolated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Noise {
    seed: u32,
}

impl Noise {
    pub const fn new(seed: u32) -> Self {
        Noise { seed }
    }

    /// Returns the noise at `place`, in [-1, 1].
    pub fn sample(&self, place: Vec3) -> f32 {
        let floor = place.floor();
        let fraction = place - floor;
        let weight = fraction * fraction * (3. - 2. * fraction);
        let cell = floor.as_ivec3();
        let edge = |y, z| {
            let [a, b] = [0, 1].map(|x| self.corner(cell + IVec3::new(x, y, z)));
            a + weight.x * (b - a)
        };
        let face = |z| edge(0, z) + weight.y * (edge(1, z) - edge(0, z));
        face(0) + weight.z * (face(1) - face(0))
    }

    /// Returns the weighted mean of `octaves` octaves of noise at `place`, in [-1, 1]. Each octave has twice the frequency and half the
    /// weight of the previous one.
    pub fn fractal(&self, place: Vec3, octaves: u32) -> f32 {
        let terms = (0..octaves).map(|octave| {
            let scale = (1 << octave) as f32;
            (self.sample(place * scale + 17.1 * octave as f32) / scale, 1. / scale)
        });
        let (sum, total) = terms.fold((0., 0.), |(sum, total), (term, weight)| (sum + term, total + weight));
        sum / total
    }

    /// Returns the random value of the lattice point `cell`, in [-1, 1].
    fn corner(&self, cell: IVec3) -> f32 {
        let [x, y, z] = cell.to_array().map(|i| i as u32);
        let place = x.wrapping_mul(0x8da6_b343) ^ y.wrapping_mul(0xd816_3841) ^ z.wrapping_mul(0xcb1a_b31f);
        let bits = hash(self.seed ^ place);
        (bits ^ (bits >> 16)) as f32 * (2. / u32::MAX as f32) - 1.
    }
}

/// Hashes `bits`, so that every bit of them affects every higher bit of the result.
pub(super) fn hash(mut bits: u32) -> u32 {
    for factor in [0x7feb_352d, 0x846c_a68b] {
        bits = (bits ^ (bits >> 16)).wrapping_mul(factor);
    }
    bits
}
