//! Random draws.

use glam::{Vec2, Vec3};
use rand::Rng;
use rand::distr::uniform::{SampleRange, SampleUniform};
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use std::cell::RefCell;
use std::f32::consts::TAU;

/// A random number generator that can be shared, so that draws may be arguments of each other.
pub(super) struct Random(RefCell<ChaCha8Rng>);

impl Random {
    pub fn new(generator: ChaCha8Rng) -> Random {
        Random(generator.into())
    }

    pub fn within<T: SampleUniform>(&self, range: impl SampleRange<T>) -> T {
        self.0.borrow_mut().random_range(range)
    }

    /// Returns a random value in [`low`, `high`) on a logarithmic scale: each doubling is equally likely.
    pub fn log_uniform(&self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.within(0. ..1.))
    }

    /// Returns a random value in [`low`, `high`) that favours low values: the square of a uniform draw between the square roots.
    pub fn sqrt_uniform(&self, low: f32, high: f32) -> f32 {
        self.within(low.sqrt()..high.sqrt()).powi(2)
    }

    /// Returns a random value in (-2, 2) with a bell-shaped distribution around 0.
    pub fn approx_normal(&self) -> f32 {
        (0..4).map(|_| self.within(-0.5..0.5)).sum()
    }

    /// Returns a vector whose components are uniformly random between the given bounds.
    pub fn vector(&self, bounds: [(f32, f32); 3]) -> Vec3 {
        bounds.map(|(low, high)| self.within(low..high)).into()
    }

    /// Returns a vector whose components are drawn by [`Random::log_uniform`].
    pub fn log_vector(&self, bounds: [(f32, f32); 3]) -> Vec3 {
        bounds.map(|(low, high)| self.log_uniform(low, high)).into()
    }

    /// Returns `true` with the given probability.
    pub fn chance(&self, probability: f64) -> bool {
        self.0.borrow_mut().random_bool(probability)
    }

    /// Returns one of the choices, all equally likely.
    pub fn one_of<T: Copy>(&self, choices: &[T]) -> T {
        choices[self.within(0..choices.len())]
    }

    /// Returns one of the choices with the given weights, which needn't add up to 1.
    pub fn weighted<T: Copy>(&self, choices: &[(T, f32)]) -> T {
        let chosen = choices.choose_weighted(&mut self.0.borrow_mut(), |(_, weight)| *weight);
        chosen.expect("a weight above 0").0
    }

    pub fn angle(&self) -> f32 {
        self.within(0. ..TAU)
    }

    /// Returns a unit vector in a uniformly random direction.
    pub fn direction(&self) -> Vec3 {
        let (y, angle) = (self.within(-1f32..1.), self.angle());
        let ring = (1. - y * y).sqrt();
        Vec3::new(ring * angle.cos(), y, ring * angle.sin())
    }

    /// Returns a unit vector in a uniformly random direction of the plane.
    pub fn direction_in_plane(&self) -> Vec2 {
        Vec2::from_angle(self.angle())
    }

    /// Returns a uniformly random position in the unit square.
    pub fn point(&self) -> Vec2 {
        Vec2::new(self.within(0. ..1.), self.within(0. ..1.))
    }

    /// Returns a seed for noise and hashes.
    pub fn seed(&self) -> u32 {
        self.0.borrow_mut().random()
    }
}
