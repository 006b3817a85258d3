//! Rooms: floor, ceiling, walls with openings, and furnishings.

use super::light::{Lamp, Sky};
use super::maker::{Maker, standing};
use super::material::Material;
use super::mesh::Mesh;
use super::open::outside;
use super::shapes::{cone, cuboid, superellipsoid};
use super::texture::Purpose;
use super::things;
use super::walk::Place;
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
    fn place(&self) -> Affine3A {
        let into = self.along.cross(Vec3::Y);
        let rotation = Mat3::from_cols(self.along, Vec3::Y, into);
        Affine3A::from_mat3_translation(rotation, self.corner)
    }

    fn is_free(&self, from: f32, to: f32) -> bool {
        self.openings.iter().all(|opening| to < opening.from.x - 0.1 || from > opening.to.x + 0.1)
    }
}

/// Builds a furnished room. Returns the space where cameras may be.
pub(super) fn room(make: &mut Maker, sky: &mut Sky) -> Place {
    let size = vec3(make.scaled(2.6, 9.), make.within(2.3..3.6), make.scaled(2.6, 9.));
    let (wall, floor, ceiling) =
        (make.material(Purpose::Wall), make.material(Purpose::Floor), make.material(Purpose::Ceiling));
    let accent = if make.chance(0.35) { make.material(Purpose::Wall) } else { wall.clone() };
    let corners = [vec3(0., 0., size.z), vec3(0., 0., 0.), vec3(size.x, 0., 0.), size.with_y(0.)];
    let mut walls = vec![];
    for i in 0..4 {
        let side = corners[(i + 1) % 4] - corners[i];
        let length = side.length();
        let mut wall = Wall { corner: corners[i], along: side / length, length, openings: vec![] };
        open_up(make, &mut wall, size.y);
        walls.push(wall);
    }
    for (i, one) in walls.iter().enumerate() {
        build(make, one, size.y, if i == 0 { &accent } else { &wall });
    }
    let (x, z) = (Vec3::X * size.x, Vec3::Z * size.z);
    make.put(Mesh::rectangle(z, x, -z, CELL), &floor, Affine3A::IDENTITY);
    make.put(Mesh::rectangle(Vec3::Y * size.y, x, z, 2. * CELL), &ceiling, Affine3A::IDENTITY);
    if make.chance(0.3) {
        beams(make, size);
    }

    let has_openings = walls.iter().any(|wall| !wall.openings.is_empty());
    if has_openings {
        outside(make, size);
    }
    furnish(make, size, &walls);
    light(make, size, sky, has_openings);
    let behind = 0.25;
    Place {
        least: vec3(behind, 0.5, behind),
        most: size - behind,
        eye: (1., 1.75),
        roomy: 0.3,
        walls: Some(behind),
    }
}

/// Adds windows and doors to the wall.
fn open_up(make: &mut Maker, wall: &mut Wall, height: f32) {
    for _ in 0..make.one_of(&[0, 0, 1, 1, 2, 3]) {
        let is_door = make.chance(0.3);
        let wide = if is_door { make.within(0.8..1.8) } else { make.within(0.6..2.2) };
        if wide + 0.4 > wall.length {
            continue;
        }
        let from = make.within(0.2..wall.length - wide - 0.2 + 1e-3);
        if !wall.is_free(from, from + wide) {
            continue;
        }
        let (low, high) = match is_door {
            true => (0., make.within(1.95..(height - 0.1).min(2.4))),
            false => (make.within(0.1..1.1), make.within(1.8..height - 0.1)),
        };
        wall.openings.push(Opening { from: vec2(from, low), to: vec2(from + wide, high), is_door });
    }
    wall.openings.sort_by(|a, b| a.from.x.total_cmp(&b.from.x));
}

/// Builds the wall around its openings, their reveals and frames, and a skirting board.
fn build(make: &mut Maker, wall: &Wall, height: f32, material: &Material) {
    let place = wall.place();
    let panel = |make: &mut Maker, from: Vec2, to: Vec2| {
        let size = to - from;
        if size.min_element() < 1e-3 {
            return;
        }
        let mut mesh = Mesh::rectangle(from.extend(0.), vec3(size.x, 0., 0.), vec3(0., size.y, 0.), CELL);
        mesh.uvs.iter_mut().for_each(|uv| *uv += from);
        make.put(mesh, material, place);
    };
    let mut reached = 0.;
    for &Opening { from, to, .. } in &wall.openings {
        panel(make, vec2(reached, 0.), vec2(from.x, height));
        panel(make, vec2(from.x, 0.), vec2(to.x, from.y));
        panel(make, vec2(from.x, to.y), vec2(to.x, height));
        reached = to.x;
    }
    panel(make, vec2(reached, 0.), vec2(wall.length, height));

    let frame = make.material(Purpose::Ceiling);
    let deep = make.within(0.08..0.3);
    for &Opening { from, to, is_door } in &wall.openings {
        let size = to - from;
        let (right, up, back) = (vec3(size.x, 0., 0.), vec3(0., size.y, 0.), vec3(0., 0., -deep));
        let corner = from.extend(0.);
        for (corner, along, up) in [
            (corner, back, up),
            (corner + right, up, back),
            (corner, right, back),
            (corner + up, back, right),
        ] {
            make.put(Mesh::rectangle(corner, along, up, 0.5), &frame, place);
        }
        let edge = 0.06;
        for (at, size) in [
            (from - edge, vec2(edge, size.y + 2. * edge)),
            (vec2(to.x, from.y - edge), vec2(edge, size.y + 2. * edge)),
            (vec2(from.x, to.y), vec2(size.x, edge)),
        ] {
            let bar = cuboid(vec3(size.x, size.y, 0.03), 0.);
            let spot = Affine3A::from_translation((at + vec2(0.5 * size.x, 0.)).extend(0.));
            make.put(bar, &frame, place * spot);
        }
        if is_door {
            if make.chance(0.4) {
                // The leaf of the door, opened by a random angle.
                let leaf = cuboid(vec3(size.x, size.y, 0.04), 0.);
                let wood = make.material(Purpose::Thing);
                let hinge = Affine3A::from_translation(vec3(from.x, 0., 0.))
                    * Affine3A::from_rotation_y(-make.within(0. ..1.8))
                    * Affine3A::from_translation(vec3(0.5 * size.x, 0., 0.));
                make.put(leaf, &wood, place * hinge);
            }
            continue;
        }
        // Glazing bars between the panes.
        let (columns, rows) = (make.within(1..4), make.within(1..4));
        for i in 1..columns {
            let bar = cuboid(vec3(0.04, size.y, 0.04), 0.);
            let x = from.x + size.x * i as f32 / columns as f32;
            make.put(bar, &frame, place * Affine3A::from_translation(vec3(x, from.y, -0.7 * deep)));
        }
        for i in 1..rows {
            let bar = cuboid(vec3(size.x, 0.04, 0.04), 0.);
            let y = from.y + size.y * i as f32 / rows as f32;
            let spot = vec3(from.x + 0.5 * size.x, y - 0.02, -0.7 * deep);
            make.put(bar, &frame, place * Affine3A::from_translation(spot));
        }
        let middle = Affine3A::from_translation((0.5 * (from + to)).extend(0.02));
        if make.chance(0.4) {
            things::curtains(make, place * middle, size);
        }
    }
    let (tall, wood) = (make.within(0.05..0.15), frame);
    let mut reached = 0.;
    let doors = wall.openings.iter().filter(|opening| opening.is_door).map(|door| (door.from.x, door.to.x));
    for (from, to) in doors.chain([(wall.length, wall.length)]) {
        if from - reached > 0.1 {
            let board = cuboid(vec3(from - reached, tall, 0.02), 0.);
            let spot = vec3(0.5 * (from + reached), 0., 0.01);
            make.put(board, &wood, place * Affine3A::from_translation(spot));
        }
        reached = to;
    }
}

/// Adds beams under the ceiling, or columns.
fn beams(make: &mut Maker, size: Vec3) {
    let wood = make.material(Purpose::Thing);
    let thick = make.within(0.08..0.3);
    let count = make.within(1..6);
    let are_columns = make.chance(0.25);
    for i in 0..count {
        let x = size.x * (i as f32 + 0.5) / count as f32;
        if are_columns {
            let z = size.z * make.one_of(&[0.1, 0.3, 0.7, 0.9]);
            make.put(
                cone(0.6 * thick, 0.6 * thick, size.y, 16),
                &wood,
                Affine3A::from_translation(vec3(x, 0., z)),
            );
        } else {
            let beam = cuboid(vec3(thick, thick, size.z), 0.);
            make.put(beam, &wood, Affine3A::from_translation(vec3(x, size.y - thick, 0.5 * size.z)));
        }
    }
}

fn furnish(make: &mut Maker, size: Vec3, walls: &[Wall]) {
    // A carpet.
    if make.chance(0.5) {
        let wide = vec2(make.within(0.3..0.8) * size.x, make.within(0.3..0.8) * size.z);
        let cloth = make.picture(wide);
        let mesh = Mesh::rectangle(
            vec3(-0.5 * wide.x, 0., 0.5 * wide.y),
            vec3(wide.x, 0., 0.),
            vec3(0., 0., -wide.y),
            CELL,
        );
        let spot = vec3(0.5 * size.x, 0.012, 0.5 * size.z);
        let turn = if make.chance(0.7) { 0. } else { make.within(-0.5..0.5) };
        make.put(mesh, &cloth, standing(spot, turn));
    }
    for wall in walls {
        let place = wall.place();
        // Furniture along the wall, with its back to it.
        let mut reached = make.within(0.3..1.2);
        while reached < wall.length - 0.6 {
            let spot = vec3(reached, 0., 0.5);
            let blocks_door =
                wall.openings.iter().any(|o| o.is_door && reached > o.from.x - 0.8 && reached < o.to.x + 0.8);
            if !blocks_door && make.chance(0.7) {
                let turn = if make.chance(0.85) { 0. } else { make.turn() };
                things::furniture(make, place * standing(spot, turn));
            }
            reached += make.within(0.9..2.4);
        }
        // Pictures and mirrors on the wall.
        let mut reached = make.within(0.4..1.4);
        while reached < wall.length - 0.4 {
            if wall.is_free(reached - 0.4, reached + 0.4) && make.chance(0.6) {
                let spot = Affine3A::from_translation(vec3(reached, make.within(1.2..1.9), 0.));
                match make.chance(0.08) {
                    true => things::mirror(make, place * spot),
                    false => things::picture(make, place * spot),
                }
            }
            reached += make.within(0.7..2.2);
        }
    }
    // Furniture in the middle of the room.
    let area = size.x * size.z;
    for _ in 0..make.within(0..=(0.12 * area) as usize + 1) {
        let spot = vec3(make.within(0.25..0.75) * size.x, 0., make.within(0.25..0.75) * size.z);
        let turn = if make.chance(0.5) { FRAC_PI_2 * make.within(0..4) as f32 } else { make.turn() };
        things::furniture(make, standing(spot, turn));
    }
    let floor = Affine3A::from_translation(vec3(0.5 * size.x, 0., 0.5 * size.z));
    things::clutter(make, 0.9 * vec2(size.x, size.z), floor, 8);
}

/// Adds ceiling and hanging lamps of one colour tone, and the sun if it can shine in.
fn light(make: &mut Maker, size: Vec3, sky: &mut Sky, has_openings: bool) {
    let warmth = make.within(0. ..1.);
    let tone = vec3(1., 1. - 0.25 * warmth, 1. - 0.55 * warmth);
    let count = if has_openings { make.within(0..4) } else { make.within(1..4) };
    let strength = make.within(3. ..9.) * (size.x * size.z / 16.).max(0.5) / count.max(1) as f32;
    for i in 0..count {
        let x = size.x * (i as f32 + make.within(0.3..0.7)) / count as f32;
        let at = vec3(x, size.y - 0.02, size.z * make.within(0.25..0.75));
        if make.chance(0.5) {
            let half = vec2(make.within(0.1..0.6), make.within(0.1..0.4));
            let (right, up) = (half.x * Vec3::X, half.y * Vec3::Z);
            let colour = strength * tone;
            make.parts.lamps.push(Lamp::Panel {
                at: at - 0.05 * Vec3::Y,
                right,
                up,
                facing: Vec3::NEG_Y,
                colour,
            });
            let mut glass = make.material(Purpose::Ceiling);
            glass.glow = 3.;
            let panel = cuboid(vec3(2. * half.x, 0.03, 2. * half.y), 0.);
            make.put(panel, &glass, Affine3A::from_translation(at - 0.03 * Vec3::Y));
        } else {
            let below = make.within(0.2..(0.35 * size.y));
            let (radius, at) = (make.within(0.05..0.2), at - below * Vec3::Y);
            let mut glass = make.material(Purpose::Ceiling);
            glass.glow = 3.;
            let ball = superellipsoid(Vec3::splat(2. * radius), [1., 1.], 8);
            make.put(ball, &glass, Affine3A::from_translation(at));
            let cord = make.material(Purpose::Thing);
            make.put(
                cone(0.006, 0.006, below - radius, 5),
                &cord,
                Affine3A::from_translation(at + radius * Vec3::Y),
            );
            make.parts.lamps.push(Lamp::Ball { at, radius, colour: 0.8 * strength * tone });
        }
    }
    if has_openings && make.chance(0.7) {
        let (turn, height) = (make.turn(), make.within(0.2..1.));
        let towards = vec3(turn.cos(), height, turn.sin()).normalize();
        make.parts.lamps.push(Lamp::Sun { towards, spread: 0.02, colour: 8. * vec3(1., 0.93, 0.82) });
    }
    if has_openings {
        // The outdoors is brighter than rooms in daytime.
        let brighter = make.within(1. ..2.5);
        (sky.zenith, sky.horizon, sky.ground) =
            (brighter * sky.zenith, brighter * sky.horizon, brighter * sky.ground);
    } else {
        // Approximates the light of a closed room's lamps after more than one bounce.
        let rest = make.within(0.1..0.5) * tone;
        (sky.zenith, sky.horizon, sky.ground) = (rest, rest, rest);
    }
}

/// Builds a closed box full of plain shapes in mid-air and on the floor, with random textures. It contains no recognizable objects,
/// and everything in it may be visible.
pub(super) fn box_of_shapes(make: &mut Maker, sky: &mut Sky) -> Place {
    let size = vec3(make.scaled(3., 10.), make.within(2.4..5.), make.scaled(3., 10.));
    let purposes = [Purpose::Wall, Purpose::Floor, Purpose::Thing, Purpose::Ground];
    let (x, y, z) = (Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z);
    for (corner, along, up) in
        [(z, x, -z), (y, x, z), (z, -z, y), (Vec3::ZERO, x, y), (x, z, y), (x + z, -x, y)]
    {
        let purpose = make.one_of(&purposes);
        let material = make.material(purpose);
        make.put(Mesh::rectangle(corner, along, up, CELL), &material, Affine3A::IDENTITY);
    }
    for _ in 0..make.within(12..45) {
        let part = vec3(make.scaled(0.15, 2.), make.scaled(0.15, 2.), make.scaled(0.15, 2.));
        let mesh = things::plain(make, part);
        let material = make.material(Purpose::Thing);
        let mut spot = size * vec3(make.within(0. ..1.), make.within(0. ..1.), make.within(0. ..1.));
        let mut turn = Quat::from_axis_angle(make.direction(), make.turn());
        if make.chance(0.6) {
            (spot.y, turn) = (0., Quat::from_rotation_y(make.turn()));
        }
        make.put(mesh, &material, Affine3A::from_rotation_translation(turn, spot));
    }
    light(make, size, sky, false);
    let behind = 0.3;
    let eye = (0.6, size.y - 0.4);
    Place { least: Vec3::splat(behind), most: size - behind, eye, roomy: 0.3, walls: Some(behind) }
}
