//! Builder of synthetic scenes: their contents so far, and the random number generator.

use super::light::{Light, LightSource, Material};
use super::mesh::Mesh;
use super::noise::Noise;
use super::random::Random;
use super::texture::{Purpose, Texture};
use super::tracer::SceneContents;
use glam::{Affine2, Affine3A, Quat, Vec2, Vec3};
use rand_chacha::ChaCha8Rng;
use std::cell::RefCell;
use std::ops::Deref;
use std::sync::Arc;

/// Number of textures per purpose in a scene. Objects share them, as they do in a home.
const SHARED: usize = 6;

/// Builder that adds objects to a scene. It draws random values like [`Random`], and can be shared, so that these may be arguments of what is added.
pub(super) struct SceneBuilder {
    random: Random,
    pub contents: RefCell<SceneContents>,
    textures: RefCell<Vec<(Purpose, Arc<Texture>)>>,
}

impl Deref for SceneBuilder {
    type Target = Random;

    fn deref(&self) -> &Random {
        &self.random
    }
}

impl SceneBuilder {
    pub fn new(random: ChaCha8Rng) -> Self {
        let random = Random::new(random);
        SceneBuilder { random, contents: RefCell::default(), textures: RefCell::default() }
    }

    pub fn noise(&self) -> Noise {
        Noise::new(self.seed())
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
        let texture = Arc::new(Texture::draw(&self.random, purpose));
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
        let offset = self.point();
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
    pub fn object_material(&self) -> Material {
        self.material(Purpose::Thing)
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
