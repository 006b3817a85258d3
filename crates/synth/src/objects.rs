//! Objects made of plain shapes. Each stands on y = 0 around the origin and faces +z.

use super::light::Material;
use super::mesh::{
    Mesh, cone, cuboid, curtain, height_field, lathe, roughen, superellipsoid, taper, tube, twist,
};
use super::scene_builder::{SceneBuilder, at, standing};
use super::texture::Purpose;
use super::walk::OrbitTarget;
use glam::{Affine3A, Quat, Vec2, Vec3, vec2, vec3};
use std::f32::consts::{FRAC_PI_2, PI, TAU};
use std::ops::Range;

fn turned(angle: f32) -> Affine3A {
    Affine3A::from_rotation_y(angle)
}

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
            profile[1].x = builder.within(0.2..0.5);
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

/// Adds a random plain shape within `size`.
fn add_plain(builder: &SceneBuilder, size: Vec3, transform: Affine3A) {
    builder.add_mesh(plain(builder, size), &builder.thing(), transform);
}

/// Adds a heap of plain shapes on and beside each other, of about `size` in metres. Their number is random in `counts`.
pub(super) fn heap(builder: &SceneBuilder, size: Vec3, transform: Affine3A, counts: Range<usize>) {
    for _ in 0..builder.within(counts) {
        let mesh = plain(builder, size * builder.vector([(0.2, 0.6); 3]));
        let material = builder.thing();
        let spot =
            vec3(builder.within(-0.4..0.4), builder.within(0. ..0.6f32).powi(2), builder.within(-0.4..0.4))
                * size;
        let turn = match builder.chance(0.5) {
            true => Quat::from_rotation_y(builder.angle()),
            false => Quat::from_axis_angle(builder.direction(), builder.angle()),
        };
        builder.add_mesh(mesh, &material, transform * Affine3A::from_rotation_translation(turn, spot));
    }
}

/// Adds a table: a top on legs or on a central foot, with objects on it.
pub(super) fn table(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.vector([(0.5, 2.), (0.4, 0.85), (0.5, 1.1)]);
    let (top, legs) = (builder.thing(), builder.thing());
    let thick = builder.within(0.02..0.07);
    if builder.chance(0.25) {
        let round = cone(0.5 * size.x, 0.5 * size.x, thick, 28);
        builder.add_mesh(round, &top, transform * at(0., size.y, 0.));
        let foot = lathe(&[vec2(0.3 * size.x, 0.), vec2(0.05, 0.06), vec2(0.04, size.y)], 14);
        builder.add_mesh(foot, &legs, transform);
    } else {
        let round = builder.one_of(&[0., 0.01, 0.02]);
        builder.add_rounded_box(vec3(size.x, thick, size.z), round, &top, transform * at(0., size.y, 0.));
        let leg = builder.within(0.03..0.09);
        let slim = if builder.chance(0.5) { leg } else { 0.4 * leg };
        for (x, z) in [(-1., -1.), (-1., 1.), (1., -1.), (1., 1.)] {
            let corner = at(0.5 * x * (size.x - leg), 0., 0.5 * z * (size.z - leg));
            builder.add_mesh(cone(0.5 * slim, 0.5 * leg, size.y, 8), &legs, transform * corner);
        }
    }
    let surface = transform * at(0., size.y + thick, 0.);
    clutter(builder, vec2(0.8 * size.x, 0.8 * size.z), surface, 6);
}

/// Adds small objects on a surface of `size`: books, vessels, lamps, plain shapes.
pub(super) fn clutter(builder: &SceneBuilder, size: Vec2, transform: Affine3A, most: usize) {
    for _ in 0..builder.within(0..=most) {
        let spot = at(builder.within(-0.5..0.5) * size.x, 0., builder.within(-0.5..0.5) * size.y)
            * turned(builder.angle());
        match builder.within(0..5) {
            0 => books(builder, transform * spot, 0.3),
            1 => vessel(builder, transform * spot),
            2 => lamp(builder, transform * spot, 0.4),
            _ => {
                let size = builder.log_vector([(0.05, 0.35), (0.04, 0.35), (0.05, 0.35)]);
                add_plain(builder, size, transform * spot);
            }
        }
    }
}

/// Adds a bowl, cup, bottle or vase, sometimes with a plant in it.
pub(super) fn vessel(builder: &SceneBuilder, transform: Affine3A) {
    let (radius, height) = (builder.within(0.03..0.14), builder.within(0.06..0.4));
    let material = builder.thing();
    let mut rims = vec![vec2(0., 0.), vec2(radius * builder.within(0.4..1.), 0.)];
    for i in 1..=4 {
        rims.push(vec2(radius * builder.within(0.4..1.1), height * i as f32 / 4.));
    }
    builder.add_mesh(lathe(&rims, 20), &material, transform);
    if builder.chance(0.35) {
        leaves(builder, transform * at(0., height, 0.), 2.5 * radius, 24);
    }
}

/// Adds a row or a pile of books, `length` metres long.
pub(super) fn books(builder: &SceneBuilder, transform: Affine3A, length: f32) {
    let mut reached = 0.;
    let piled = builder.chance(0.3);
    while reached < length {
        let thick = builder.within(0.012..0.06);
        let (height, depth) = (builder.within(0.16..0.32), builder.within(0.12..0.24));
        let material = builder.thing();
        let spot = match piled {
            true => {
                at(0., reached, 0.)
                    * turned(builder.within(-0.3..0.3))
                    * Affine3A::from_rotation_z(FRAC_PI_2)
                    * at(0.5 * thick, -0.5 * height, 0.)
            }
            false => {
                let lean = if builder.chance(0.1) { builder.within(-0.2..0.2) } else { 0. };
                at(reached - 0.5 * length, 0., 0.) * Affine3A::from_rotation_z(lean)
            }
        };
        builder.add_box(vec3(thick, height, depth), &material, transform * spot);
        reached += thick + builder.within(0. ..0.004);
        if piled && reached > 0.4 * length || builder.chance(0.05) {
            break;
        }
    }
}

/// Adds shelves with objects on them, a cupboard with doors, or a chest of drawers.
pub(super) fn cabinet(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.vector([(0.5, 2.2), (0.6, 2.3), (0.25, 0.6)]);
    let (body, front) = (builder.thing(), builder.thing());
    let board = 0.025;
    if builder.chance(0.5) {
        for x in [-0.5, 0.5] {
            builder.add_box(vec3(board, size.y, size.z), &body, transform * at(x * (size.x - board), 0., 0.));
        }
        builder.add_box(vec3(size.x, size.y, 0.01), &body, transform * at(0., 0., -0.5 * size.z));
        let shelves = builder.within(2..7);
        for i in 0..=shelves {
            let height = (size.y - board) * i as f32 / shelves as f32;
            builder.add_box(vec3(size.x, board, size.z), &body, transform * at(0., height, 0.));
            if i < shelves && builder.chance(0.8) {
                let above = transform * at(0., height + board, 0.);
                match builder.chance(0.5) {
                    true => books(builder, above, size.x * builder.within(0.4..0.9)),
                    false => clutter(builder, vec2(0.8 * size.x, 0.5 * size.z), above, 4),
                }
            }
        }
    } else {
        builder.add_box(size, &body, transform);
        let (columns, rows) = (builder.within(1..4), builder.within(1..6));
        let cell = vec2(size.x / columns as f32, size.y / rows as f32);
        for column in 0..columns {
            for row in 0..rows {
                let x = (column as f32 + 0.5) * cell.x - 0.5 * size.x;
                let spot = transform * at(x, (row as f32 + 0.03) * cell.y, 0.5 * size.z);
                builder.add_box(vec3(0.94 * cell.x, 0.94 * cell.y, 0.02), &front, spot);
                let knob = superellipsoid(Vec3::splat(0.03), [1., 1.], 4);
                builder.add_mesh(knob, &body, spot * at(0.3 * cell.x, 0.5 * cell.y, 0.03));
            }
        }
        clutter(builder, vec2(0.8 * size.x, 0.7 * size.z), transform * at(0., size.y, 0.), 4);
    }
}

/// Adds a chair or stool.
pub(super) fn chair(builder: &SceneBuilder, transform: Affine3A) {
    let [wide, deep, seat] = builder.vector([(0.38, 0.6), (0.38, 0.6), (0.38, 0.5)]).into();
    let (cloth, wood) = (builder.thing(), builder.thing());
    let thick = builder.within(0.02..0.12);
    let cushion = transform * at(0., seat - thick, 0.);
    builder.add_rounded_box(vec3(wide, thick, deep), 0.4 * thick, &cloth, cushion);
    let leg = builder.within(0.012..0.03);
    for (x, z) in [(-0.45, -0.45), (-0.45, 0.45), (0.45, -0.45), (0.45, 0.45)] {
        builder.add_mesh(cone(leg, leg, seat - thick, 7), &wood, transform * at(x * wide, 0., z * deep));
    }
    if builder.chance(0.85) {
        let height = builder.within(0.3..0.6);
        let lean = Affine3A::from_rotation_x(-builder.within(0. ..0.25));
        let back = transform * at(0., seat, -0.47 * deep) * lean;
        match builder.chance(0.5) {
            true => builder.add_rounded_box(vec3(wide, height, 0.04), 0.015, &cloth, back),
            false => {
                for i in 0..5 {
                    let bar = cone(0.01, 0.01, height, 6);
                    builder.add_mesh(bar, &wood, back * at((i as f32 / 4. - 0.5) * 0.9 * wide, 0., 0.));
                }
                let rail = back * at(0., height - 0.05, 0.);
                builder.add_rounded_box(vec3(wide, 0.07, 0.03), 0.01, &wood, rail);
            }
        }
    }
}

/// Adds a sofa or armchair with cushions.
pub(super) fn sofa(builder: &SceneBuilder, transform: Affine3A) {
    let (wide, deep) = (builder.within(0.8..2.4), builder.within(0.75..1.));
    let cloth = builder.thing();
    let [seat, back, arm] = builder.vector([(0.35, 0.45), (0.7, 0.95), (0.12, 0.25)]).into();
    builder.add_rounded_box(vec3(wide, seat, deep), 0.05, &cloth, transform);
    builder.add_rounded_box(vec3(wide, back, 0.22), 0.08, &cloth, transform * at(0., 0., -0.5 * deep));
    for x in [-0.5, 0.5] {
        builder.add_rounded_box(vec3(arm, seat + 0.2, deep), 0.06, &cloth, transform * at(x * wide, 0., 0.));
    }
    for _ in 0..builder.within(0..5) {
        let pillow = superellipsoid(vec3(0.45, 0.42, 0.16), [0.5, 0.5], 7);
        let cover = builder.thing();
        let x = builder.within(-0.4..0.4) * wide;
        let lean = Affine3A::from_rotation_x(-0.3) * Affine3A::from_rotation_y(builder.within(-0.5..0.5));
        builder.add_mesh(pillow, &cover, transform * at(x, seat + 0.2, -0.22 * deep) * lean);
    }
}

/// Adds a bed with bedding.
pub(super) fn bed(builder: &SceneBuilder, transform: Affine3A) {
    let (wide, long, high) = (builder.within(0.9..2.), 2.1, builder.within(0.35..0.6));
    let (wood, sheet, cover) = (builder.thing(), builder.thing(), builder.thing());
    builder.add_rounded_box(vec3(wide + 0.06, 0.6 * high, long), 0.01, &wood, transform);
    let mattress = transform * at(0., 0.6 * high, 0.);
    builder.add_rounded_box(vec3(wide, 0.5 * high, long - 0.06), 0.08, &sheet, mattress);
    let board = builder.within(0.8..1.3);
    builder.add_rounded_box(vec3(wide + 0.06, board, 0.06), 0.02, &wood, transform * at(0., 0., -0.5 * long));
    let noise = builder.noise();
    let blanket = height_field(vec2(wide + 0.1, 0.65 * long), 16, |x, z| {
        0.06 * noise.fractal(vec3(3. * x, 0., 3. * z), 3) - 0.5 * (x.abs() - 0.5 * wide).max(0.)
    });
    builder.add_mesh(blanket, &cover, transform * at(0., 1.1 * high + 0.05, 0.15 * long));
    for x in [-0.25, 0.25] {
        let pillow = superellipsoid(vec3(0.45 * wide, 0.16, 0.42), [0.6, 0.5], 8);
        builder.add_mesh(pillow, &sheet, transform * at(x * wide, 1.1 * high + 0.06, -0.36 * long));
    }
}

/// Adds a lamp of `height` metres: a shade on a stand, which glows if the lamp is on.
pub(super) fn lamp(builder: &SceneBuilder, transform: Affine3A, height: f32) {
    let (stand, mut shade) = (builder.thing(), builder.thing());
    shade.emission = if builder.chance(0.6) { builder.within(0.5..2.5) } else { 0. };
    shade.specular = 0.;
    let wide = (0.3 * height).min(0.25) * builder.within(0.7..1.3);
    let foot =
        [vec2(0., 0.), vec2(0.5 * wide, 0.), vec2(0.5 * wide, 0.02), vec2(0.012, 0.03), vec2(0.012, height)];
    builder.add_mesh(lathe(&foot, 14), &stand, transform);
    let narrow = builder.within(0.4..1.) * wide;
    let rims = [vec2(wide, 0.75 * height), vec2(narrow, height)];
    builder.add_mesh(lathe(&rims, 18), &shade, transform);
}

/// Adds leaves on arching stems, up to `reach` metres long.
pub(super) fn leaves(builder: &SceneBuilder, transform: Affine3A, reach: f32, count: usize) {
    let mut material = builder.material(Purpose::Foliage);
    material.mirror_reflectance = 0.;
    let mut all = Mesh::default();
    let slim = builder.within(0.06..0.35);
    let droop = builder.within(-0.3..1.2);
    for _ in 0..count {
        let length = reach * builder.within(0.5..1.);
        let leaf = Mesh::grid(2, 5, vec2(slim * length, length), |u, v| {
            let wide = slim * length * (PI * v.powf(0.7)).sin();
            let rise = v - 0.5 * droop * v * v;
            vec3((u - 0.5) * wide, rise * length, 0.6 * length * v * v + 0.1 * wide * (2. * u - 1.).abs())
        });
        let tilt = Affine3A::from_rotation_x(builder.within(0. ..1.));
        all.join(leaf.moved(turned(builder.angle()) * tilt));
    }
    builder.add_mesh(all, &material, transform);
}

/// Adds a plant in a pot on the floor.
pub(super) fn plant(builder: &SceneBuilder, transform: Affine3A) {
    let (radius, height) = (builder.within(0.1..0.25), builder.within(0.15..0.5));
    let pot = builder.thing();
    let slope = builder.within(0.6..1.);
    let rims = [vec2(slope * radius, 0.), vec2(radius, height), vec2(0., 0.9 * height)];
    builder.add_mesh(lathe(&rims, 18), &pot, transform);
    let above = transform * at(0., 0.9 * height, 0.);
    leaves(builder, above, builder.within(0.3..1.1), builder.within(12..60));
}

/// Adds a framed picture on a wall, with its back at z = 0 and its center at the origin.
pub(super) fn picture(builder: &SceneBuilder, transform: Affine3A) {
    let size = vec2(builder.log_uniform(0.2, 1.4), builder.log_uniform(0.2, 1.2));
    let (poster, frame) = (builder.picture(size), builder.thing());
    framed_sheet(builder, size, &poster, builder.within(0.01..0.08), &frame, transform);
}

/// Adds a framed mirror, placed like a picture.
pub(super) fn mirror(builder: &SceneBuilder, transform: Affine3A) {
    let size = vec2(builder.within(0.4..1.2), builder.within(0.5..1.6));
    let frame = builder.thing();
    let mut glass = builder.material(Purpose::Ceiling);
    (glass.mirror_reflectance, glass.specular) = (0.9, 0.);
    framed_sheet(builder, size, &glass, 0.04, &frame, transform);
}

/// Adds a flat `sheet` of `size` in a frame that is `edge` metres wide.
fn framed_sheet(
    builder: &SceneBuilder,
    size: Vec2,
    sheet: &Material,
    edge: f32,
    frame: &Material,
    transform: Affine3A,
) {
    let outer = size + 2. * edge;
    builder.add_box(vec3(outer.x, outer.y, 0.03), frame, transform * at(0., -0.5 * outer.y, 0.015));
    let mesh = Mesh::rectangle((-0.5 * size).extend(0.032), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), 0.5);
    builder.add_mesh(mesh, sheet, transform);
}

/// Adds curtains on both sides of a window of `size` whose center is at the origin.
pub(super) fn curtains(builder: &SceneBuilder, transform: Affine3A, size: Vec2) {
    let cloth = builder.thing();
    let (wide, folds) = (size.x * builder.within(0.2..0.4), builder.within(3. ..7.));
    let height = size.y + 0.3 + if builder.chance(0.5) { builder.within(0. ..0.6) } else { 0. };
    for x in [-0.5, 0.5] {
        let drape = curtain(wide, height, folds, 0.05);
        builder.add_mesh(drape, &cloth, transform * at(x * size.x, 0.5 * size.y + 0.1, 0.1));
    }
}

/// Adds a tree: a bent trunk, branches, and a crown of leaves or of green clouds.
pub(super) fn tree(builder: &SceneBuilder, transform: Affine3A, height: f32) {
    let bark = builder.thing();
    let (bend_x, bend_z) = (builder.within(-0.15..0.15) * height, builder.within(-0.15..0.15) * height);
    let stem = move |t: f32| vec3(bend_x * t * t, height * t, bend_z * t * t);
    let thick = builder.within(0.02..0.045) * height;
    builder.add_mesh(tube(stem, move |t| thick * (1.1 - t), [8, 8]), &bark, transform);
    let crown = builder.material(Purpose::Foliage);
    let noise = builder.noise();
    match builder.within(0..3) {
        0 => {
            // A conifer: skirts above each other.
            let skirts = builder.within(4..8);
            for i in 0..skirts {
                let share = i as f32 / skirts as f32;
                let (wide, y) = (0.28 * height * (1.05 - share), height * (0.15 + 0.8 * share));
                let skirt = lathe(&[vec2(wide, 0.), vec2(0.02, 0.3 * height)], 16);
                let rough = roughen(skirt, &noise, 6. / height, 0.03 * height);
                builder.add_mesh(rough, &crown, transform * at(0., y, 0.));
            }
        }
        1 => {
            for _ in 0..builder.within(5..12) {
                let middle = stem(builder.within(0.55..1.));
                let offset = builder.direction() * builder.within(0. ..0.2) * height;
                let size = builder.vector([(0.2, 0.4), (0.15, 0.35), (0.2, 0.4)]) * height;
                let cloud = roughen(superellipsoid(size, [1., 1.], 9), &noise, 7. / height, 0.06 * height);
                builder.add_mesh(cloud, &crown, transform * Affine3A::from_translation(middle + offset));
            }
        }
        _ => {
            for _ in 0..builder.within(6..14) {
                let middle = stem(builder.within(0.5..1.));
                let tip = middle + builder.direction() * builder.within(0.1..0.3) * height;
                let branch = move |t: f32| middle.lerp(tip, t);
                builder.add_mesh(tube(branch, move |_| 0.25 * thick, [3, 5]), &bark, transform);
                leaves(builder, transform * Affine3A::from_translation(tip), 0.18 * height, 10);
            }
        }
    }
}

/// Adds a bush or a tuft of grass.
pub(super) fn bush(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.vector([(0.4, 1.6), (0.3, 1.2), (0.4, 1.6)]);
    if builder.chance(0.5) {
        leaves(builder, transform, size.y, 40);
        return;
    }
    let (crown, noise) = (builder.material(Purpose::Foliage), builder.noise());
    let ball = roughen(superellipsoid(size, [1., 1.], 12), &noise, 3.5, 0.18);
    builder.add_mesh(ball, &crown, transform * at(0., 0.4 * size.y, 0.));
}

/// Adds a rock.
pub(super) fn rock(builder: &SceneBuilder, transform: Affine3A, size: f32) {
    let (stone, noise) = (builder.material(Purpose::Ground), builder.noise());
    let size = size * builder.vector([(0.6, 1.4), (0.4, 1.), (0.6, 1.4)]);
    let ball = superellipsoid(size, [0.8, 0.8], 12);
    let rough = roughen(ball, &noise, 2. / size.max_element(), 0.25 * size.min_element());
    builder.add_mesh(rough, &stone, transform * at(0., 0.3 * size.y, 0.));
}

/// Adds a house: walls with windows and doors, under a roof.
pub(super) fn house(builder: &SceneBuilder, transform: Affine3A) {
    let size = builder.vector([(4., 10.), (2.6, 7.), (4., 9.)]);
    let (wall, roof) = (builder.material(Purpose::Facade), builder.material(Purpose::Facade));
    builder.add_box(size, &wall, transform);
    let (over, rise) = (builder.within(0.1..0.6), builder.within(0. ..0.5) * size.x);
    let half = vec3(0.5 * size.x + over, 0., 0.5 * size.z + over);
    for side in [-1., 1.] {
        let eaves = vec3(side * half.x, size.y - 0.02, side * half.z);
        let sheet =
            Mesh::rectangle(eaves, vec3(0., 0., -2. * side * half.z), vec3(-side * half.x, rise, 0.), 2.);
        builder.add_mesh(sheet, &roof, transform);
        let gable = Mesh::grid(1, 1, vec2(size.x, rise), |u, v| {
            vec3(side * (u - 0.5) * size.x * (1. - v), size.y + rise * v, 0.5 * side * size.z)
        });
        builder.add_mesh(gable, &wall, transform);
    }
    let (glass, frame) = (window_glass(builder), builder.thing());
    let floors = (size.y / 2.6).floor().max(1.) as usize;
    for turn in 0..4 {
        let (wide, deep) = if turn % 2 == 0 { (size.x, size.z) } else { (size.z, size.x) };
        let count = (wide / builder.within(1.6..3.)).floor().max(1.);
        for floor in 0..floors {
            for i in 0..count as usize {
                let x = ((i as f32 + 0.5) / count - 0.5) * wide;
                let is_door = floor == 0 && builder.chance(0.15);
                let pane = if is_door { vec2(0.9, 2.) } else { vec2(1.1, 1.3) };
                let y = 2.6 * floor as f32 + if is_door { 0. } else { 0.8 };
                let spot = transform * turned(turn as f32 * FRAC_PI_2) * at(x, y, 0.5 * deep);
                builder.add_box(vec3(pane.x + 0.16, pane.y + 0.16, 0.06), &frame, spot * at(0., -0.08, 0.));
                builder.add_box(vec3(pane.x, pane.y, 0.08), if is_door { &wall } else { &glass }, spot);
            }
        }
    }
}

/// Returns the material of window panes seen from outside: dark and reflecting.
fn window_glass(builder: &SceneBuilder) -> Material {
    let mut glass = builder.material(Purpose::Ceiling);
    glass.tint = Vec3::splat(builder.within(0.03..0.25));
    glass.mirror_reflectance = builder.within(0.05..0.3);
    glass
}

/// Adds a fence of boards and rails, `length` metres along x.
pub(super) fn fence(builder: &SceneBuilder, transform: Affine3A, length: f32) {
    let wood = builder.thing();
    let (height, gap) = (builder.within(0.7..1.8), builder.within(0.08..0.5f32));
    let board = (0.5 * gap).min(0.12);
    for i in 0..(length / gap) as usize {
        let spot = transform * at(i as f32 * gap - 0.5 * length, 0., 0.);
        builder.add_box(vec3(board, height, 0.03), &wood, spot);
    }
    for y in [0.3, 0.8] {
        builder.add_box(vec3(length, 0.08, 0.03), &wood, transform * at(0., y * height, -0.03));
    }
}

/// Adds a single object, on the ground at `spot` or on a block there, to be viewed from all sides.
pub(super) fn orbit_target(builder: &SceneBuilder, spot: Vec3) -> OrbitTarget {
    let size = builder.log_vector([(0.3, 1.5); 3]);
    let below = if builder.chance(0.3) { 0. } else { builder.within(0.2..1.1) };
    if below > 0. {
        // The block reaches below the ground, which may be uneven.
        let (foot, broad) = (0.5, builder.within(0.6..1.6));
        let material = builder.thing();
        let block = cuboid(vec3(broad * size.x, below + foot, broad * size.z), builder.within(0. ..0.05));
        builder.add_mesh(block, &material, Affine3A::from_translation(spot - foot * Vec3::Y));
    }
    let transform = standing(spot + below * Vec3::Y, builder.angle());
    exhibit_object(builder, size, transform);
    OrbitTarget { middle: spot + (below + 0.4 * size.y) * Vec3::Y, radius: 0.5 * size.length(), front: None }
}

/// Adds an object on a wall at `spot`, to be viewed from the direction `front`.
pub(super) fn hung(builder: &SceneBuilder, spot: Vec3, front: Vec3) -> OrbitTarget {
    let size = builder.log_vector([(0.3, 1.2), (0.2, 1.), (0.3, 1.2)]);
    // The object's up axis points away from the wall.
    let off_the_wall = Quat::from_rotation_arc(Vec3::Y, front) * Quat::from_rotation_y(builder.angle());
    exhibit_object(builder, size, Affine3A::from_rotation_translation(off_the_wall, spot));
    OrbitTarget { middle: spot + 0.4 * size.y * front, radius: 0.5 * size.length(), front: Some(front) }
}

/// Adds an object that merits its own video, about `size` metres large, standing at the origin of `transform`.
fn exhibit_object(builder: &SceneBuilder, size: Vec3, transform: Affine3A) {
    match builder.within(0..6) {
        0 => add_plain(builder, size, transform),
        1 => rock(builder, transform, size.max_element()),
        2 => plant(builder, transform),
        _ => heap(builder, size, transform, 3..12),
    }
}

/// Adds a random piece of furniture, for placement along a wall or in the open.
pub(super) fn furniture(builder: &SceneBuilder, transform: Affine3A) {
    match builder.within(0..12) {
        0 | 1 => table(builder, transform),
        2 | 3 => cabinet(builder, transform),
        4 | 5 => chair(builder, transform),
        6 => sofa(builder, transform),
        7 => bed(builder, transform),
        8 => lamp(builder, transform, builder.within(1.1..1.8)),
        9 => plant(builder, transform),
        10 => add_plain(builder, builder.log_vector([(0.3, 1.5); 3]), transform),
        _ => heap(builder, builder.vector([(0.4, 1.4); 3]), transform, 3..9),
    }
}
