//! Rooms: floor, ceiling, walls with openings, and furnishings.

use super::light::{LightSource, Material, Sky};
use super::mesh::{Mesh, cone, superellipsoid};
use super::objects;
use super::outdoors::outside;
use super::scene_builder::{SceneBuilder, at, standing};
use super::texture::Purpose;
use super::walk::CameraSpace;
use glam::{Affine3A, Mat3, Quat, Vec2, Vec3, vec2, vec3};
use std::f32::consts::FRAC_PI_2;

/// Maximum side of a wall's triangles in metres. Indirect light is computed at their corners.
const CELL: f32 = 0.35;

/// A hole in a wall, in metres along the wall and up.
#[derive(Clone, Copy)]
struct Opening {
    from: Vec2,
    to: Vec2,
    is_door: bool,
}

/// A wall seen from the room. It begins at `corner`, and its inside is to the left of `along` when seen from above.
struct Wall {
    corner: Vec3,
    along: Vec3,
    length: f32,
    openings: Vec<Opening>,
}

impl Wall {
    /// Returns the transform from wall coordinates (along, up, into the room) to room coordinates.
    fn transform(&self) -> Affine3A {
        let into = self.along.cross(Vec3::Y);
        let rotation = Mat3::from_cols(self.along, Vec3::Y, into);
        Affine3A::from_mat3_translation(rotation, self.corner)
    }

    fn is_free(&self, from: f32, to: f32) -> bool {
        self.openings.iter().all(|opening| to < opening.from.x - 0.1 || from > opening.to.x + 0.1)
    }
}

/// Builds a furnished room. Returns the space where cameras may be.
pub(super) fn room(builder: &SceneBuilder, sky: &mut Sky) -> CameraSpace {
    let size = vec3(builder.log_uniform(2.6, 9.), builder.within(2.3..3.6), builder.log_uniform(2.6, 9.));
    let (wall, floor, ceiling) = (
        builder.material(Purpose::Wall),
        builder.material(Purpose::Floor),
        builder.material(Purpose::Ceiling),
    );
    let accent = if builder.chance(0.35) { builder.material(Purpose::Wall) } else { wall.clone() };
    let corners = [vec3(0., 0., size.z), vec3(0., 0., 0.), vec3(size.x, 0., 0.), size.with_y(0.)];
    let walls = [0, 1, 2, 3].map(|i| {
        let side = corners[(i + 1) % 4] - corners[i];
        let length = side.length();
        let mut wall = Wall { corner: corners[i], along: side / length, length, openings: vec![] };
        add_openings(builder, &mut wall, size.y);
        wall
    });
    for (i, one) in walls.iter().enumerate() {
        build_wall(builder, one, size.y, if i == 0 { &accent } else { &wall });
    }
    let (x, z) = (Vec3::X * size.x, Vec3::Z * size.z);
    builder.add_mesh(Mesh::rectangle(z, x, -z, CELL), &floor, Affine3A::IDENTITY);
    builder.add_mesh(Mesh::rectangle(Vec3::Y * size.y, x, z, 2. * CELL), &ceiling, Affine3A::IDENTITY);
    if builder.chance(0.3) {
        beams(builder, size);
    }

    let has_openings = walls.iter().any(|wall| !wall.openings.is_empty());
    if has_openings {
        outside(builder, size);
    }
    furnish(builder, size, &walls);
    light(builder, size, sky, has_openings);
    let behind = 0.25;
    let (min, max) = (vec3(behind, 0.5, behind), size - behind);
    CameraSpace { min, max, eye_heights: (1., 1.75), clearance: 0.3, walls: Some(behind) }
}

/// Adds windows and doors to the wall.
fn add_openings(builder: &SceneBuilder, wall: &mut Wall, height: f32) {
    for _ in 0..builder.one_of(&[0, 0, 1, 1, 2, 3]) {
        let is_door = builder.chance(0.3);
        let wide = if is_door { builder.within(0.8..1.8) } else { builder.within(0.6..2.2) };
        if wide + 0.4 > wall.length {
            continue;
        }
        let from = builder.within(0.2..wall.length - wide - 0.2 + 1e-3);
        if !wall.is_free(from, from + wide) {
            continue;
        }
        let (low, high) = match is_door {
            true => (0., builder.within(1.95..(height - 0.1).min(2.4))),
            false => (builder.within(0.1..1.1), builder.within(1.8..height - 0.1)),
        };
        wall.openings.push(Opening { from: vec2(from, low), to: vec2(from + wide, high), is_door });
    }
    wall.openings.sort_by(|a, b| a.from.x.total_cmp(&b.from.x));
}

/// Builds the wall around its openings, their reveals and frames, and a skirting board.
fn build_wall(builder: &SceneBuilder, wall: &Wall, height: f32, material: &Material) {
    let transform = wall.transform();
    let panel = |from: Vec2, to: Vec2| {
        let size = to - from;
        if size.min_element() < 1e-3 {
            return;
        }
        let mut mesh = Mesh::rectangle(from.extend(0.), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), CELL);
        mesh.uvs.iter_mut().for_each(|uv| *uv += from);
        builder.add_mesh(mesh, material, transform);
    };
    let mut reached = 0.;
    for &Opening { from, to, .. } in &wall.openings {
        panel(vec2(reached, 0.), vec2(from.x, height));
        panel(vec2(from.x, 0.), vec2(to.x, from.y));
        panel(vec2(from.x, to.y), vec2(to.x, height));
        reached = to.x;
    }
    panel(vec2(reached, 0.), vec2(wall.length, height));

    let frame = builder.material(Purpose::Ceiling);
    let deep = builder.within(0.08..0.3);
    for &Opening { from, to, is_door } in &wall.openings {
        let size = to - from;
        let (right, up, back) = (vec3(size.x, 0., 0.), vec3(0., size.y, 0.), vec3(0., 0., -deep));
        let corner = from.extend(0.);
        let reveals = [
            (corner, back, up),
            (corner + right, up, back),
            (corner, right, back),
            (corner + up, back, right),
        ];
        for (corner, along, up) in reveals {
            builder.add_mesh(Mesh::rectangle(corner, along, up, 0.5), &frame, transform);
        }
        let edge = 0.06;
        for (at, size) in [
            (from - edge, vec2(edge, size.y + 2. * edge)),
            (vec2(to.x, from.y - edge), vec2(edge, size.y + 2. * edge)),
            (vec2(from.x, to.y), vec2(size.x, edge)),
        ] {
            let spot = Affine3A::from_translation((at + vec2(0.5 * size.x, 0.)).extend(0.));
            builder.add_box(vec3(size.x, size.y, 0.03), &frame, transform * spot);
        }
        if is_door {
            if builder.chance(0.4) {
                // The leaf of the door, opened by a random angle.
                let wood = builder.thing();
                let hinge = at(from.x, 0., 0.)
                    * Affine3A::from_rotation_y(-builder.within(0. ..1.8))
                    * at(0.5 * size.x, 0., 0.);
                builder.add_box(vec3(size.x, size.y, 0.04), &wood, transform * hinge);
            }
            continue;
        }
        // Glazing bars between the panes.
        let (columns, rows) = (builder.within(1..4), builder.within(1..4));
        for i in 1..columns {
            let x = from.x + size.x * i as f32 / columns as f32;
            builder.add_box(vec3(0.04, size.y, 0.04), &frame, transform * at(x, from.y, -0.7 * deep));
        }
        for i in 1..rows {
            let y = from.y + size.y * i as f32 / rows as f32;
            let spot = transform * at(from.x + 0.5 * size.x, y - 0.02, -0.7 * deep);
            builder.add_box(vec3(size.x, 0.04, 0.04), &frame, spot);
        }
        let middle = Affine3A::from_translation((0.5 * (from + to)).extend(0.02));
        if builder.chance(0.4) {
            objects::curtains(builder, transform * middle, size);
        }
    }
    let (tall, wood) = (builder.within(0.05..0.15), frame);
    let mut reached = 0.;
    let doors = wall.openings.iter().filter(|opening| opening.is_door).map(|door| (door.from.x, door.to.x));
    for (from, to) in doors.chain([(wall.length, wall.length)]) {
        if from - reached > 0.1 {
            let spot = transform * at(0.5 * (from + reached), 0., 0.01);
            builder.add_box(vec3(from - reached, tall, 0.02), &wood, spot);
        }
        reached = to;
    }
}

/// Adds beams under the ceiling, or columns.
fn beams(builder: &SceneBuilder, size: Vec3) {
    let wood = builder.thing();
    let thick = builder.within(0.08..0.3);
    let count = builder.within(1..6);
    let are_columns = builder.chance(0.25);
    for i in 0..count {
        let x = size.x * (i as f32 + 0.5) / count as f32;
        if are_columns {
            let z = size.z * builder.one_of(&[0.1, 0.3, 0.7, 0.9]);
            builder.add_mesh(cone(0.6 * thick, 0.6 * thick, size.y, 16), &wood, at(x, 0., z));
        } else {
            builder.add_box(vec3(thick, thick, size.z), &wood, at(x, size.y - thick, 0.5 * size.z));
        }
    }
}

fn furnish(builder: &SceneBuilder, size: Vec3, walls: &[Wall]) {
    // A carpet.
    if builder.chance(0.5) {
        let wide = vec2(builder.within(0.3..0.8) * size.x, builder.within(0.3..0.8) * size.z);
        let cloth = builder.picture(wide);
        let corner = vec3(-0.5 * wide.x, 0., 0.5 * wide.y);
        let mesh = Mesh::rectangle(corner, Vec3::X * wide.x, Vec3::NEG_Z * wide.y, CELL);
        let spot = vec3(0.5 * size.x, 0.012, 0.5 * size.z);
        let turn = if builder.chance(0.7) { 0. } else { builder.within(-0.5..0.5) };
        builder.add_mesh(mesh, &cloth, standing(spot, turn));
    }
    for wall in walls {
        let transform = wall.transform();
        // Furniture along the wall, with its back to it.
        let mut reached = builder.within(0.3..1.2);
        while reached < wall.length - 0.6 {
            let spot = vec3(reached, 0., 0.5);
            let blocks_door =
                wall.openings.iter().any(|o| o.is_door && reached > o.from.x - 0.8 && reached < o.to.x + 0.8);
            if !blocks_door && builder.chance(0.7) {
                let turn = if builder.chance(0.85) { 0. } else { builder.angle() };
                objects::furniture(builder, transform * standing(spot, turn));
            }
            reached += builder.within(0.9..2.4);
        }
        // Pictures and mirrors on the wall.
        let mut reached = builder.within(0.4..1.4);
        while reached < wall.length - 0.4 {
            if wall.is_free(reached - 0.4, reached + 0.4) && builder.chance(0.6) {
                let spot = at(reached, builder.within(1.2..1.9), 0.);
                match builder.chance(0.08) {
                    true => objects::mirror(builder, transform * spot),
                    false => objects::picture(builder, transform * spot),
                }
            }
            reached += builder.within(0.7..2.2);
        }
    }
    // Furniture in the middle of the room.
    let area = size.x * size.z;
    for _ in 0..builder.within(0..=(0.12 * area) as usize + 1) {
        let spot = vec3(builder.within(0.25..0.75) * size.x, 0., builder.within(0.25..0.75) * size.z);
        let turn =
            if builder.chance(0.5) { FRAC_PI_2 * builder.within(0..4) as f32 } else { builder.angle() };
        objects::furniture(builder, standing(spot, turn));
    }
    let floor = at(0.5 * size.x, 0., 0.5 * size.z);
    objects::clutter(builder, 0.9 * vec2(size.x, size.z), floor, 8);
}

/// Adds ceiling and hanging lamps of one color tone, and the sun if it can shine in.
fn light(builder: &SceneBuilder, size: Vec3, sky: &mut Sky, has_openings: bool) {
    let warmth = builder.within(0. ..1.);
    let tone = vec3(1., 1. - 0.25 * warmth, 1. - 0.55 * warmth);
    let count = if has_openings { builder.within(0..4) } else { builder.within(1..4) };
    let strength = builder.within(3. ..9.) * (size.x * size.z / 16.).max(0.5) / count.max(1) as f32;
    for i in 0..count {
        let x = size.x * (i as f32 + builder.within(0.3..0.7)) / count as f32;
        let at = vec3(x, size.y - 0.02, size.z * builder.within(0.25..0.75));
        if builder.chance(0.5) {
            let half = vec2(builder.within(0.1..0.6), builder.within(0.1..0.4));
            let (right, up) = (half.x * Vec3::X, half.y * Vec3::Z);
            let source = LightSource::Panel { center: at - 0.05 * Vec3::Y, right, up, facing: Vec3::NEG_Y };
            builder.add_light(strength * tone, source);
            let below = Affine3A::from_translation(at - 0.03 * Vec3::Y);
            builder.add_box(vec3(2. * half.x, 0.03, 2. * half.y), &lamp_glass(builder), below);
        } else {
            let below = builder.within(0.2..(0.35 * size.y));
            let (radius, at) = (builder.within(0.05..0.2), at - below * Vec3::Y);
            let ball = superellipsoid(Vec3::splat(2. * radius), [1., 1.], 8);
            builder.add_mesh(ball, &lamp_glass(builder), Affine3A::from_translation(at));
            let top = Affine3A::from_translation(at + radius * Vec3::Y);
            builder.add_mesh(cone(0.006, 0.006, below - radius, 5), &builder.thing(), top);
            builder.add_light(0.8 * strength * tone, LightSource::Ball { center: at, radius });
        }
    }
    if has_openings && builder.chance(0.7) {
        let (turn, height) = (builder.angle(), builder.within(0.2..1.));
        let towards = vec3(turn.cos(), height, turn.sin()).normalize();
        builder.add_light(8. * vec3(1., 0.93, 0.82), LightSource::Sun { towards, spread: 0.02 });
    }
    if has_openings {
        // The outdoors is brighter than rooms in daytime.
        let brighter = builder.within(1. ..2.5);
        for color in [&mut sky.zenith, &mut sky.horizon, &mut sky.ground] {
            *color *= brighter;
        }
    } else {
        // Approximates the light of a closed room's lamps after more than one bounce.
        let rest = builder.within(0.1..0.5) * tone;
        (sky.zenith, sky.horizon, sky.ground) = (rest, rest, rest);
    }
}

/// Returns the material of lamps that are on.
fn lamp_glass(builder: &SceneBuilder) -> Material {
    Material { emission: 3., ..builder.material(Purpose::Ceiling) }
}

/// Builds a closed box full of plain shapes in mid-air and on the floor, with random textures. It contains no recognizable objects,
/// and everything in it may be visible.
pub(super) fn box_of_shapes(builder: &SceneBuilder, sky: &mut Sky) -> CameraSpace {
    let size = vec3(builder.log_uniform(3., 10.), builder.within(2.4..5.), builder.log_uniform(3., 10.));
    let purposes = [Purpose::Wall, Purpose::Floor, Purpose::Thing, Purpose::Ground];
    let (x, y, z) = (Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z);
    for (corner, along, up) in
        [(z, x, -z), (y, x, z), (z, -z, y), (Vec3::ZERO, x, y), (x, z, y), (x + z, -x, y)]
    {
        let material = builder.material(builder.one_of(&purposes));
        builder.add_mesh(Mesh::rectangle(corner, along, up, CELL), &material, Affine3A::IDENTITY);
    }
    for _ in 0..builder.within(12..45) {
        let mesh = objects::plain(builder, builder.log_vector([(0.15, 2.); 3]));
        let material = builder.thing();
        let mut spot = size * builder.vector([(0., 1.); 3]);
        let mut turn = Quat::from_axis_angle(builder.direction(), builder.angle());
        if builder.chance(0.6) {
            (spot.y, turn) = (0., Quat::from_rotation_y(builder.angle()));
        }
        builder.add_mesh(mesh, &material, Affine3A::from_rotation_translation(turn, spot));
    }
    light(builder, size, sky, false);
    let behind = 0.3;
    let (min, max, eye_heights) = (Vec3::splat(behind), size - behind, (0.6, size.y - 0.4));
    CameraSpace { min, max, eye_heights, clearance: 0.3, walls: Some(behind) }
}
