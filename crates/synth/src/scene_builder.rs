//! Builder of synthetic scenes: their contents so far, and the random number generator.

use super::light::{Light, LightSource, Material};
use super::mesh::{Mesh, cuboid};
use super::noise::Noise;
use super::texture::{Purpose, Texture};
use super::tracer::SceneContents;
use glam::{Affine2, Affine3A, Quat, Vec2, Vec3};
use rand::Rng;
use rand::distr::uniform::{SampleRange, SampleUniform};
use rand_chacha::ChaCha8Rng;
use std::cell::RefCell;
use std::f32::consts::TAU;
use std::sync::Arc;

/// Number of textures per purpose in a scene. Objects share them, as they do in a home.
const SHARED: usize = 6;

/// Builder that adds objects to a scene. It can be shared, so that random draws may be arguments of what is added.
pub(super) struct SceneBuilder {
    random: RefCell<ChaCha8Rng>,
    pub contents: RefCell<SceneContents>,
    textures: RefCell<Vec<(Purpose, Arc<Texture>)>>,
}

impl SceneBuilder {
    pub fn new(random: ChaCha8Rng) -> Self {
        SceneBuilder { random: random.into(), contents: RefCell::default(), textures: RefCell::default() }
    }

    pub fn within<T: SampleUniform>(&self, range: impl SampleRange<T>) -> T {
        self.random.borrow_mut().random_range(range)
    }

    /// Returns a random value between `least` and `most` on a logarithmic scale: each doubling is equally likely.
    pub fn log_uniform(&self, least: f32, most: f32) -> f32 {
        least * (most / least).powf(self.within(0. ..1.))
    }

    /// Returns a vector whose components are uniformly random between the given bounds.
    pub fn vector(&self, bounds: [(f32, f32); 3]) -> Vec3 {
        bounds.map(|(low, high)| self.within(low..high)).into()
    }

    /// Returns a vector whose components are drawn by [`SceneBuilder::log_uniform`].
    pub fn log_vector(&self, bounds: [(f32, f32); 3]) -> Vec3 {
        bounds.map(|(least, most)| self.log_uniform(least, most)).into()
    }

    pub fn chance(&self, probability: f64) -> bool {
        self.random.borrow_mut().random_bool(probability)
    }

    pub fn one_of<T: Copy>(&self, choices: &[T]) -> T {
        choices[self.within(0..choices.len())]
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

    pub fn noise(&self) -> Noise {
        Noise::new(self.random.borrow_mut().random())
    }

    pub fn texture(&self, purpose: Purpose) -> Arc<Texture> {
        let turn = self.within(0..SHARED);
        let mut textures = self.textures.borrow_mut();
        let mut shared = textures.iter().filter(|(other, _)| *other == purpose);
        if let Some((_, texture)) = shared.nth(turn)
            && purpose != Purpose::Poster
        {
            return texture.clone();
        }
        let texture = Arc::new(Texture::draw(&mut self.random.borrow_mut(), purpose));
        textures.push((purpose, texture.clone()));
        texture
    }

    /// Returns a random material for `purpose` with its own texture size and orientation, matte or glossy.
    pub fn material(&self, purpose: Purpose) -> Material {
        let mut material = Material::matte(self.texture(purpose));
        let (scale, angle) = match purpose {
            Purpose::Thing => (self.log_uniform(0.6, 3.), self.angle()),
            _ => (self.log_uniform(0.7, 1.5), 0.),
        };
        let offset = Vec2::new(self.within(0. ..1.), self.within(0. ..1.));
        let larger = Affine2::from_scale(Vec2::splat(scale / material.texture.repeat_metres));
        material.repeats = Affine2::from_angle_translation(angle, offset) * larger;
        if purpose == Purpose::Thing && self.chance(0.5) {
            // Half of the things have the texture in another color.
            material.tint = Vec3::new(self.within(0.4..1.), self.within(0.4..1.), self.within(0.4..1.));
        }
        let glossy = match purpose {
            Purpose::Floor | Purpose::Thing => 0.3,
            _ => 0.05,
        };
        if self.chance(glossy) {
            material.specular = self.log_uniform(0.02, 0.3);
            material.shininess = self.log_uniform(8., 300.);
            if self.chance(0.3) {
                material.mirror_reflectance = self.log_uniform(0.02, 0.12);
            }
        }
        material
    }

    /// Returns a material that shows one whole image on a surface of `size` metres.
    pub fn picture(&self, size: Vec2) -> Material {
        let mut material = Material::matte(self.texture(Purpose::Poster));
        material.repeats = Affine2::from_scale(1. / size);
        material
    }

    /// Returns a random material for furniture and other objects.
    pub fn thing(&self) -> Material {
        self.material(Purpose::Thing)
    }

    /// Adds a [`cuboid`] of `size` with sharp edges.
    pub fn add_box(&self, size: Vec3, material: &Material, transform: Affine3A) {
        self.add_rounded_box(size, 0., material, transform);
    }

    /// Adds a [`cuboid`] of `size` with edges rounded by `round` metres.
    pub fn add_rounded_box(&self, size: Vec3, round: f32, material: &Material, transform: Affine3A) {
        self.add_mesh(cuboid(size, round), material, transform);
    }

    pub fn add_mesh(&self, mesh: Mesh, material: &Material, transform: Affine3A) {
        self.contents.borrow_mut().meshes.push((mesh.moved(transform), material.clone()));
    }

    pub fn add_light(&self, color: Vec3, source: LightSource) {
        self.contents.borrow_mut().lights.push(Light { color, source });
    }
}

/// Returns the translation by (`x`, `y`, `z`).
pub(super) fn at(x: f32, y: f32, z: f32) -> Affine3A {
    Affine3A::from_translation(Vec3::new(x, y, z))
}

/// Returns the transform of an upright object at `spot`, rotated by `turn` about y.
pub(super) fn standing(spot: Vec3, turn: f32) -> Affine3A {
    Affine3A::from_rotation_translation(Quat::from_rotation_y(turn), spot)
}
