//! Outdoor scenes: ground, and objects on it under the sky.

use super::light::{LightSource, Sky};
use super::mesh::{Mesh, height_field};
use super::objects;
use super::scene_builder::{SceneBuilder, standing};
use super::texture::Purpose;
use super::walk::CameraSpace;
use glam::{Affine3A, Vec3, vec2, vec3};

/// Returns a random sky: clear, hazy or overcast, at noon or in the evening.
pub(super) fn sky(builder: &SceneBuilder) -> Sky {
    let evening = builder.within(0. ..1f32).powi(2);
    let overcast = builder.within(0. ..1.);
    let blue = vec3(0.25, 0.45, 0.95).lerp(vec3(0.25, 0.3, 0.6), evening);
    let gray = Vec3::splat(builder.within(0.5..1.));
    let horizon = vec3(0.8, 0.9, 1.).lerp(vec3(1., 0.6, 0.35), evening * (1. - overcast));
    let brightness = builder.within(0.6..1.2);
    Sky {
        zenith: brightness * blue.lerp(gray, overcast),
        horizon: brightness * horizon.lerp(gray, overcast),
        ground: brightness * vec3(0.25, 0.22, 0.18),
        clouds: builder.within(-0.3f32..0.9).max(0.),
        noise: builder.noise(),
    }
}

/// Builds a landscape or a street. Returns the space where cameras may be.
pub(super) fn landscape(builder: &SceneBuilder, sky: &Sky) -> CameraSpace {
    let noise = builder.noise();
    let (hills, wide) = (builder.within(0. ..1f32).powi(3) * 2.5, builder.within(6. ..24.));
    let height = move |x: f32, z: f32| {
        let far = (x * x + z * z).sqrt() / 40.;
        hills * noise.fractal(vec3(x / 9., 0., z / 9.), 3) * (0.2 + far)
            + 0.4 * far * far * noise.sample(vec3(x / 30., 5., z / 30.)) * 10.
    };
    let ground = builder.material(Purpose::Ground);
    builder.add_mesh(height_field(vec2(160., 160.), 100, height), &ground, Affine3A::IDENTITY);
    if builder.chance(0.5) {
        // A path or a street.
        let paving = builder.material(Purpose::Ground);
        let half = builder.within(0.5..3.);
        let (bend, phase) = (builder.within(0. ..3.), builder.angle());
        let way = Mesh::grid(4, 80, vec2(2. * half, 120.), |u, v| {
            let z = 60. - 120. * v;
            let x = bend * (0.08 * z + phase).sin() + (2. * u - 1.) * half;
            vec3(x, height(x, z) + 0.03, z)
        });
        builder.add_mesh(way, &paving, Affine3A::IDENTITY);
    }
    let spot = |least: f32, most: f32| {
        let (far, turn) = (builder.log_uniform(least, most), builder.angle());
        let (x, z) = (far * turn.cos(), far * turn.sin());
        standing(vec3(x, height(x, z) - 0.02, z), builder.angle())
    };
    for _ in 0..builder.within(0..10) {
        objects::house(builder, spot(8., 60.));
    }
    for _ in 0..builder.within(0..22) {
        objects::tree(builder, spot(3., 50.), builder.within(2. ..9.));
    }
    for _ in 0..builder.within(0..14) {
        objects::bush(builder, spot(1.5, 25.));
    }
    for _ in 0..builder.within(0..10) {
        objects::rock(builder, spot(1.5, 25.), builder.log_uniform(0.3, 3.));
    }
    for _ in 0..builder.within(0..3) {
        objects::fence(builder, spot(3., 20.), builder.within(3. ..15.));
    }
    for _ in 0..builder.within(2..12) {
        let transform = spot(1., 0.6 * wide);
        match builder.chance(0.4) {
            true => objects::furniture(builder, transform),
            false => objects::heap(builder, builder.log_vector([(0.3, 4.); 3]), transform, 1..8),
        }
    }
    sun(builder, sky);
    let half = 0.5 * wide;
    let (min, max) = (vec3(-half, 0.3, -half), vec3(half, 9., half));
    CameraSpace { min, max, eye_heights: (1.2, 2.2), clearance: 0.4, walls: None }
}

/// Builds the surroundings that are visible through the windows of a room of `size`.
pub(super) fn outside(builder: &SceneBuilder, size: Vec3) {
    let below = builder.within(0. ..1f32).powi(2) * 8. + 0.1;
    let middle = vec3(0.5 * size.x, -below, 0.5 * size.z);
    let ground = builder.material(Purpose::Ground);
    let yard = height_field(vec2(120., 120.), 12, |_, _| 0.).warped(|p| p + middle);
    builder.add_mesh(yard, &ground, Affine3A::IDENTITY);
    let reach = 0.5 * size.x.max(size.z);
    for _ in 0..builder.within(2..9) {
        let (far, turn) = (reach + builder.log_uniform(3., 30.), builder.angle());
        let at = middle + far * vec3(turn.cos(), 0., turn.sin());
        let transform = standing(at, builder.angle());
        match builder.within(0..4) {
            0 if far > reach + 9. => objects::house(builder, transform),
            1 | 2 => objects::tree(builder, transform, builder.within(2. ..8.) + below),
            _ => objects::bush(builder, transform),
        }
    }
}

fn sun(builder: &SceneBuilder, sky: &Sky) {
    let cover = sky.clouds.max(1. - 2. * (sky.zenith.z - sky.zenith.x).max(0.));
    if builder.chance(0.25) && cover > 0.6 {
        return;
    }
    let (turn, height) = (builder.angle(), builder.within(0.15..2.));
    let towards = vec3(turn.cos(), height, turn.sin()).normalize();
    let warm = vec3(1., 0.95, 0.88).lerp(vec3(1., 0.7, 0.45), (1. - towards.y).powi(3));
    let color = builder.within(1. ..4.5) * (1.1 - cover) * warm;
    let spread = if cover > 0.5 { 0.3 } else { 0.02 };
    builder.add_light(color, LightSource::Sun { towards, spread });
}
