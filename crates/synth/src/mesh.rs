//! Triangle meshes with texture coordinates, the plain shapes that all objects are made of, and their deformations. The y axis points up.
//! Each shape is centered or stands on y = 0, as documented.

use super::noise::Noise;
use glam::{Affine3A, Vec2, Vec3};
use std::f32::consts::{PI, TAU};

/// A triangle mesh of one or more surfaces. Lengths are in metres.
#[derive(Debug, Clone, Default)]
pub(super) struct Mesh {
    pub positions: Vec<Vec3>,
    /// Texture coordinates of the vertices, in metres along the surface.
    pub uvs: Vec<Vec2>,
    /// Vertex indices of each triangle, counter-clockwise when seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Creates a grid of `columns` × `rows` cells on the parametric surface `surface(u, v)`, with u and v in [0, 1]. `size` is the
    /// width and height of its texture in metres. The outside is in the direction of ∂surface/∂u × ∂surface/∂v.
    pub fn grid(columns: usize, rows: usize, size: Vec2, surface: impl Fn(f32, f32) -> Vec3) -> Mesh {
        let mut mesh = Mesh::default();
        for row in 0..=rows {
            for column in 0..=columns {
                let uv = Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32);
                mesh.positions.push(surface(uv.x, uv.y));
                mesh.uvs.push(uv * size);
            }
        }
        let vertex = |column: usize, row: usize| (row * (columns + 1) + column) as u32;
        for row in 0..rows {
            for column in 0..columns {
                let [a, b] = [vertex(column, row), vertex(column + 1, row)];
                let [c, d] = [vertex(column, row + 1), vertex(column + 1, row + 1)];
                mesh.triangles.extend([[a, b, d], [a, d, c]]);
            }
        }
        mesh
    }

    /// Creates the rectangle that has a corner at `corner` and the sides `along` and `up`. Its cells are at most `cell` metres wide
    /// and high, unless that takes more than 64 cells per side. The outside is in the direction of `along` × `up`.
    pub fn rectangle(corner: Vec3, along: Vec3, up: Vec3, cell: f32) -> Mesh {
        let size = Vec2::new(along.length(), up.length());
        let cells = (size / cell).ceil().clamp(Vec2::ONE, Vec2::splat(64.));
        Mesh::grid(cells.x as usize, cells.y as usize, size, |u, v| corner + u * along + v * up)
    }

    /// Appends the vertices and triangles of `other`.
    pub fn join(&mut self, other: Mesh) {
        let first = self.positions.len() as u32;
        self.positions.extend(other.positions);
        self.uvs.extend(other.uvs);
        self.triangles.extend(other.triangles.iter().map(|corners| corners.map(|vertex| first + vertex)));
    }

    /// Returns the mesh transformed by `transform`. The texture coordinates don't change.
    pub fn moved(self, transform: Affine3A) -> Mesh {
        self.warped(|position| transform.transform_point3(position))
    }

    /// Returns the mesh with every vertex position mapped by `map`. The texture coordinates don't change.
    pub fn warped(mut self, map: impl Fn(Vec3) -> Vec3) -> Mesh {
        self.positions.iter_mut().for_each(|position| *position = map(*position));
        self
    }

    /// Returns the bounding box: its minimum and maximum corners.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.positions.iter().fold(empty, |(low, high), &p| (low.min(p), high.max(p)))
    }

    /// Returns one point per vertex: the vertex, moved a fifth of the way to the mean of its triangles' centers. Unlike the vertices
    /// themselves, these points don't lie on an edge where another surface begins.
    pub fn inset_vertices(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.); self.positions.len()];
        for corners in &self.triangles {
            let center = corners.map(|vertex| self.positions[vertex as usize]).iter().sum::<Vec3>() / 3.;
            for &vertex in corners {
                let (sum, count) = &mut sums[vertex as usize];
                (*sum, *count) = (*sum + center, *count + 1.);
            }
        }
        let inside =
            |(&vertex, &(sum, count)): (&Vec3, &(Vec3, f32))| vertex.lerp(sum / f32::max(count, 1.), 0.2);
        self.positions.iter().zip(&sums).map(inside).collect()
    }

    /// Returns a unit normal per vertex: the area-weighted mean of its triangles' normals. Shading is smooth within a grid and has
    /// sharp edges between joined grids, because those don't share vertices.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions.len()];
        for corners in &self.triangles {
            let [a, b, c] = corners.map(|vertex| self.positions[vertex as usize]);
            let normal = (b - a).cross(c - a);
            corners.iter().for_each(|&vertex| normals[vertex as usize] += normal);
        }
        normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
    }
}

/// Creates a box of `size`, standing on y = 0, with edges rounded by `round` metres.
pub(super) fn cuboid(size: Vec3, round: f32) -> Mesh {
    let half = size / 2.;
    let round = round.min(half.min_element());
    let cells = if round > 0. { 7 } else { 2 };
    let mut mesh = Mesh::default();
    for axis in 0..3 {
        for sign in [-1., 1.] {
            let mut normal = Vec3::ZERO;
            normal[axis] = sign;
            let mut right = Vec3::ZERO;
            right[(axis + 1) % 3] = sign;
            let up = normal.cross(right);
            let (along, across) = ((right * size).length(), (up * size).length());
            // Cells are finer at the rounded edges.
            let place = |t: f32| if round > 0. { 2. * (t * t * (3. - 2. * t)) - 1. } else { 2. * t - 1. };
            mesh.join(Mesh::grid(cells, cells, Vec2::new(along, across), |u, v| {
                let flat = (normal + place(u) * right + place(v) * up) * half;
                let inner = flat.clamp(-half + round, half - round);
                inner + round * (flat - inner).normalize_or_zero()
            }));
        }
    }
    mesh.warped(|p| p + Vec3::Y * half.y)
}

/// Creates a centered superellipsoid of `size`. Exponents of 1 give an ellipsoid, towards 0 a box or a cylinder, above 1 a star.
pub(super) fn superellipsoid(size: Vec3, [polar, around]: [f32; 2], cells: usize) -> Mesh {
    let power = |x: f32, e: f32| x.signum() * x.abs().powf(e);
    let texture = Vec2::new(PI * size.x.max(size.z), PI / 2. * size.y);
    Mesh::grid(2 * cells, cells, texture, |u, v| {
        let (a, b) = (-TAU * u, PI * (v - 0.5));
        let ring = power(b.cos().max(0.), polar);
        let unit =
            Vec3::new(ring * power(a.cos(), around), power(b.sin(), polar), ring * power(a.sin(), around));
        unit * size / 2.
    })
}

/// Creates a surface of revolution about y through `profile`, (radius, height) from bottom to top.
pub(super) fn lathe(profile: &[Vec2], cells: usize) -> Mesh {
    let widest = profile.iter().fold(0f32, |widest, p| widest.max(p.x));
    let lengths: Vec<f32> = profile.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
    let mut mesh = Mesh::default();
    let mut above = 0.;
    // Each piece has its own grid, because profiles have corners.
    for (pair, &length) in profile.windows(2).zip(&lengths) {
        let mut piece = Mesh::grid(cells, 1, Vec2::new(TAU * widest, length), |u, v| {
            let at = pair[0].lerp(pair[1], v);
            let angle = -TAU * u;
            Vec3::new(at.x * angle.cos(), at.y, at.x * angle.sin())
        });
        piece.uvs.iter_mut().for_each(|uv| uv.y += above);
        above += length;
        mesh.join(piece);
    }
    mesh
}

/// Creates a cylinder or cone on y = 0, including its caps.
pub(super) fn cone(below: f32, above: f32, height: f32, cells: usize) -> Mesh {
    let rim = |radius: f32, y: f32| Vec2::new(radius, y);
    lathe(&[rim(0., 0.), rim(below, 0.), rim(above, height), rim(0., height)], cells)
}

/// Creates a tube of `radius(t)` around the curve `at(t)`, t from 0 to 1. A closed curve gives a torus.
pub(super) fn tube(
    at: impl Fn(f32) -> Vec3,
    radius: impl Fn(f32) -> f32,
    [along, around]: [usize; 2],
) -> Mesh {
    let step = 1e-2;
    let points: Vec<Vec3> = (0..=along).map(|i| at(i as f32 / along as f32)).collect();
    let length: f32 = points.windows(2).map(|pair| pair[0].distance(pair[1])).sum();
    // The side vector is transported along the curve, so that the tube doesn't twist.
    let mut side = (at(step) - at(0.)).normalize_or(Vec3::Y).any_orthonormal_vector();
    let sides: Vec<(Vec3, Vec3)> = (0..=along)
        .map(|i| {
            let t = i as f32 / along as f32;
            let forward = (at(t + step) - at(t - step)).normalize_or(Vec3::Y);
            side = (side - side.dot(forward) * forward).normalize_or(forward.any_orthonormal_vector());
            (side, forward.cross(side))
        })
        .collect();
    let texture = Vec2::new(TAU * radius(0.5), length);
    Mesh::grid(around, along, texture, |u, v| {
        let i = (v * along as f32).round() as usize;
        let (right, up) = sides[i];
        let angle = TAU * u;
        points[i] + radius(v) * (angle.cos() * right + angle.sin() * up)
    })
}

/// Creates a sheet of `size` around the origin, at `height(x, z)` above y = 0.
pub(super) fn height_field(size: Vec2, cells: usize, height: impl Fn(f32, f32) -> f32) -> Mesh {
    Mesh::grid(cells, cells, size, |u, v| {
        let (x, z) = ((u - 0.5) * size.x, (0.5 - v) * size.y);
        Vec3::new(x, height(x, z), z)
    })
}

/// Moves every point by up to `strength` metres, with wavelengths of `1 / frequency`.
pub(super) fn roughen(mesh: Mesh, noise: &Noise, frequency: f32, strength: f32) -> Mesh {
    mesh.warped(|p| {
        let q = p * frequency;
        let offset = Vec3::new(noise.sample(q), noise.sample(q + 31.7), noise.sample(q - 57.3));
        p + strength * offset
    })
}

/// Twists the mesh about y by `turns` full turns per metre of height.
pub(super) fn twist(mesh: Mesh, turns: f32) -> Mesh {
    mesh.warped(|p| {
        let (sin, cos) = (TAU * turns * p.y).sin_cos();
        Vec3::new(cos * p.x - sin * p.z, p.y, sin * p.x + cos * p.z)
    })
}

/// Scales the mesh perpendicular to y by 1 + `slope` · y.
pub(super) fn taper(mesh: Mesh, slope: f32) -> Mesh {
    mesh.warped(|p| {
        let scale = (1. + slope * p.y).max(0.05);
        Vec3::new(scale * p.x, p.y, scale * p.z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::vec3;

    /// Returns the volume by the divergence theorem. It is negative if the surface is inside out.
    fn volume(mesh: &Mesh) -> f32 {
        let tetrahedron = |corners: &[u32; 3]| {
            let [a, b, c] = corners.map(|vertex| mesh.positions[vertex as usize]);
            a.dot(b.cross(c)) / 6.
        };
        mesh.triangles.iter().map(tetrahedron).sum()
    }

    #[test]
    fn shapes_are_closed_and_face_outwards() {
        let ring = |t: f32| vec3((TAU * t).cos(), 0., -(TAU * t).sin());
        for (name, mesh, expected) in [
            ("box", cuboid(vec3(2., 3., 4.), 0.), 24.),
            ("rounded box", cuboid(vec3(2., 2., 2.), 1.), 4. / 3. * PI),
            ("ellipsoid", superellipsoid(vec3(1., 2., 3.), [1., 1.], 24), PI),
            ("near box", superellipsoid(Vec3::ONE, [0.1, 0.1], 24), 1.),
            ("cylinder", cone(1., 1., 2., 64), TAU),
            ("cone", cone(1., 0., 3., 64), PI),
            ("torus", tube(ring, |_| 0.25, [96, 32]), 2. * PI * PI * 0.0625),
        ] {
            let found = volume(&mesh);
            assert!((found / expected - 1.).abs() < 0.06, "{name}: {found}, expected {expected}");
            assert_eq!(mesh.normals().len(), mesh.uvs.len(), "{name}");
        }
    }

    #[test]
    fn boxes_stand_and_have_their_size() {
        for round in [0., 0.2] {
            let (least, most) = cuboid(vec3(1., 2., 3.), round).bounds();
            assert!(
                least.abs_diff_eq(vec3(-0.5, 0., -1.5), 1e-5) && most.abs_diff_eq(vec3(0.5, 2., 1.5), 1e-5)
            );
        }
    }
}
