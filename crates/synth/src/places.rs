//! Rooms and landscapes, and their light.

use super::light::{LightSource, Material, Sky};
use super::mesh::{Mesh, cuboid, height_field, superellipsoid};
use super::objects;
use super::scene_builder::{SceneBuilder, at, standing};
use super::texture::Purpose;
use super::walk::CameraSpace;
use glam::{Affine3A, Mat3, Quat, Vec3, vec2, vec3};

/// Maximum side of a wall's triangles in metres. Indirect light is computed at their corners.
const CELL: f32 = 0.35;

/// Builds a closed room with objects along the walls, in the middle and in some rooms in mid-air. Returns the space where cameras may
/// be.
pub(super) fn room(builder: &SceneBuilder, sky: &mut Sky) -> CameraSpace {
    let size = vec3(builder.log_uniform(2.6, 10.), builder.within(2.3..4.), builder.log_uniform(2.6, 10.));
    // Before luminous pictures: only the first four lights of a scene light it directly.
    add_lamps(builder, size, sky);
    let (x, y, z) = (Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z);
    // Each surface begins at a corner; its inside is in the direction of the cross product of its sides.
    let walls = [(z, -z, y), (Vec3::ZERO, x, y), (x, z, y), (x + z, -x, y)];
    let material = builder.material(Purpose::Wall);
    let add = |(corner, along, up), material: &Material| {
        builder.add_mesh(Mesh::rectangle(corner, along, up, CELL), material, Affine3A::IDENTITY);
    };
    add((z, x, -z), &builder.material(Purpose::Floor));
    add((y, x, z), &builder.material(Purpose::Ceiling));
    for wall in walls {
        let own = builder.material(builder.one_of(&[Purpose::Wall, Purpose::Wall, Purpose::Facade]));
        add(wall, if builder.chance(0.2) { &own } else { &material });
    }
    for (corner, along, _) in walls {
        let (length, towards) = (along.length(), along.normalize());
        let rotation = Mat3::from_cols(towards, Vec3::Y, towards.cross(Vec3::Y));
        let transform = Affine3A::from_mat3_translation(rotation, corner);
        let mut distance = builder.within(0.3..1.2);
        while distance < length - 0.6 {
            if builder.chance(0.6) {
                objects::furniture(builder, transform * at(distance, 0., 0.5));
            }
            if builder.chance(0.5) {
                let center = at(distance, builder.within(1.2..1.9), 0.);
                objects::picture(builder, transform * center, builder.chance(0.2));
            }
            distance += builder.within(0.8..2.4);
        }
    }
    let inside = |share: (f32, f32)| size * builder.vector([share, (0., 1.), share]);
    if builder.chance(0.5) {
        let carpet = inside((0.3, 0.8));
        let (along, up) = (Vec3::X * carpet.x, Vec3::NEG_Z * carpet.z);
        let mesh = Mesh::rectangle(-0.5 * (along + up), along, up, CELL);
        builder.add_mesh(
            mesh,
            &builder.picture(vec2(carpet.x, carpet.z)),
            at(0.5 * size.x, 0.012, 0.5 * size.z),
        );
    }
    for _ in 0..builder.within(0..=(0.12 * size.x * size.z) as usize + 1) {
        objects::furniture(builder, standing(inside((0.25, 0.75)).with_y(0.), builder.angle()));
    }
    if builder.chance(0.3) {
        for _ in 0..builder.within(8..40) {
            let mesh = objects::plain(builder, builder.log_vector([(0.15, 2.); 3]));
            let turn = Quat::from_axis_angle(builder.direction(), builder.angle());
            let place = Affine3A::from_rotation_translation(turn, inside((0., 1.)));
            builder.add_mesh(mesh, &builder.object_material(), place);
        }
    }
    objects::clutter(builder, 0.9 * vec2(size.x, size.z), 0.4, at(0.5 * size.x, 0., 0.5 * size.z), 8);
    let to_wall = 0.25;
    let (min, max) = (vec3(to_wall, 0.5, to_wall), size - to_wall);
    CameraSpace { min, max, eye_heights: (1., 1.75), clearance: 0.3, walls: Some(to_wall) }
}

/// Adds lamps of one color tone, on the ceiling or hanging, and sets the ambient light.
fn add_lamps(builder: &SceneBuilder, size: Vec3, sky: &mut Sky) {
    let warmth = builder.within(0. ..1.);
    let tone = vec3(1., 1. - 0.25 * warmth, 1. - 0.55 * warmth);
    let glass = Material { emission: 3., ..builder.material(Purpose::Ceiling) };
    let count = builder.within(1..4);
    let strength = builder.within(3. ..9.) * (size.x * size.z / 16.).max(0.5) / count as f32;
    for i in 0..count {
        let x = size.x * (i as f32 + builder.within(0.3..0.7)) / count as f32;
        let center = vec3(x, size.y - 0.07, size.z * builder.within(0.25..0.75));
        if builder.chance(0.5) {
            let (right, up) = (builder.within(0.1..0.6) * Vec3::X, builder.within(0.1..0.4) * Vec3::Z);
            builder.add_light(strength * tone, LightSource::Panel { center, right, up, facing: Vec3::NEG_Y });
            let box_size = vec3(2. * right.x, 0.03, 2. * up.z);
            builder.add_mesh(
                cuboid(box_size, 0.),
                &glass,
                Affine3A::from_translation(center + 0.02 * Vec3::Y),
            );
        } else {
            let (radius, center) = (builder.within(0.05..0.2), center - builder.within(0.2..0.8) * Vec3::Y);
            let ball = superellipsoid(Vec3::splat(2. * radius), [1., 1.], 8);
            builder.add_mesh(ball, &glass, Affine3A::from_translation(center));
            builder.add_light(0.8 * strength * tone, LightSource::Ball { center, radius });
        }
    }
    // Approximates the light of lamps after more than one bounce.
    let rest = builder.within(0.1..0.5) * tone;
    (sky.zenith, sky.horizon, sky.ground) = (rest, rest, rest);
}

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

/// Builds a landscape with trees, rocks, blocks and other objects. Returns the space where cameras may be.
pub(super) fn landscape(builder: &SceneBuilder, sky: &Sky) -> CameraSpace {
    let noise = builder.noise();
    let (hills, wide) = (builder.within(0. ..1f32).powi(3) * 2.5, builder.within(6. ..24.));
    let height = move |x: f32, z: f32| {
        let far = (x * x + z * z).sqrt() / 40.;
        hills * noise.fractal(vec3(x / 9., 0., z / 9.), 3) * (0.2 + far)
            + 4. * far * far * noise.sample(vec3(x / 30., 5., z / 30.))
    };
    let ground = height_field(vec2(160., 160.), 100, height);
    builder.add_mesh(ground, &builder.material(Purpose::Ground), Affine3A::IDENTITY);
    if builder.chance(0.5) {
        // A path or a street.
        let half = builder.within(0.5..3.);
        let (bend, phase) = (builder.within(0. ..3.), builder.angle());
        let way = Mesh::grid(4, 80, vec2(2. * half, 120.), |u, v| {
            let z = 60. - 120. * v;
            let x = bend * (0.08 * z + phase).sin() + (2. * u - 1.) * half;
            vec3(x, height(x, z) + 0.03, z)
        });
        builder.add_mesh(way, &builder.material(Purpose::Ground), Affine3A::IDENTITY);
    }
    // Returns a random place on the ground, between two distances from the middle.
    let place_on_ground = |least: f32, most: f32| {
        let (far, turn) = (builder.log_uniform(least, most), builder.angle());
        let (x, z) = (far * turn.cos(), far * turn.sin());
        standing(vec3(x, height(x, z) - 0.02, z), builder.angle())
    };
    for _ in 0..builder.within(0..14) {
        let size = builder.vector([(3., 10.), (1., 7.), (0.3, 9.)]);
        builder.add_mesh(cuboid(size, 0.), &builder.material(Purpose::Facade), place_on_ground(8., 60.));
    }
    for _ in 0..builder.within(0..22) {
        objects::tree(builder, place_on_ground(3., 50.), builder.within(2. ..9.));
    }
    for _ in 0..builder.within(0..24) {
        let purpose = builder.one_of(&[Purpose::Foliage, Purpose::Ground]);
        objects::lump(builder, place_on_ground(1.5, 25.), builder.log_uniform(0.3, 3.), purpose);
    }
    for _ in 0..builder.within(2..12) {
        let transform = place_on_ground(1., 0.6 * wide);
        match builder.chance(0.4) {
            true => objects::furniture(builder, transform),
            false => objects::heap(builder, builder.log_vector([(0.3, 4.); 3]), transform, 1..8),
        }
    }
    add_sun(builder, sky);
    let half = 0.5 * wide;
    let (min, max) = (vec3(-half, 0.3, -half), vec3(half, 9., half));
    CameraSpace { min, max, eye_heights: (1.2, 2.2), clearance: 0.4, walls: None }
}

/// Adds the sun, unless clouds cover it.
pub(super) fn add_sun(builder: &SceneBuilder, sky: &Sky) {
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
