//! What surfaces look like.

use super::texture::Texture;
use glam::{Affine2, Vec2, Vec3};
use std::sync::Arc;

/// How a surface sends light back.
#[derive(Debug, Clone)]
pub(super) struct Material {
    pub texture: Arc<Texture>,
    /// Metres along a surface to repeats of the texture.
    pub repeats: Affine2,
    /// Factor on the texture.
    pub tint: Vec3,
    /// Light of its own, a factor on the texture.
    pub glow: f32,
    /// Share of light that is mirrored where one looks straight at it; the rest is scattered.
    pub mirror: f32,
    /// Strength of highlights.
    pub gloss: f32,
    /// Exponent of highlights: their smallness.
    pub polish: f32,
}

impl Material {
    /// Matte, with `texture` as large as it is in nature.
    pub fn matte(texture: Arc<Texture>) -> Material {
        let repeats = Affine2::from_scale(Vec2::splat(1. / texture.repeat_metres));
        Material { texture, repeats, tint: Vec3::ONE, glow: 0., mirror: 0., gloss: 0., polish: 1. }
    }

    /// The reflectance at `uv` metres along the surface, blurred over `footprint` metres.
    pub fn reflectance(&self, uv: Vec2, footprint: f32) -> Vec3 {
        let scale = self.repeats.matrix2.determinant().abs().sqrt();
        // On surfaces up is up, in pictures down is.
        let place = self.repeats.transform_point2(uv) * Vec2::new(1., -1.);
        self.tint * self.texture.sample(place, footprint * scale)
    }
}
