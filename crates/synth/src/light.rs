//! Light sources, the sky, and the materials that reflect their light.

use super::noise::Noise;
use super::texture::Texture;
use glam::{Affine2, Vec2, Vec3};
use std::sync::Arc;

/// A light source. Light is linear RGB, where 1 is the light reflected by a well-lit white wall.
#[derive(Debug, Clone, Copy)]
pub(super) struct Light {
    /// Irradiance perpendicular to the light: everywhere for the sun, and at a distance of one metre from other sources.
    pub color: Vec3,
    pub source: LightSource,
}

/// Shape and place of a light source.
#[derive(Debug, Clone, Copy)]
pub(super) enum LightSource {
    /// The sun, infinitely far away in the direction `towards` (unit), with an angular width of `spread` radians.
    Sun { towards: Vec3, spread: f32 },
    /// A ball, which may be visible and never blocks its own light.
    Ball { center: Vec3, radius: f32 },
    /// A parallelogram with half sides `right` and `up` around `center`, facing `facing` (unit).
    Panel { center: Vec3, right: Vec3, up: Vec3, facing: Vec3 },
}

/// Light that arrives at a point.
pub(super) struct IncidentLight {
    /// Unit direction towards the light source.
    pub towards: Vec3,
    /// Distance to the point where the light left its source, in metres.
    pub distance: f32,
    /// Irradiance perpendicular to the ray, if nothing blocks it.
    pub color: Vec3,
}

impl Light {
    /// Returns the light that reaches `point` from the position on the light source given by `at` in [0, 1)².
    pub fn incident_at(&self, point: Vec3, at: Vec2) -> IncidentLight {
        let color = self.color;
        match self.source {
            LightSource::Sun { towards, spread } => {
                let (right, up) = towards.any_orthonormal_pair();
                let offset = spread * (at - 0.5);
                let towards = (towards + offset.x * right + offset.y * up).normalize();
                IncidentLight { towards, distance: f32::INFINITY, color }
            }
            LightSource::Ball { center, radius } => {
                let (right, up) = (center - point).normalize_or(Vec3::Y).any_orthonormal_pair();
                let offset = radius * (at - 0.5);
                let way = center + offset.x * right + offset.y * up - point;
                let distance = way.length().max(1e-3);
                // Limit the irradiance to that at about a quarter of a metre, to avoid overexposure.
                let color = color / (distance * distance).max(0.06);
                IncidentLight { towards: way / distance, distance: (distance - 1.1 * radius).max(0.), color }
            }
            LightSource::Panel { center, right, up, facing } => {
                let offset = 2. * at - 1.;
                let way = center + offset.x * right + offset.y * up - point;
                let distance = way.length().max(1e-3);
                let towards = way / distance;
                let color = color * (-towards.dot(facing)).max(0.) / (distance * distance).max(0.25);
                IncidentLight { towards, distance, color }
            }
        }
    }
}

/// Background of a scene: a gradient from the horizon to the zenith, ground below, and clouds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sky {
    pub zenith: Vec3,
    pub horizon: Vec3,
    pub ground: Vec3,
    /// Fraction of the sky covered by clouds, 0 to 1.
    pub clouds: f32,
    pub noise: Noise,
}

impl Sky {
    /// Returns the radiance from the unit direction `towards`.
    pub fn radiance(&self, towards: Vec3) -> Vec3 {
        let up = towards.y;
        if up < 0. {
            return self.horizon.lerp(self.ground, (-8. * up).min(1.));
        }
        let clear = self.horizon.lerp(self.zenith, up.sqrt());
        if self.clouds <= 0. {
            return clear;
        }
        // The clouds lie on a flat layer, and therefore look finer towards the horizon.
        let layer = Vec3::new(towards.x, 0., towards.z) / (up + 0.15);
        let density = 0.5 + 0.5 * self.noise.fractal(2. * layer, 4);
        let cover = ((density - 1. + self.clouds) * 4.).clamp(0., 1.) * (up * 6.).min(1.);
        clear.lerp(Vec3::splat(self.horizon.max_element()), 0.85 * cover)
    }

    /// Returns the mean radiance over the hemisphere around `normal`, without the shapes of the clouds.
    pub fn mean_radiance(&self, normal: Vec3) -> Vec3 {
        let above = self.zenith.lerp(self.horizon, 0.5 + 0.3 * self.clouds);
        self.ground.lerp(above, 0.5 + 0.5 * normal.y)
    }
}

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
    /// Strength of highlights.
    pub specular: f32,
    /// Exponent of highlights. Larger values give smaller highlights.
    pub shininess: f32,
}

impl Material {
    /// Creates a matte material with `texture` at its natural size.
    pub fn matte(texture: Arc<Texture>) -> Material {
        let repeats = Affine2::from_scale(Vec2::splat(1. / texture.repeat_metres));
        Material { texture, repeats, tint: Vec3::ONE, emission: 0., specular: 0., shininess: 1. }
    }

    /// Returns the diffuse reflectance at `uv` metres along the surface, blurred over `footprint` metres.
    pub fn reflectance(&self, uv: Vec2, footprint: f32) -> Vec3 {
        let scale = self.repeats.matrix2.determinant().abs().sqrt();
        // The v axis points up on surfaces and down in images.
        let place = self.repeats.transform_point2(uv) * Vec2::new(1., -1.);
        self.tint * self.texture.sample(place, footprint * scale)
    }
}
