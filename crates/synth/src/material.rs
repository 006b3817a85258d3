//! Surface materials.

use super::texture::Texture;
use glam::{Affine2, Vec2, Vec3};
use std::sync::Arc;

/// Reflective properties of a surface.
#[derive(Debug, Clone)]
pub(super) struct Material {
    pub texture: Arc<Texture>,
    /// Transform from metres along a surface to repeats of the texture.
    pub repeats: Affine2,
    /// Color factor on the texture.
    pub tint: Vec3,
    /// Emitted light, as a factor on the texture.
    pub emission: f32,
    /// Share of light that is mirrored at perpendicular incidence. The rest is scattered.
    pub mirror_reflectance: f32,
    /// Strength of highlights.
    pub specular: f32,
    /// Exponent of highlights. Larger values give smaller highlights.
    pub shininess: f32,
}

impl Material {
    /// Creates a matte material with `texture` at its natural size.
    pub fn matte(texture: Arc<Texture>) -> Material {
        let repeats = Affine2::from_scale(Vec2::splat(1. / texture.repeat_metres));
        Material {
            texture,
            repeats,
            tint: Vec3::ONE,
            emission: 0.,
            mirror_reflectance: 0.,
            specular: 0.,
            shininess: 1.,
        }
    }

    /// Returns the diffuse reflectance at `uv` metres along the surface, blurred over `footprint` metres.
    pub fn reflectance(&self, uv: Vec2, footprint: f32) -> Vec3 {
        let scale = self.repeats.matrix2.determinant().abs().sqrt();
        // The v axis points up on surfaces and down in images.
        let place = self.repeats.transform_point2(uv) * Vec2::new(1., -1.);
        self.tint * self.texture.sample(place, footprint * scale)
    }
}
