//! Random draws for texture families.

use glam::Vec2;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Random draws that texture families need from a generator.
pub(super) trait RandomValues {
    /// Returns a uniform random value in [0, 1).
    fn unit(&mut self) -> f32;
    /// Returns a uniform random value in [low, high).
    fn between(&mut self, low: f32, high: f32) -> f32;
    /// Returns a random value in [low, high) that favours low values: the square of a uniform draw between the square roots.
    fn leaning_low(&mut self, low: f32, high: f32) -> f32;
    /// Returns a random value in (-2, 2) with a bell-shaped distribution around 0.
    fn bell(&mut self) -> f32;
    /// Returns `true` with the given probability.
    fn happens(&mut self, probability: f32) -> bool;
    /// Returns a uniform random integer from `low` to `high`, both inclusive.
    fn count(&mut self, low: usize, high: usize) -> usize;
    /// Returns one of the choices, all equally likely.
    fn one_of<T: Copy>(&mut self, choices: &[T]) -> T;
    /// Returns one of the choices with the given weights, which needn't add up to 1.
    fn weighted<T: Copy>(&mut self, choices: &[(T, f32)]) -> T;
    /// Returns a uniformly random position in the repeat.
    fn spot(&mut self) -> Vec2;
    /// Returns a random direction of length 1.
    fn direction(&mut self) -> Vec2;
    /// Returns a seed for [`unit_of`].
    fn seed(&mut self) -> u32;
}

impl RandomValues for ChaCha8Rng {
    fn unit(&mut self) -> f32 {
        self.random()
    }

    fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    fn leaning_low(&mut self, low: f32, high: f32) -> f32 {
        let root = self.between(low.sqrt(), high.sqrt());
        root * root
    }

    fn bell(&mut self) -> f32 {
        self.unit() + self.unit() - self.unit() - self.unit()
    }

    fn happens(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    fn count(&mut self, low: usize, high: usize) -> usize {
        self.random_range(low..=high)
    }

    fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.random_range(0..choices.len())]
    }

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

    fn spot(&mut self) -> Vec2 {
        Vec2::new(self.unit(), self.unit())
    }

    fn direction(&mut self) -> Vec2 {
        Vec2::from_angle(self.unit() * std::f32::consts::TAU)
    }

    fn seed(&mut self) -> u32 {
        self.random()
    }
}

/// Returns a pseudo-random value in [0, 1) determined by `seed` and `id`, for pieces that are visited in no fixed order.
pub(super) fn unit_of(seed: u32, id: u32) -> f32 {
    let mut bits = seed ^ id.wrapping_mul(0x9e37_79b9);
    for multiplier in [0x7feb_352d_u32, 0x846c_a68b] {
        bits = (bits ^ (bits >> 16)).wrapping_mul(multiplier);
    }
    bits ^= bits >> 15;
    (bits >> 8) as f32 / (1 << 24) as f32
}
