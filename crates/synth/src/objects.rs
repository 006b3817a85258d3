//! Objects made of plain shapes. Each stands on y = 0 around the origin and faces +z.

use super::light::LightSource;
use super::mesh::{Mesh, cone, cuboid, lathe, roughen, superellipsoid, taper, tube, twist};
use super::scene_builder::{SceneBuilder, at, standing};
use super::texture::Purpose;
use super::walk::OrbitTarget;
use glam::{Affine3A, Quat, Vec2, Vec3, vec2, vec3};
use std::f32::consts::{PI, TAU};
use std::ops::Range;

/// Creates a random plain shape within `size`, possibly stretched, bent and roughened, standing on y = 0.
pub(super) fn plain(builder: &SceneBuilder, size: Vec3) -> Mesh {
    let half = size / 2.;
    let mut mesh = match builder.within(0..9) {
        0 => cuboid(size, 0.),
        1 => cuboid(size, builder.within(0.05..0.5) * size.min_element()),
        2 => superellipsoid(size, [1., 1.], 10),
        3 => superellipsoid(size, [builder.within(0.2..1.6), builder.within(0.2..1.6)], 10),
        4 => cone(0.5, 0.5, 1., 20).warped(|p| p * size),
        5 => cone(0.5, builder.within(0. ..0.4), 1., 20).warped(|p| p * size),
        6 => {
            let thick = builder.within(0.12..0.35f32);
            let ring = move |t: f32| vec3((1. - thick) * (TAU * t).cos(), 0., (1. - thick) * (TAU * t).sin());
            let flat = tube(ring, |_| thick, [24, 10]);
            let upright = builder.chance(0.5);
            let stood = if upright { flat.warped(|p| vec3(p.x, p.z, p.y)) } else { flat };
            stood.warped(|p| p * half)
        }
        7 => {
            let (waves, thick) = (builder.within(1..5) as f32, builder.within(0.06..0.2));
            let knot = move |t: f32| {
                let (a, b) = (TAU * t, TAU * t * waves);
                vec3(0.8 * a.cos(), 0.8 * (b + 0.5).sin() * 0.5, 0.8 * a.sin() * (1. + 0.2 * b.cos()))
            };
            tube(knot, move |_| thick, [48, 8]).warped(|p| p * half)
        }
        _ => {
            let steps = builder.within(3..8);
            let mut profile = vec![Vec2::ZERO];
            profile.extend((0..=steps).map(|i| vec2(builder.within(0.12..0.5), i as f32 / steps as f32)));
            lathe(&profile, 20).warped(|p| p * size)
        }
    };
    if builder.chance(0.2) {
        mesh = taper(mesh, builder.within(-0.6..0.6) / size.y);
    }
    if builder.chance(0.15) {
        mesh = twist(mesh, builder.within(-0.4..0.4) / size.y);
    }
    if builder.chance(0.15) {
        let (noise, strength) = (builder.noise(), builder.within(0.03..0.15));
        mesh = roughen(mesh, &noise, 2.5 / size.max_element(), strength * size.min_element());
    }
    let (least, _) = mesh.bounds();
    mesh.moved(at(0., -least.y, 0.))
}

/// Adds a heap of plain shapes on and beside each other, of about `size` in metres. Their number is random in `counts`.
pub(super) fn heap(builder: &SceneBuilder, size: Vec3, transform: Affine3A, counts: Range<usize>) {
    for _ in 0..builder.within(counts) {
        let mesh = plain(builder, size * builder.vector([(0.2, 0.6); 3]));
        let spot = size * builder.vector([(-0.4, 0.4), (0., 0.3), (-0.4, 0.4)]);
        let turn = match builder.chance(0.5) {
            true => Quat::from_rotation_y(builder.angle()),
            false => Quat::from_axis_angle(builder.direction(), builder.angle()),
        };
        let place = transform * Affine3A::from_rotation_translation(turn, spot);
        builder.add_mesh(mesh, &builder.object_material(), place);
    }
}

/// Adds up to `most` small plain shapes side by side on a surface of `size`, each at most `height` metres high.
pub(super) fn clutter(builder: &SceneBuilder, size: Vec2, height: f32, transform: Affine3A, most: usize) {
    for _ in 0..builder.within(0..=most) {
        let spot = vec3(builder.within(-0.5..0.5) * size.x, 0., builder.within(-0.5..0.5) * size.y);
        let extent = builder.log_vector([(0.1, 1.); 3]) * height;
        let place = transform * standing(spot, builder.angle());
        builder.add_mesh(plain(builder, extent), &builder.object_material(), place);
    }
}

/// Adds boards on top of each other between sides or legs, with small objects on them: a table or a shelf.
fn boards(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.vector([(0.4, 2.), (0.3, 2.), (0.3, 0.9)]);
    let (board, side) = (builder.object_material(), builder.object_material());
    let levels = builder.within(1..=(3. * size.y) as usize + 1);
    let gap = size.y / levels as f32;
    let (thick, round) = (builder.within(0.02..0.07), builder.one_of(&[0., 0.01]));
    for level in 1..=levels {
        let place = transform * at(0., gap * level as f32 - thick, 0.);
        builder.add_mesh(cuboid(vec3(size.x, thick, size.z), round), &board, place);
        clutter(builder, 0.8 * vec2(size.x, size.z), 0.7 * gap.min(0.5), place * at(0., thick, 0.), 4);
    }
    // A side as deep as the boards, or a leg at each corner.
    let deep = if builder.chance(0.5) { size.z } else { thick };
    for (x, z) in [(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)] {
        let place = at(x * (size.x - thick), 0., z * (size.z - deep));
        builder.add_mesh(cuboid(vec3(thick, size.y - thick, deep), 0.), &side, transform * place);
    }
}

/// Adds an object for placement along a wall or in the open.
pub(super) fn furniture(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.log_vector([(0.3, 2.), (0.3, 2.), (0.3, 1.)]);
    match builder.within(0..10) {
        0..4 => boards(builder, transform),
        4..6 => builder.add_mesh(plain(builder, size), &builder.object_material(), transform),
        6 => leaves(builder, transform, builder.within(0.4..1.5), builder.within(12..60)),
        _ => heap(builder, size, transform, 2..9),
    }
}

/// Adds leaves on arching stems, up to `reach` metres long.
pub(super) fn leaves(builder: &SceneBuilder, transform: Affine3A, reach: f32, count: usize) {
    let mut all = Mesh::default();
    let (slim, droop) = (builder.within(0.06..0.35), builder.within(-0.3..1.2));
    for _ in 0..count {
        let length = reach * builder.within(0.5..1.);
        let leaf = Mesh::grid(2, 5, vec2(slim * length, length), |u, v| {
            let wide = slim * length * (PI * v.powf(0.7)).sin();
            let rise = v - 0.5 * droop * v * v;
            vec3((u - 0.5) * wide, rise * length, 0.6 * length * v * v + 0.1 * wide * (2. * u - 1.).abs())
        });
        let tilt = Affine3A::from_rotation_x(builder.within(0. ..1.));
        all.join(leaf.moved(Affine3A::from_rotation_y(builder.angle()) * tilt));
    }
    builder.add_mesh(all, &builder.material(Purpose::Foliage), transform);
}

/// Adds a tree of `height` metres: a bent trunk, and a crown of leaves or of rough balls.
pub(super) fn tree(builder: &SceneBuilder, transform: Affine3A, height: f32) {
    let bend = builder.vector([(-0.15, 0.15), (1., 1.001), (-0.15, 0.15)]) * height;
    let stem = move |t: f32| bend * vec3(t * t, t, t * t);
    let thick = builder.within(0.02..0.045) * height;
    builder.add_mesh(tube(stem, move |t| thick * (1.1 - t), [8, 8]), &builder.object_material(), transform);
    let (crown, noise, has_leaves) =
        (builder.material(Purpose::Foliage), builder.noise(), builder.chance(0.4));
    for _ in 0..builder.within(5..12) {
        let middle = stem(builder.within(0.5..1.)) + builder.direction() * builder.within(0. ..0.2) * height;
        let place = transform * Affine3A::from_translation(middle);
        if has_leaves {
            leaves(builder, place, 0.25 * height, 12);
        } else {
            let size = builder.vector([(0.2, 0.4), (0.15, 0.35), (0.2, 0.4)]) * height;
            let ball = roughen(superellipsoid(size, [1., 1.], 9), &noise, 7. / height, 0.06 * height);
            builder.add_mesh(ball, &crown, place);
        }
    }
}

/// Adds a rock, or with [`Purpose::Foliage`] a bush, of about `size` metres.
pub(super) fn lump(builder: &SceneBuilder, transform: Affine3A, size: f32, purpose: Purpose) {
    let (material, noise) = (builder.material(purpose), builder.noise());
    let size = size * builder.vector([(0.6, 1.4), (0.4, 1.), (0.6, 1.4)]);
    let ball = superellipsoid(size, [0.8, 0.8], 12);
    let rough = roughen(ball, &noise, 2. / size.max_element(), 0.25 * size.min_element());
    builder.add_mesh(rough, &material, transform * at(0., 0.3 * size.y, 0.));
}

/// Adds a framed picture on a wall, with its back at z = 0 and its center at the origin. A bright one lights the room like a window.
pub(super) fn picture(builder: &SceneBuilder, transform: Affine3A, is_window: bool) {
    let size = vec2(builder.log_uniform(0.2, 1.4), builder.log_uniform(0.2, 1.4));
    let outer = size + 2. * builder.within(0.01..0.1);
    builder.add_mesh(
        cuboid(outer.extend(0.03), 0.),
        &builder.object_material(),
        transform * at(0., -0.5 * outer.y, 0.015),
    );
    let mut poster = builder.picture(size);
    if is_window {
        poster.emission = builder.within(0.8..2.5);
        let [center, right, up] = [Vec3::Z * 0.05, Vec3::X * 0.5 * size.x, Vec3::Y * 0.5 * size.y];
        let source = LightSource::Panel {
            center: transform.transform_point3(center),
            right: transform.transform_vector3(right),
            up: transform.transform_vector3(up),
            facing: transform.transform_vector3(Vec3::Z),
        };
        builder.add_light(builder.within(2. ..6.) * size.x * size.y * vec3(0.9, 0.97, 1.), source);
    }
    let mesh = Mesh::rectangle((-0.5 * size).extend(0.032), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), 0.5);
    builder.add_mesh(mesh, &poster, transform);
}

/// Adds a single object, on the ground at `spot` or on a block there, to be viewed from all sides.
pub(super) fn orbit_target(builder: &SceneBuilder, spot: Vec3) -> OrbitTarget {
    let size = builder.log_vector([(0.3, 1.5); 3]);
    let below = if builder.chance(0.3) { 0. } else { builder.within(0.2..1.1) };
    if below > 0. {
        // The block reaches below the ground, which may be uneven.
        let (foot, broad) = (0.5, builder.within(0.6..1.6));
        let block = cuboid(vec3(broad * size.x, below + foot, broad * size.z), builder.within(0. ..0.05));
        builder.add_mesh(
            block,
            &builder.object_material(),
            Affine3A::from_translation(spot - foot * Vec3::Y),
        );
    }
    let transform = standing(spot + below * Vec3::Y, builder.angle());
    exhibit(builder, size, transform);
    OrbitTarget { middle: spot + (below + 0.4 * size.y) * Vec3::Y, radius: 0.5 * size.length(), front: None }
}

/// Adds a single object at the origin, and returns the middle and the radius of a ball that encloses it.
pub(super) fn floating(builder: &SceneBuilder) -> (Vec3, f32) {
    let size = builder.log_vector([(0.5, 1.5); 3]);
    exhibit(builder, size, standing(Vec3::ZERO, builder.angle()));
    let contents = builder.contents.borrow();
    let positions = || contents.meshes.iter().flat_map(|(mesh, _)| mesh.positions.iter().copied());
    let (min, max) = (positions().reduce(Vec3::min), positions().reduce(Vec3::max));
    let middle = 0.5 * (min.unwrap_or_default() + max.unwrap_or_default());
    (middle, positions().map(|position| position.distance(middle)).fold(0., f32::max))
}

/// Adds an object on a wall at `spot`, to be viewed from the direction `front`.
pub(super) fn hung(builder: &SceneBuilder, spot: Vec3, front: Vec3) -> OrbitTarget {
    let size = builder.log_vector([(0.3, 1.2), (0.2, 1.), (0.3, 1.2)]);
    // The object's up axis points away from the wall.
    let off_the_wall = Quat::from_rotation_arc(Vec3::Y, front) * Quat::from_rotation_y(builder.angle());
    exhibit(builder, size, Affine3A::from_rotation_translation(off_the_wall, spot));
    OrbitTarget { middle: spot + 0.4 * size.y * front, radius: 0.5 * size.length(), front: Some(front) }
}

/// Adds an object that merits its own video, about `size` metres large, standing at the origin of `transform`.
fn exhibit(builder: &SceneBuilder, size: Vec3, transform: Affine3A) {
    match builder.within(0..6) {
        0 => builder.add_mesh(plain(builder, size), &builder.object_material(), transform),
        1 => lump(builder, transform, size.max_element(), Purpose::Ground),
        2 => leaves(builder, transform, size.y, builder.within(12..60)),
        _ => heap(builder, size, transform, 3..12),
    }
}
