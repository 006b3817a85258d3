//! Triangle meshes with texture coordinates.

use glam::{Affine3A, Vec2, Vec3};

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

    /// Returns one point per vertex: the vertex, moved a fifth of the way to the mean of its triangles' centres. Unlike the vertices
    /// themselves, these points don't lie on an edge where another surface begins.
    pub fn inset_vertices(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.); self.positions.len()];
        for corners in &self.triangles {
            let centre = corners.map(|vertex| self.positions[vertex as usize]).iter().sum::<Vec3>() / 3.;
            for &vertex in corners {
                let (sum, count) = &mut sums[vertex as usize];
                (*sum, *count) = (*sum + centre, *count + 1.);
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
