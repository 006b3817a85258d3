//! Draws in the words of the families.

use glam::Vec2;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// What families ask a generator for.
pub(super) trait Chance {
    /// In [0, 1).
    fn unit(&mut self) -> f32;
    /// Evenly in [low, high).
    fn between(&mut self, low: f32, high: f32) -> f32;
    /// In [low, high), the lower the likelier: the square of an even draw between the roots.
    fn leaning_low(&mut self, low: f32, high: f32) -> f32;
    /// In (-1, 1), the nearer to 0 the likelier.
    fn bell(&mut self) -> f32;
    /// Whether something of this probability happens.
    fn happens(&mut self, probability: f32) -> bool;
    /// A whole number, both ends among them.
    fn count(&mut self, low: usize, high: usize) -> usize;
    /// One of them, all alike likely.
    fn one_of<T: Copy>(&mut self, choices: &[T]) -> T;
    /// One of them, by weights that needn't add up to 1.
    fn weighted<T: Copy>(&mut self, choices: &[(T, f32)]) -> T;
    /// Anywhere in the repeat.
    fn spot(&mut self) -> Vec2;
    /// A direction of length 1.
    fn direction(&mut self) -> Vec2;
    /// A seed for [`unit_of`].
    fn seed(&mut self) -> u32;
}

impl Chance for ChaCha8Rng {
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
        // What rounding leaves over belongs to the last that is possible at all.
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

/// A number in [0, 1) that `seed` and `id` decide, for pieces that are met in no order.
pub(super) fn unit_of(seed: u32, id: u32) -> f32 {
    let mut bits = seed ^ id.wrapping_mul(0x9e37_79b9);
    for multiplier in [0x7feb_352d_u32, 0x846c_a68b] {
        bits = (bits ^ (bits >> 16)).wrapping_mul(multiplier);
    }
    bits ^= bits >> 15;
    (bits >> 8) as f32 / (1 << 24) as f32
}
