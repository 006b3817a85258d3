//! Outdoor scenes: ground, and objects on it under the sky.

use super::light::{Lamp, Sky};
use super::maker::{Maker, standing};
use super::mesh::Mesh;
use super::shapes::height_field;
use super::texture::Purpose;
use super::things;
use super::walk::Place;
use glam::{Affine3A, Vec3, vec2, vec3};

/// Returns a random sky: clear, hazy or overcast, at noon or in the evening.
pub(super) fn sky(make: &mut Maker) -> Sky {
    let evening = make.within(0. ..1f32).powi(2);
    let overcast = make.within(0. ..1.);
    let blue = vec3(0.25, 0.45, 0.95).lerp(vec3(0.25, 0.3, 0.6), evening);
    let grey = Vec3::splat(make.within(0.5..1.));
    let horizon = vec3(0.8, 0.9, 1.).lerp(vec3(1., 0.6, 0.35), evening * (1. - overcast));
    let brightness = make.within(0.6..1.2);
    Sky {
        zenith: brightness * blue.lerp(grey, overcast),
        horizon: brightness * horizon.lerp(grey, overcast),
        ground: brightness * vec3(0.25, 0.22, 0.18),
        clouds: make.within(-0.3f32..0.9).max(0.),
        noise: make.noise(),
    }
}

/// Builds a landscape or a street. Returns the space where cameras may be.
pub(super) fn landscape(make: &mut Maker, sky: &Sky) -> Place {
    let noise = make.noise();
    let (hills, wide) = (make.within(0. ..1f32).powi(3) * 2.5, make.within(6. ..24.));
    let height = move |x: f32, z: f32| {
        let far = (x * x + z * z).sqrt() / 40.;
        hills * noise.fractal(vec3(x / 9., 0., z / 9.), 3) * (0.2 + far)
            + 0.4 * far * far * noise.at(vec3(x / 30., 5., z / 30.)) * 10.
    };
    let ground = make.material(Purpose::Ground);
    make.put(height_field(vec2(160., 160.), 100, height), &ground, Affine3A::IDENTITY);
    if make.chance(0.5) {
        // A path or a street.
        let paving = make.material(Purpose::Ground);
        let half = make.within(0.5..3.);
        let (bend, phase) = (make.within(0. ..3.), make.turn());
        let way = Mesh::grid(4, 80, vec2(2. * half, 120.), |u, v| {
            let z = 60. - 120. * v;
            let x = bend * (0.08 * z + phase).sin() + (2. * u - 1.) * half;
            vec3(x, height(x, z) + 0.03, z)
        });
        make.put(way, &paving, Affine3A::IDENTITY);
    }
    let spot = |make: &mut Maker, least: f32, most: f32| {
        let (far, turn) = (make.scaled(least, most), make.turn());
        let (x, z) = (far * turn.cos(), far * turn.sin());
        standing(vec3(x, height(x, z) - 0.02, z), make.turn())
    };
    for _ in 0..make.within(0..10) {
        let place = spot(make, 8., 60.);
        things::house(make, place);
    }
    for _ in 0..make.within(0..22) {
        let (place, tall) = (spot(make, 3., 50.), make.within(2. ..9.));
        things::tree(make, place, tall);
    }
    for _ in 0..make.within(0..14) {
        let place = spot(make, 1.5, 25.);
        things::bush(make, place);
    }
    for _ in 0..make.within(0..10) {
        let (place, size) = (spot(make, 1.5, 25.), make.scaled(0.3, 3.));
        things::rock(make, place, size);
    }
    for _ in 0..make.within(0..3) {
        let (place, length) = (spot(make, 3., 20.), make.within(3. ..15.));
        things::fence(make, place, length);
    }
    for _ in 0..make.within(2..12) {
        let place = spot(make, 1., 0.6 * wide);
        match make.chance(0.4) {
            true => things::furniture(make, place),
            false => {
                let size = vec3(make.scaled(0.3, 4.), make.scaled(0.3, 4.), make.scaled(0.3, 4.));
                let count = make.within(1..8);
                things::heap(make, size, place, count);
            }
        }
    }
    sun(make, sky);
    let half = 0.5 * wide;
    Place {
        least: vec3(-half, 0.3, -half),
        most: vec3(half, 9., half),
        eye: (1.2, 2.2),
        roomy: 0.4,
        walls: None,
    }
}

/// Builds the surroundings that are visible through the windows of a room of `size`.
pub(super) fn outside(make: &mut Maker, size: Vec3) {
    let below = make.within(0. ..1f32).powi(2) * 8. + 0.1;
    let middle = vec3(0.5 * size.x, -below, 0.5 * size.z);
    let ground = make.material(Purpose::Ground);
    let mut yard = height_field(vec2(120., 120.), 12, |_, _| 0.);
    yard.positions.iter_mut().for_each(|p| *p += middle);
    make.put(yard, &ground, Affine3A::IDENTITY);
    let reach = 0.5 * size.x.max(size.z);
    for _ in 0..make.within(2..9) {
        let (far, turn) = (reach + make.scaled(3., 30.), make.turn());
        let at = middle + far * vec3(turn.cos(), 0., turn.sin());
        let place = standing(at, make.turn());
        match make.within(0..4) {
            0 if far > reach + 9. => things::house(make, place),
            1 | 2 => {
                let tall = make.within(2. ..8.) + below;
                things::tree(make, place, tall);
            }
            _ => things::bush(make, place),
        }
    }
}

fn sun(make: &mut Maker, sky: &Sky) {
    let cover = sky.clouds.max(1. - 2. * (sky.zenith.z - sky.zenith.x).max(0.));
    if make.chance(0.25) && cover > 0.6 {
        return;
    }
    let (turn, height) = (make.turn(), make.within(0.15..2.));
    let towards = vec3(turn.cos(), height, turn.sin()).normalize();
    let warm = vec3(1., 0.95, 0.88).lerp(vec3(1., 0.7, 0.45), (1. - towards.y).powi(3));
    let colour = make.within(1. ..4.5) * (1.1 - cover) * warm;
    let spread = if cover > 0.5 { 0.3 } else { 0.02 };
    make.parts.lamps.push(Lamp::Sun { towards, spread, colour });
}
