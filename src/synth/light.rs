//! What shines, and what is behind everything.

use super::noise::Noise;
use glam::{Vec2, Vec3};

/// A lamp, or the sun. Light is linear RGB; 1 is what a white wall sends back where it is well lit.
#[derive(Debug, Clone, Copy)]
pub(super) enum Lamp {
    /// Infinitely far, `towards` it (unit), as wide as `spread` radians; `colour` is irradiance across it.
    Sun { towards: Vec3, spread: f32, colour: Vec3 },
    /// A ball at `at`, which may be seen and never blocks its own light; `colour` is irradiance at a metre.
    Ball { at: Vec3, radius: f32, colour: Vec3 },
    /// A parallelogram of half sides `right` and `up` about `at`, shining along `facing` (unit); `colour` is what a metre from
    /// its middle gets.
    Panel { at: Vec3, right: Vec3, up: Vec3, facing: Vec3, colour: Vec3 },
}

/// Light on its way to a point.
pub(super) struct Arriving {
    /// Unit, towards the lamp.
    pub towards: Vec3,
    /// To where it left the lamp, in metres.
    pub distance: f32,
    /// Irradiance across the ray, if nothing is in between.
    pub colour: Vec3,
}

impl Lamp {
    /// With `factor` times the light.
    pub fn dimmed(self, factor: f32) -> Lamp {
        match self {
            Lamp::Sun { towards, spread, colour } => Lamp::Sun { towards, spread, colour: factor * colour },
            Lamp::Ball { at, radius, colour } => Lamp::Ball { at, radius, colour: factor * colour },
            Lamp::Panel { at, right, up, facing, colour } => {
                Lamp::Panel { at, right, up, facing, colour: factor * colour }
            }
        }
    }

    /// What reaches `point` from the place on the lamp that `at` in [0, 1)² says.
    pub fn arriving(&self, point: Vec3, at: Vec2) -> Arriving {
        match *self {
            Lamp::Sun { towards, spread, colour } => {
                let (right, up) = towards.any_orthonormal_pair();
                let offset = spread * (at - 0.5);
                let towards = (towards + offset.x * right + offset.y * up).normalize();
                Arriving { towards, distance: f32::INFINITY, colour }
            }
            Lamp::Ball { at: centre, radius, colour } => {
                let (right, up) = (centre - point).normalize_or(Vec3::Y).any_orthonormal_pair();
                let offset = radius * (at - 0.5);
                let way = centre + offset.x * right + offset.y * up - point;
                let distance = way.length().max(1e-3);
                // Nothing gets closer than a quarter metre's worth: pictures would burn out there.
                let colour = colour / (distance * distance).max(0.06);
                Arriving { towards: way / distance, distance: (distance - 1.1 * radius).max(0.), colour }
            }
            Lamp::Panel { at: centre, right, up, facing, colour } => {
                let offset = 2. * at - 1.;
                let way = centre + offset.x * right + offset.y * up - point;
                let distance = way.length().max(1e-3);
                let towards = way / distance;
                let colour = colour * (-towards.dot(facing)).max(0.) / (distance * distance).max(0.25);
                Arriving { towards, distance, colour }
            }
        }
    }
}

/// What is seen where nothing is: a gradient from the horizon to the zenith, ground below, clouds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sky {
    pub zenith: Vec3,
    pub horizon: Vec3,
    pub ground: Vec3,
    /// How much of the sky clouds cover, 0 to 1.
    pub clouds: f32,
    pub noise: Noise,
}

impl Sky {
    /// Radiance from the unit direction `towards`.
    pub fn seen(&self, towards: Vec3) -> Vec3 {
        let up = towards.y;
        if up < 0. {
            return self.horizon.lerp(self.ground, (-8. * up).min(1.));
        }
        let clear = self.horizon.lerp(self.zenith, up.sqrt());
        if self.clouds <= 0. {
            return clear;
        }
        // On a flat layer, and finer towards the horizon for that.
        let layer = Vec3::new(towards.x, 0., towards.z) / (up + 0.15);
        let density = 0.5 + 0.5 * self.noise.fractal(2. * layer, 4);
        let cover = ((density - 1. + self.clouds) * 4.).clamp(0., 1.) * (up * 6.).min(1.);
        clear.lerp(Vec3::splat(self.horizon.max_element()), 0.85 * cover)
    }

    /// Mean radiance over the half space about `normal`, without the clouds' shapes.
    pub fn around(&self, normal: Vec3) -> Vec3 {
        let above = self.zenith.lerp(self.horizon, 0.5 + 0.3 * self.clouds);
        self.ground.lerp(above, 0.5 + 0.5 * normal.y)
    }
}
