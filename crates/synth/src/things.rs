//! Objects made of plain shapes. Each stands on y = 0 around the origin and faces +z.

use super::maker::{Maker, standing};
use super::material::Material;
use super::mesh::Mesh;
use super::shapes::{
    cone, cuboid, curtain, height_field, lathe, roughen, superellipsoid, taper, tube, twist,
};
use super::texture::Purpose;
use super::walk::Exhibit;
use glam::{Affine3A, Quat, Vec2, Vec3, vec2, vec3};
use std::f32::consts::{FRAC_PI_2, PI, TAU};

fn at(x: f32, y: f32, z: f32) -> Affine3A {
    Affine3A::from_translation(vec3(x, y, z))
}

fn turned(angle: f32) -> Affine3A {
    Affine3A::from_rotation_y(angle)
}

/// Creates a random plain shape within `size`, possibly stretched, bent and roughened, standing on y = 0.
pub(super) fn plain(make: &mut Maker, size: Vec3) -> Mesh {
    let half = size / 2.;
    let mut mesh = match make.within(0..9) {
        0 => cuboid(size, 0.),
        1 => {
            let round = make.within(0.05..0.5) * size.min_element();
            cuboid(size, round)
        }
        2 => superellipsoid(size, [1., 1.], 10),
        3 => {
            let powers = [make.within(0.2..1.6), make.within(0.2..1.6)];
            superellipsoid(size, powers, 10)
        }
        4 => cone(0.5, 0.5, 1., 20).warped(|p| p * size),
        5 => {
            let above = make.within(0. ..0.4);
            cone(0.5, above, 1., 20).warped(|p| p * size)
        }
        6 => {
            let thick = make.within(0.12..0.35f32);
            let ring = move |t: f32| vec3((1. - thick) * (TAU * t).cos(), 0., (1. - thick) * (TAU * t).sin());
            let flat = tube(ring, |_| thick, [24, 10]);
            let upright = make.chance(0.5);
            let stood = if upright { flat.warped(|p| vec3(p.x, p.z, p.y)) } else { flat };
            stood.warped(|p| p * half)
        }
        7 => {
            let (waves, thick) = (make.within(1..5) as f32, make.within(0.06..0.2));
            let knot = move |t: f32| {
                let (a, b) = (TAU * t, TAU * t * waves);
                vec3(0.8 * a.cos(), 0.8 * (b + 0.5).sin() * 0.5, 0.8 * a.sin() * (1. + 0.2 * b.cos()))
            };
            tube(knot, move |_| thick, [48, 8]).warped(|p| p * half)
        }
        _ => {
            let profile: Vec<Vec2> = {
                let steps = make.within(3..8);
                let mut radii: Vec<f32> = (0..=steps).map(|_| make.within(0.12..0.5)).collect();
                radii[0] = make.within(0.2..0.5);
                let rims = radii.iter().enumerate();
                let mut rims: Vec<Vec2> = rims.map(|(i, &r)| vec2(r, i as f32 / steps as f32)).collect();
                rims.insert(0, vec2(0., 0.));
                rims
            };
            lathe(&profile, 20).warped(|p| p * size)
        }
    };
    if make.chance(0.2) {
        mesh = taper(mesh, make.within(-0.6..0.6) / size.y);
    }
    if make.chance(0.15) {
        mesh = twist(mesh, make.within(-0.4..0.4) / size.y);
    }
    if make.chance(0.15) {
        let (noise, strength) = (make.noise(), make.within(0.03..0.15));
        mesh = roughen(mesh, &noise, 2.5 / size.max_element(), strength * size.min_element());
    }
    let (least, _) = mesh.bounds();
    mesh.moved(at(0., -least.y, 0.))
}

/// Adds a heap of plain shapes on and beside each other, of about `size` in metres.
pub(super) fn heap(make: &mut Maker, size: Vec3, place: Affine3A, count: usize) {
    for _ in 0..count {
        let part = size * vec3(make.within(0.2..0.6), make.within(0.2..0.6), make.within(0.2..0.6));
        let mesh = plain(make, part);
        let material = make.material(Purpose::Thing);
        let spot =
            vec3(make.within(-0.4..0.4), make.within(0. ..0.6f32).powi(2), make.within(-0.4..0.4)) * size;
        let turn = match make.chance(0.5) {
            true => Quat::from_rotation_y(make.turn()),
            false => Quat::from_axis_angle(make.direction(), make.turn()),
        };
        make.put(mesh, &material, place * Affine3A::from_rotation_translation(turn, spot));
    }
}

/// Adds a table: a top on legs or on a central foot, with objects on it.
pub(super) fn table(make: &mut Maker, place: Affine3A) {
    let size = vec3(make.within(0.5..2.), make.within(0.4..0.85), make.within(0.5..1.1));
    let (top, legs) = (make.material(Purpose::Thing), make.material(Purpose::Thing));
    let thick = make.within(0.02..0.07);
    if make.chance(0.25) {
        let round = cone(0.5 * size.x, 0.5 * size.x, thick, 28);
        make.put(round, &top, place * at(0., size.y, 0.));
        let foot = lathe(&[vec2(0.3 * size.x, 0.), vec2(0.05, 0.06), vec2(0.04, size.y)], 14);
        make.put(foot, &legs, place);
    } else {
        let round = make.one_of(&[0., 0.01, 0.02]);
        make.put(cuboid(vec3(size.x, thick, size.z), round), &top, place * at(0., size.y, 0.));
        let leg = make.within(0.03..0.09);
        let slim = if make.chance(0.5) { leg } else { 0.4 * leg };
        for (x, z) in [(-1., -1.), (-1., 1.), (1., -1.), (1., 1.)] {
            let corner = at(0.5 * x * (size.x - leg), 0., 0.5 * z * (size.z - leg));
            make.put(cone(0.5 * slim, 0.5 * leg, size.y, 8), &legs, place * corner);
        }
    }
    let surface = place * at(0., size.y + thick, 0.);
    clutter(make, vec2(0.8 * size.x, 0.8 * size.z), surface, 6);
}

/// Adds small objects on a surface of `size`: books, vessels, lamps, plain shapes.
pub(super) fn clutter(make: &mut Maker, size: Vec2, place: Affine3A, most: usize) {
    for _ in 0..make.within(0..=most) {
        let spot =
            at(make.within(-0.5..0.5) * size.x, 0., make.within(-0.5..0.5) * size.y) * turned(make.turn());
        match make.within(0..5) {
            0 => books(make, place * spot, 0.3),
            1 => vessel(make, place * spot),
            2 => lamp(make, place * spot, 0.4),
            _ => {
                let size = vec3(make.scaled(0.05, 0.35), make.scaled(0.04, 0.35), make.scaled(0.05, 0.35));
                let (mesh, material) = (plain(make, size), make.material(Purpose::Thing));
                make.put(mesh, &material, place * spot);
            }
        }
    }
}

/// Adds a bowl, cup, bottle or vase, sometimes with a plant in it.
pub(super) fn vessel(make: &mut Maker, place: Affine3A) {
    let (radius, height) = (make.within(0.03..0.14), make.within(0.06..0.4));
    let material = make.material(Purpose::Thing);
    let mut rims = vec![vec2(0., 0.), vec2(radius * make.within(0.4..1.), 0.)];
    for i in 1..=4 {
        rims.push(vec2(radius * make.within(0.4..1.1), height * i as f32 / 4.));
    }
    make.put(lathe(&rims, 20), &material, place);
    if make.chance(0.35) {
        leaves(make, place * at(0., height, 0.), 2.5 * radius, 24);
    }
}

/// Adds a row or a pile of books, `length` metres long.
pub(super) fn books(make: &mut Maker, place: Affine3A, length: f32) {
    let mut reached = 0.;
    let piled = make.chance(0.3);
    while reached < length {
        let thick = make.within(0.012..0.06);
        let (height, depth) = (make.within(0.16..0.32), make.within(0.12..0.24));
        let material = make.material(Purpose::Thing);
        let book = cuboid(vec3(thick, height, depth), 0.);
        let spot = match piled {
            true => {
                at(0., reached, 0.)
                    * turned(make.within(-0.3..0.3))
                    * Affine3A::from_rotation_z(FRAC_PI_2)
                    * at(0.5 * thick, -0.5 * height, 0.)
            }
            false => {
                let lean = if make.chance(0.1) { make.within(-0.2..0.2) } else { 0. };
                at(reached - 0.5 * length, 0., 0.) * Affine3A::from_rotation_z(lean)
            }
        };
        make.put(book, &material, place * spot);
        reached += thick + make.within(0. ..0.004);
        if piled && reached > 0.4 * length || make.chance(0.05) {
            break;
        }
    }
}

/// Adds shelves with objects on them, a cupboard with doors, or a chest of drawers.
pub(super) fn cabinet(make: &mut Maker, place: Affine3A) {
    let size = vec3(make.within(0.5..2.2), make.within(0.6..2.3), make.within(0.25..0.6));
    let (body, front) = (make.material(Purpose::Thing), make.material(Purpose::Thing));
    let board = 0.025;
    if make.chance(0.5) {
        let side = cuboid(vec3(board, size.y, size.z), 0.);
        for x in [-0.5, 0.5] {
            make.put(side.clone(), &body, place * at(x * (size.x - board), 0., 0.));
        }
        make.put(cuboid(vec3(size.x, size.y, 0.01), 0.), &body, place * at(0., 0., -0.5 * size.z));
        let shelves = make.within(2..7);
        for i in 0..=shelves {
            let height = (size.y - board) * i as f32 / shelves as f32;
            make.put(cuboid(vec3(size.x, board, size.z), 0.), &body, place * at(0., height, 0.));
            if i < shelves && make.chance(0.8) {
                let above = place * at(0., height + board, 0.);
                match make.chance(0.5) {
                    true => {
                        let length = size.x * make.within(0.4..0.9);
                        books(make, above, length);
                    }
                    false => clutter(make, vec2(0.8 * size.x, 0.5 * size.z), above, 4),
                }
            }
        }
    } else {
        make.put(cuboid(size, 0.), &body, place);
        let (columns, rows) = (make.within(1..4), make.within(1..6));
        let cell = vec2(size.x / columns as f32, size.y / rows as f32);
        for column in 0..columns {
            for row in 0..rows {
                let x = (column as f32 + 0.5) * cell.x - 0.5 * size.x;
                let spot = place * at(x, (row as f32 + 0.03) * cell.y, 0.5 * size.z);
                make.put(cuboid(vec3(0.94 * cell.x, 0.94 * cell.y, 0.02), 0.), &front, spot);
                let knob = superellipsoid(Vec3::splat(0.03), [1., 1.], 4);
                make.put(knob, &body, spot * at(0.3 * cell.x, 0.5 * cell.y, 0.03));
            }
        }
        clutter(make, vec2(0.8 * size.x, 0.7 * size.z), place * at(0., size.y, 0.), 4);
    }
}

/// Adds a chair or stool.
pub(super) fn chair(make: &mut Maker, place: Affine3A) {
    let (wide, deep, seat) = (make.within(0.38..0.6), make.within(0.38..0.6), make.within(0.38..0.5));
    let (cloth, wood) = (make.material(Purpose::Thing), make.material(Purpose::Thing));
    let thick = make.within(0.02..0.12);
    make.put(cuboid(vec3(wide, thick, deep), 0.4 * thick), &cloth, place * at(0., seat - thick, 0.));
    let leg = make.within(0.012..0.03);
    for (x, z) in [(-0.45, -0.45), (-0.45, 0.45), (0.45, -0.45), (0.45, 0.45)] {
        make.put(cone(leg, leg, seat - thick, 7), &wood, place * at(x * wide, 0., z * deep));
    }
    if make.chance(0.85) {
        let height = make.within(0.3..0.6);
        let lean = Affine3A::from_rotation_x(-make.within(0. ..0.25));
        let back = place * at(0., seat, -0.47 * deep) * lean;
        match make.chance(0.5) {
            true => make.put(cuboid(vec3(wide, height, 0.04), 0.015), &cloth, back),
            false => {
                for i in 0..5 {
                    let bar = cone(0.01, 0.01, height, 6);
                    make.put(bar, &wood, back * at((i as f32 / 4. - 0.5) * 0.9 * wide, 0., 0.));
                }
                make.put(cuboid(vec3(wide, 0.07, 0.03), 0.01), &wood, back * at(0., height - 0.05, 0.));
            }
        }
    }
}

/// Adds a sofa or armchair with cushions.
pub(super) fn sofa(make: &mut Maker, place: Affine3A) {
    let (wide, deep) = (make.within(0.8..2.4), make.within(0.75..1.));
    let cloth = make.material(Purpose::Thing);
    let (seat, back, arm) = (make.within(0.35..0.45), make.within(0.7..0.95), make.within(0.12..0.25));
    make.put(cuboid(vec3(wide, seat, deep), 0.05), &cloth, place);
    make.put(cuboid(vec3(wide, back, 0.22), 0.08), &cloth, place * at(0., 0., -0.5 * deep));
    for x in [-0.5, 0.5] {
        make.put(cuboid(vec3(arm, seat + 0.2, deep), 0.06), &cloth, place * at(x * wide, 0., 0.));
    }
    for _ in 0..make.within(0..5) {
        let pillow = superellipsoid(vec3(0.45, 0.42, 0.16), [0.5, 0.5], 7);
        let cover = make.material(Purpose::Thing);
        let x = make.within(-0.4..0.4) * wide;
        let lean = Affine3A::from_rotation_x(-0.3) * Affine3A::from_rotation_y(make.within(-0.5..0.5));
        make.put(pillow, &cover, place * at(x, seat + 0.2, -0.22 * deep) * lean);
    }
}

/// Adds a bed with bedding.
pub(super) fn bed(make: &mut Maker, place: Affine3A) {
    let (wide, long, high) = (make.within(0.9..2.), 2.1, make.within(0.35..0.6));
    let (wood, sheet, cover) =
        (make.material(Purpose::Thing), make.material(Purpose::Thing), make.material(Purpose::Thing));
    make.put(cuboid(vec3(wide + 0.06, 0.6 * high, long), 0.01), &wood, place);
    make.put(cuboid(vec3(wide, 0.5 * high, long - 0.06), 0.08), &sheet, place * at(0., 0.6 * high, 0.));
    let board = make.within(0.8..1.3);
    make.put(cuboid(vec3(wide + 0.06, board, 0.06), 0.02), &wood, place * at(0., 0., -0.5 * long));
    let noise = make.noise();
    let blanket = height_field(vec2(wide + 0.1, 0.65 * long), 16, |x, z| {
        0.06 * noise.fractal(vec3(3. * x, 0., 3. * z), 3) - 0.5 * (x.abs() - 0.5 * wide).max(0.)
    });
    make.put(blanket, &cover, place * at(0., 1.1 * high + 0.05, 0.15 * long));
    for x in [-0.25, 0.25] {
        let pillow = superellipsoid(vec3(0.45 * wide, 0.16, 0.42), [0.6, 0.5], 8);
        make.put(pillow, &sheet, place * at(x * wide, 1.1 * high + 0.06, -0.36 * long));
    }
}

/// Adds a lamp of `height` metres: a shade on a stand, which glows if the lamp is on.
pub(super) fn lamp(make: &mut Maker, place: Affine3A, height: f32) {
    let (stand, mut shade) = (make.material(Purpose::Thing), make.material(Purpose::Thing));
    shade.glow = if make.chance(0.6) { make.within(0.5..2.5) } else { 0. };
    shade.gloss = 0.;
    let wide = (0.3 * height).min(0.25) * make.within(0.7..1.3);
    let foot =
        [vec2(0., 0.), vec2(0.5 * wide, 0.), vec2(0.5 * wide, 0.02), vec2(0.012, 0.03), vec2(0.012, height)];
    make.put(lathe(&foot, 14), &stand, place);
    let narrow = make.within(0.4..1.) * wide;
    let rims = [vec2(wide, 0.75 * height), vec2(narrow, height)];
    make.put(lathe(&rims, 18), &shade, place);
}

/// Adds leaves on arching stems, up to `reach` metres long.
pub(super) fn leaves(make: &mut Maker, place: Affine3A, reach: f32, count: usize) {
    let mut material = make.material(Purpose::Foliage);
    material.mirror = 0.;
    let mut all = Mesh::default();
    let slim = make.within(0.06..0.35);
    let droop = make.within(-0.3..1.2);
    for _ in 0..count {
        let length = reach * make.within(0.5..1.);
        let leaf = Mesh::grid(2, 5, vec2(slim * length, length), |u, v| {
            let wide = slim * length * (PI * v.powf(0.7)).sin();
            let rise = v - 0.5 * droop * v * v;
            vec3((u - 0.5) * wide, rise * length, 0.6 * length * v * v + 0.1 * wide * (2. * u - 1.).abs())
        });
        let tilt = Affine3A::from_rotation_x(make.within(0. ..1.));
        all.join(leaf.moved(turned(make.turn()) * tilt));
    }
    make.put(all, &material, place);
}

/// Adds a plant in a pot on the floor.
pub(super) fn plant(make: &mut Maker, place: Affine3A) {
    let (radius, height) = (make.within(0.1..0.25), make.within(0.15..0.5));
    let pot = make.material(Purpose::Thing);
    let slope = make.within(0.6..1.);
    make.put(
        lathe(&[vec2(slope * radius, 0.), vec2(radius, height), vec2(0., 0.9 * height)], 18),
        &pot,
        place,
    );
    let (reach, count) = (make.within(0.3..1.1), make.within(12..60));
    leaves(make, place * at(0., 0.9 * height, 0.), reach, count);
}

/// Adds a framed picture on a wall, with its back at z = 0 and its centre at the origin.
pub(super) fn picture(make: &mut Maker, place: Affine3A) {
    let size = vec2(make.scaled(0.2, 1.4), make.scaled(0.2, 1.2));
    let poster = make.picture(size);
    let frame = make.material(Purpose::Thing);
    let edge = make.within(0.01..0.08);
    let outer = size + 2. * edge;
    make.put(cuboid(vec3(outer.x, outer.y, 0.03), 0.), &frame, place * at(0., -0.5 * outer.y, 0.015));
    let sheet = Mesh::rectangle((-0.5 * size).extend(0.032), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), 0.5);
    make.put(sheet, &poster, place);
}

/// Adds a framed mirror, placed like a picture.
pub(super) fn mirror(make: &mut Maker, place: Affine3A) {
    let size = vec2(make.within(0.4..1.2), make.within(0.5..1.6));
    let frame = make.material(Purpose::Thing);
    make.put(
        cuboid(vec3(size.x + 0.08, size.y + 0.08, 0.03), 0.),
        &frame,
        place * at(0., -0.5 * size.y - 0.04, 0.015),
    );
    let mut glass = make.material(Purpose::Ceiling);
    (glass.mirror, glass.gloss) = (0.9, 0.);
    let sheet = Mesh::rectangle((-0.5 * size).extend(0.032), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), 0.5);
    make.put(sheet, &glass, place);
}

/// Adds curtains on both sides of a window of `size` whose centre is at the origin.
pub(super) fn curtains(make: &mut Maker, place: Affine3A, size: Vec2) {
    let cloth = make.material(Purpose::Thing);
    let (wide, folds) = (size.x * make.within(0.2..0.4), make.within(3. ..7.));
    let height = size.y + 0.3 + if make.chance(0.5) { make.within(0. ..0.6) } else { 0. };
    for x in [-0.5, 0.5] {
        let drape = curtain(wide, height, folds, 0.05);
        make.put(drape, &cloth, place * at(x * size.x, 0.5 * size.y + 0.1, 0.1));
    }
}

/// Adds a tree: a bent trunk, branches, and a crown of leaves or of green clouds.
pub(super) fn tree(make: &mut Maker, place: Affine3A, height: f32) {
    let bark = make.material(Purpose::Thing);
    let (bend_x, bend_z) = (make.within(-0.15..0.15) * height, make.within(-0.15..0.15) * height);
    let stem = move |t: f32| vec3(bend_x * t * t, height * t, bend_z * t * t);
    let thick = make.within(0.02..0.045) * height;
    make.put(tube(stem, move |t| thick * (1.1 - t), [8, 8]), &bark, place);
    let crown = make.material(Purpose::Foliage);
    let noise = make.noise();
    match make.within(0..3) {
        0 => {
            // A conifer: skirts above each other.
            let skirts = make.within(4..8);
            for i in 0..skirts {
                let share = i as f32 / skirts as f32;
                let (wide, y) = (0.28 * height * (1.05 - share), height * (0.15 + 0.8 * share));
                let skirt = lathe(&[vec2(wide, 0.), vec2(0.02, 0.3 * height)], 16);
                let rough = roughen(skirt, &noise, 6. / height, 0.03 * height);
                make.put(rough, &crown, place * at(0., y, 0.));
            }
        }
        1 => {
            for _ in 0..make.within(5..12) {
                let middle = stem(make.within(0.55..1.));
                let offset = make.direction() * make.within(0. ..0.2) * height;
                let size =
                    vec3(make.within(0.2..0.4), make.within(0.15..0.35), make.within(0.2..0.4)) * height;
                let cloud = roughen(superellipsoid(size, [1., 1.], 9), &noise, 7. / height, 0.06 * height);
                make.put(cloud, &crown, place * Affine3A::from_translation(middle + offset));
            }
        }
        _ => {
            for _ in 0..make.within(6..14) {
                let middle = stem(make.within(0.5..1.));
                let tip = middle + make.direction() * make.within(0.1..0.3) * height;
                let branch = move |t: f32| middle.lerp(tip, t);
                make.put(tube(branch, move |_| 0.25 * thick, [3, 5]), &bark, place);
                leaves(make, place * Affine3A::from_translation(tip), 0.18 * height, 10);
            }
        }
    }
}

/// Adds a bush or a tuft of grass.
pub(super) fn bush(make: &mut Maker, place: Affine3A) {
    let size = vec3(make.within(0.4..1.6), make.within(0.3..1.2), make.within(0.4..1.6));
    if make.chance(0.5) {
        leaves(make, place, size.y, 40);
        return;
    }
    let (crown, noise) = (make.material(Purpose::Foliage), make.noise());
    let ball = roughen(superellipsoid(size, [1., 1.], 12), &noise, 3.5, 0.18);
    make.put(ball, &crown, place * at(0., 0.4 * size.y, 0.));
}

/// Adds a rock.
pub(super) fn rock(make: &mut Maker, place: Affine3A, size: f32) {
    let (stone, noise) = (make.material(Purpose::Ground), make.noise());
    let size = size * vec3(make.within(0.6..1.4), make.within(0.4..1.), make.within(0.6..1.4));
    let ball = superellipsoid(size, [0.8, 0.8], 12);
    let rough = roughen(ball, &noise, 2. / size.max_element(), 0.25 * size.min_element());
    make.put(rough, &stone, place * at(0., 0.3 * size.y, 0.));
}

/// Adds a house: walls with windows and doors, under a roof.
pub(super) fn house(make: &mut Maker, place: Affine3A) {
    let size = vec3(make.within(4. ..10.), make.within(2.6..7.), make.within(4. ..9.));
    let (wall, roof) = (make.material(Purpose::Facade), make.material(Purpose::Facade));
    make.put(cuboid(size, 0.), &wall, place);
    let (over, rise) = (make.within(0.1..0.6), make.within(0. ..0.5) * size.x);
    let half = vec3(0.5 * size.x + over, 0., 0.5 * size.z + over);
    for side in [-1., 1.] {
        let eaves = vec3(side * half.x, size.y - 0.02, side * half.z);
        let sheet =
            Mesh::rectangle(eaves, vec3(0., 0., -2. * side * half.z), vec3(-side * half.x, rise, 0.), 2.);
        make.put(sheet, &roof, place);
        let gable = Mesh::grid(1, 1, vec2(size.x, rise), |u, v| {
            vec3(side * (u - 0.5) * size.x * (1. - v), size.y + rise * v, 0.5 * side * size.z)
        });
        make.put(gable, &wall, place);
    }
    let (glass, frame) = (window_glass(make), make.material(Purpose::Thing));
    let floors = (size.y / 2.6).floor().max(1.) as usize;
    for (turn, wide, deep) in
        [(0., size.x, size.z), (1., size.z, size.x), (2., size.x, size.z), (3., size.z, size.x)]
    {
        let count = (wide / make.within(1.6..3.)).floor().max(1.);
        for floor in 0..floors {
            for i in 0..count as usize {
                let x = ((i as f32 + 0.5) / count - 0.5) * wide;
                let is_door = floor == 0 && make.chance(0.15);
                let pane = if is_door { vec2(0.9, 2.) } else { vec2(1.1, 1.3) };
                let y = 2.6 * floor as f32 + if is_door { 0. } else { 0.8 };
                let spot = place * turned(turn * FRAC_PI_2) * at(x, y, 0.5 * deep);
                make.put(
                    cuboid(vec3(pane.x + 0.16, pane.y + 0.16, 0.06), 0.),
                    &frame,
                    spot * at(0., -0.08, 0.),
                );
                let inner = cuboid(vec3(pane.x, pane.y, 0.08), 0.);
                make.put(inner, if is_door { &wall } else { &glass }, spot);
            }
        }
    }
}

/// Returns the material of window panes seen from outside: dark and reflecting.
fn window_glass(make: &mut Maker) -> Material {
    let mut glass = make.material(Purpose::Ceiling);
    glass.tint = Vec3::splat(make.within(0.03..0.25));
    glass.mirror = make.within(0.05..0.3);
    glass
}

/// Adds a fence of boards and rails, `length` metres along x.
pub(super) fn fence(make: &mut Maker, place: Affine3A, length: f32) {
    let wood = make.material(Purpose::Thing);
    let (height, gap) = (make.within(0.7..1.8), make.within(0.08..0.5f32));
    let board = (0.5 * gap).min(0.12);
    for i in 0..(length / gap) as usize {
        make.put(
            cuboid(vec3(board, height, 0.03), 0.),
            &wood,
            place * at(i as f32 * gap - 0.5 * length, 0., 0.),
        );
    }
    for y in [0.3, 0.8] {
        make.put(cuboid(vec3(length, 0.08, 0.03), 0.), &wood, place * at(0., y * height, -0.03));
    }
}

/// Adds a single object, on the ground at `spot` or on a block there, to be viewed from all sides.
pub(super) fn exhibit(make: &mut Maker, spot: Vec3) -> Exhibit {
    let size = vec3(make.scaled(0.3, 1.5), make.scaled(0.3, 1.5), make.scaled(0.3, 1.5));
    let below = if make.chance(0.3) { 0. } else { make.within(0.2..1.1) };
    if below > 0. {
        // The block reaches below the ground, which may be uneven.
        let (foot, broad) = (0.5, make.within(0.6..1.6));
        let material = make.material(Purpose::Thing);
        let block = cuboid(vec3(broad * size.x, below + foot, broad * size.z), make.within(0. ..0.05));
        make.put(block, &material, Affine3A::from_translation(spot - foot * Vec3::Y));
    }
    let place = standing(spot + below * Vec3::Y, make.turn());
    to_be_looked_at(make, size, place);
    Exhibit { middle: spot + (below + 0.4 * size.y) * Vec3::Y, radius: 0.5 * size.length(), front: None }
}

/// Adds an object on a wall at `spot`, to be viewed from the direction `front`.
pub(super) fn hung(make: &mut Maker, spot: Vec3, front: Vec3) -> Exhibit {
    let size = vec3(make.scaled(0.3, 1.2), make.scaled(0.2, 1.), make.scaled(0.3, 1.2));
    // The object's up axis points away from the wall.
    let off_the_wall = Quat::from_rotation_arc(Vec3::Y, front) * Quat::from_rotation_y(make.turn());
    to_be_looked_at(make, size, Affine3A::from_rotation_translation(off_the_wall, spot));
    Exhibit { middle: spot + 0.4 * size.y * front, radius: 0.5 * size.length(), front: Some(front) }
}

/// Adds an object that merits its own video, about `size` metres large, standing at the origin of `place`.
fn to_be_looked_at(make: &mut Maker, size: Vec3, place: Affine3A) {
    match make.within(0..6) {
        0 => {
            let (mesh, material) = (plain(make, size), make.material(Purpose::Thing));
            make.put(mesh, &material, place);
        }
        1 => {
            let largest = size.max_element();
            rock(make, place, largest);
        }
        2 => plant(make, place),
        _ => {
            let count = make.within(3..12);
            heap(make, size, place, count);
        }
    }
}

/// Adds a random piece of furniture, for placement along a wall or in the open.
pub(super) fn furniture(make: &mut Maker, place: Affine3A) {
    match make.within(0..12) {
        0 | 1 => table(make, place),
        2 | 3 => cabinet(make, place),
        4 | 5 => chair(make, place),
        6 => sofa(make, place),
        7 => bed(make, place),
        8 => {
            let height = make.within(1.1..1.8);
            lamp(make, place, height);
        }
        9 => plant(make, place),
        10 => {
            let size = vec3(make.scaled(0.3, 1.5), make.scaled(0.3, 1.5), make.scaled(0.3, 1.5));
            let (mesh, material) = (plain(make, size), make.material(Purpose::Thing));
            make.put(mesh, &material, place);
        }
        _ => {
            let size = vec3(make.within(0.4..1.4), make.within(0.4..1.4), make.within(0.4..1.4));
            let count = make.within(3..9);
            heap(make, size, place, count);
        }
    }
}
